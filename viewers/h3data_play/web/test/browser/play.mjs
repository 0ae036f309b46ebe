/** Plays one scenario against a running server and prints what happened as JSON.
 *
 * node play.mjs SCENARIO URL [PICTURES]
 */

import { openPage } from "./browser.mjs";

const [scenario, url, pictures = ""] = process.argv.slice(2);
const picture = (name) => (pictures ? `${pictures}_${name}.png` : "");

/** The whole task by one key: F leads to the next thing and takes it, then to its place and puts it there. */
async function task() {
  const player = await openPage(url, { full: true });
  await player.started();
  await player.shot(picture("start"));
  for (let k = 0; k < 14 && !(await player.over); k++) {
    await player.press("f");
    await player.idle();
    if (k < 2) await player.shot(picture(k ? "put" : "taken"));
  }
  await player.until("!!probe.over", "the end of the episode");
  await player.shot(picture("end"));
  return { over: await player.over, ...(await player.close()) };
}

/** Names over the heads of others: turns until one is in the picture. */
async function names() {
  const player = await openPage(url, { width: 960, height: 540 });
  await player.started();
  const labels = `[...document.querySelectorAll(".mark:not([hidden]) .name")].map((label) => label.textContent)`;
  let seen = [];
  for (let k = 0; k < 30 && !seen.length; k++) {
    await player.press("a", 200);
    seen = await player.ask(labels);
  }
  await player.shot(picture("names"));
  const others = await player.ask("probe.game.manifest.agents.length - 1");
  return { names: seen, others, ...(await player.close()) };
}

/** Walks about by keys: how far prediction and server are apart, and how soon a key shows. */
async function walk() {
  const player = await openPage(url, { width: 480, height: 300 });
  await player.started();
  const from = await player.ask("({ ...probe.game.shown })");
  for (let k = 0; k < 12; k++) {
    await player.press("w", 180 + 29 * k);
    await player.press(k % 3 ? "a" : "d", 150 + 23 * k);
    await player.nap(80);
  }
  await player.nap(500);
  const to = await player.ask("({ ...probe.game.shown })");
  return { walked: Math.hypot(to.x - from.x, to.z - from.z), ...(await player.close()) };
}

/** A pixel of the picture where the floor is, some steps away, and no label before it. */
const FLOOR_PIXEL = `(() => {
  const { game } = probe;
  for (let y = 0.1; y > -0.9; y -= 0.07)
    for (let x = -0.6; x < 0.5; x += 0.1) {
      const target = game.pointing.target(x, y, game.camera.camera, -1);
      const far = target.kind === "floor" ? Math.hypot(target.point.x - game.shown.x, target.point.z - game.shown.z) : 0;
      const pixel = [((x + 1) / 2) * innerWidth, ((1 - y) / 2) * innerHeight];
      if (far > 0.8 && far < 4 && document.elementFromPoint(...pixel)?.tagName === "CANVAS") return pixel;
    }
  return null;
})()`;

/** Clicks on the floor and is walked there; looks elsewhere where there is no floor, or none that can be walked to. */
async function click() {
  const player = await openPage(url);
  await player.started();
  const from = await player.ask("({ ...probe.game.shown })");
  const walked = `Math.hypot(probe.game.shown.x - ${from.x}, probe.game.shown.z - ${from.z})`;
  const reasons = [];
  for (let k = 0; k < 12 && (await player.ask(walked)) < 0.5; k++) {
    await player.nap(700);
    const floor = await player.ask(FLOOR_PIXEL);
    if (floor) {
      await player.page.mouse.click(...floor);
      await player.idle();
      reasons.push(await player.ask("document.getElementById('toast').innerText"));
    }
    await player.ask("probe.game.camera.look(0.6, -0.05); 0");
  }
  await player.shot(picture("clicked"));
  return { walked: await player.ask(walked), reasons, ...(await player.close()) };
}

/** Loses the connection for a moment and goes on in the same seat. */
async function reconnect() {
  const player = await openPage(url);
  await player.started();
  await player.press("w", 300);
  const step = await player.ask("probe.game.net.latest.step");
  await player.ask("probe.drop(); 0");
  await player.until("document.body.dataset.state === 'lost'", "the page to say that the connection is lost", 5000);
  await player.shot(picture("lost"));
  await player.until("document.body.dataset.state === 'playing'", "the connection to be back", 10_000);
  await player.press("w", 300);
  await player.nap(500);
  return { before: step, after: await player.ask("probe.game.net.latest.step"), ...(await player.close()) };
}

/** A person in a headset: looks, walks, turns, moves a hand, takes and puts down by the trigger. */
async function headset() {
  const player = await openPage(url, { headset: true, width: 960, height: 540 });
  await player.started();
  const left = (call) => player.ask(`headset.controllers.left.${call}; 0`);
  const right = (call) => player.ask(`headset.controllers.right.${call}; 0`);
  await player.page.click("#button-vr");
  await player.until("probe.game.headset.on", "the headset to be entered");
  await player.nap(1500);
  const from = await player.ask("({ ...probe.game.shown })");
  await player.ask("headset.position.set(0.05, 1.62, 0.1); 0");
  await right("position.set(0.3, 1.15, -0.3)");
  await left("updateAxes('thumbstick', 0, -1)");
  await player.nap(900);
  await left("updateAxes('thumbstick', 0, 0)");
  await player.nap(400);
  const to = await player.ask("({ ...probe.game.shown })");
  await right("updateAxes('thumbstick', 1, 0)");
  await player.nap(300);
  await right("updateAxes('thumbstick', 0, 0)");
  await right("updateButtonValue('squeeze', 1)");
  await player.nap(1500);
  await player.shot(picture("hand"));
  await right("updateButtonValue('squeeze', 0)");
  const held = [];
  for (let k = 0; k < 14 && !(await player.over); k++) {
    await right("updateButtonValue('trigger', 1)");
    await player.nap(400);
    await right("updateButtonValue('trigger', 0)");
    await player.idle();
    held.push(await player.ask("probe.game.now.held"));
    if (k === 0) await player.shot(picture("taken"));
  }
  return { walked: Math.hypot(to.x - from.x, to.z - from.z), held, over: await player.over, ...(await player.close()) };
}

/** A headset that stays on: an episode is left, the trigger begins the next one in the same page, which is walked in. */
async function headsetStays() {
  const player = await openPage(url, { headset: true, width: 960, height: 540 });
  await player.started();
  await player.page.click("#button-vr");
  await player.until("probe.game.headset.on", "the headset to be entered");
  await player.nap(1200);
  await player.ask("window.first = { game: probe.game, worn: probe.game.renderer.xr.getSession() }; 0");
  await player.ask("probe.game.net.send({ k: 'leave' }); 0");
  await player.until("!!probe.over", "the end of the episode");
  await player.nap(1200);
  const words = await player.ask("probe.game.hud.words()");
  await player.shot(picture("over"));
  const right = (call) => player.ask(`headset.controllers.right.${call}; 0`);
  await right("updateButtonValue('trigger', 1)");
  await player.nap(500);
  await right("updateButtonValue('trigger', 0)");
  await player.until("probe.game !== window.first?.game", "the next episode", 60_000);
  await player.started();
  await player.until("!!probe.game.headset?.on", "the headset to be worn in the next episode");
  const same = await player.ask("probe.game.renderer.xr.getSession() === window.first.worn");
  await player.nap(1000);
  const from = await player.ask("({ ...probe.game.shown })");
  await right("updateButtonValue('trigger', 1)");
  await player.nap(500);
  await right("updateButtonValue('trigger', 0)");
  const walked = `Math.hypot(probe.game.shown.x - ${from.x}, probe.game.shown.z - ${from.z})`;
  await player.until(`${walked} > 0.5`, "the trigger to lead to a thing", 60_000);
  await player.shot(picture("next"));
  const apart = await player.ask("Math.hypot(probe.game.headset.head.x - probe.game.shown.x, probe.game.headset.head.z - probe.game.shown.z)");
  return { words, same, apart, ...(await player.close()) };
}

/** Two people in one world, and somebody who watches; `url` has the three links, separated by commas. */
async function together() {
  const links = url.split(",");
  const first = await openPage(links[0], { width: 640, height: 360 });
  await first.until("document.body.dataset.state === 'paused'", "the page to say that it waits for the other", 60_000);
  const waits = await first.ask("document.getElementById('cover-text').innerText");
  const second = await openPage(links[1], { width: 640, height: 360 });
  await Promise.all([first.started(), second.started()]);
  const spectator = await openPage(links[2], { width: 640, height: 360 });
  await spectator.started();
  const places = () => spectator.ask("probe.game.net.latest.agents.map(({ x, z, heading }) => [x, z, heading])");
  const before = await places();
  let moved = [0, 0];
  // on a machine that is busy, a key reaches the world late, and the spectator sees it later still
  for (let k = 0; k < 10 && Math.min(...moved) <= 0.1; k++) {
    for (const player of [first, second]) {
      await player.press("w", 500);
      await player.press("a", 500);
    }
    await spectator.nap(1000);
    const after = await places();
    moved = after.map((place, n) => Math.hypot(...place.map((value, i) => value - before[n][i])));
  }
  await spectator.shot(picture("watched"));
  await second.close();
  await first.until("document.body.dataset.state === 'paused'", "the page to say that the other is gone", 10_000);
  const faults = [...first.faults, ...second.faults];
  await first.close();
  const me = await spectator.ask("probe.game.manifest.me");
  const { faults: more, ...said } = await spectator.close();
  return { ...said, waits, moved, me, faults: [...faults, ...more] };
}

/** Pages of other sizes and hands: a phone, a laptop at 200 %, the help by keyboard alone. */
async function sizes() {
  const phone = await openPage(url, { width: 844, height: 390, touch: true });
  await phone.started();
  await phone.page.touchscreen.tap(430, 250);
  await phone.nap(1200);
  await phone.shot(picture("phone"));
  await phone.close();
  const zoomed = await openPage(url, { width: 640, height: 360 });
  await zoomed.started();
  await zoomed.shot(picture("zoomed"));
  const overflow = await zoomed.ask("[...document.querySelectorAll('#task, #bar, #map')].map((n) => { const b = n.getBoundingClientRect(); return b.left >= 0 && b.top >= 0 && b.right <= innerWidth && b.bottom <= innerHeight; })");
  for (let k = 0; k < 12 && (await zoomed.ask("document.activeElement.id")) !== "button-help"; k++) await zoomed.press("Tab");
  await zoomed.press("Enter");
  await zoomed.nap(300);
  const help = await zoomed.ask("document.getElementById('help').open");
  await zoomed.shot(picture("help"));
  return { inside: overflow.every(Boolean), help, ...(await zoomed.close()) };
}

/** Windows for a mouse, and screens for fingers. */
const SIZES = [
  [false, [[1280, 800], [800, 1280], [640, 360], [568, 320], [390, 844], [320, 568]]],
  [true, [[844, 390], [390, 844], [568, 320], [320, 568], [768, 1024]]],
];

/** Parts of the page that lie on each other, are cut, or stick out of the window; run in the page. */
const LAYOUT = `(() => {
  const parts = [...document.querySelectorAll("#bar button, #timer, #task h1, #todo li > *, #lines p, #map, #hint, #toast, #stick, #thumbs button, #postures button, .mark:not(.squeezed)")]
    .map((node) => [node, node.getBoundingClientRect()])
    .filter(([node, box]) => box.width > 0 && box.height > 0 && getComputedStyle(node).visibility === "visible");
  const name = (node) => node.id || node.className + " " + node.textContent;
  const faults = [];
  parts.forEach(([a, box], k) => {
    if (box.left < -0.5 || box.top < -0.5 || box.right > innerWidth + 0.5 || box.bottom > innerHeight + 0.5) faults.push(name(a) + " is outside");
    if (!a.matches("canvas, .mark") && a.scrollWidth > a.clientWidth + 1 && a.clientWidth) faults.push(name(a) + " is cut");
    for (const [b, other] of parts.slice(k + 1)) {
      const wide = Math.min(box.right, other.right) - Math.max(box.left, other.left);
      const high = Math.min(box.bottom, other.bottom) - Math.max(box.top, other.top);
      if (wide > 0.5 && high > 0.5 && !a.contains(b)) faults.push(name(a) + " lies on " + name(b));
    }
  });
  for (const id of ["hint", "toast"]) {
    const node = document.getElementById(id);
    if (node.clientHeight > 4.9 * parseFloat(getComputedStyle(node).lineHeight)) faults.push(id + " is squeezed into a column");
  }
  const task = document.getElementById("task");
  if (task.scrollHeight > task.clientHeight + 1) faults.push("the task is cut");
  return faults;
})()`;

/** All buttons for postures at once, with the longest words that there are; they stay. */
const ALL_POSTURES = `(() => {
  probe.game.hud.postures = () => {};
  ["Sentarse", "Acostarse", "Saludar", "Teléfono", "Tomar bandeja"].forEach((word, k) =>
    Object.assign(document.querySelectorAll("#postures button")[k], { hidden: false, textContent: word }));
})()`;

/** Sits, lies, waves and looks at a phone by fingers, at a place beside a bed: LINK@X,Z. Buttons show only what can be done there. */
async function postures() {
  const [link, at] = url.split("@");
  const [x, z] = at.split(",").map(Number);
  const player = await openPage(link, { width: 390, height: 844, touch: true, full: !!pictures });
  await player.started();
  await player.drawn(3);
  const offered = () => player.ask("[...document.querySelectorAll('#postures button')].filter((button) => button.offsetParent).map((button) => button.textContent)");
  const faults = {};
  const look = async (name) => {
    await player.drawn(3);
    const seen = await player.ask(LAYOUT);
    if (seen.length) faults[name] = seen;
    await player.shot(picture(name));
    return offered();
  };
  const tap = (name) => player.page.tap(`#posture-${name}`);
  const flags = "probe.game.net.latest.flags";
  const away = await look("away");
  await tap("wave");
  await player.nap(900);
  await look("waves");
  await player.nap(3000);
  await player.ask(`probe.game.net.send({ k: "goto", p: [${x}, 0, ${z}] }); 0`);
  await player.nap(500);
  await player.idle();
  await player.until(`(${flags} & 32) !== 0`, "lying down to be offered");
  const near = await look("near");
  await player.page.setViewportSize({ width: 320, height: 568 });
  await look("near_320");
  await player.page.setViewportSize({ width: 844, height: 390 });
  await look("near_844");
  await player.page.setViewportSize({ width: 390, height: 844 });
  await tap("lie");
  await player.until(`(${flags} & 64) !== 0`, "the person to lie down", 60_000);
  await player.nap(9000);
  const lies = await look("lies");
  await tap("sit");
  await player.until(`(${flags} & 72) === 0`, "the person to stand", 60_000);
  await player.nap(600);
  await tap("phone");
  await player.nap(1500);
  await look("phone");
  await tap("phone");
  await player.nap(1000);
  return { away, near, lies, layout: faults, ...(await player.close()) };
}

/** Takes a carton out of a fridge and puts it down by fingers, takes a tray by keys and looks at a phone: LINK@X,Z,X,Z, places
 * before the fridge and the tray. */
async function chores() {
  const [link, at] = url.split("@");
  const [x, z, trayX, trayZ] = at.split(",").map(Number);
  const player = await openPage(link, { width: 390, height: 844, touch: true, full: !!pictures });
  await player.started();
  const faults = {};
  const told = [];
  const look = async (name) => {
    await player.drawn(3);
    const seen = await player.ask(LAYOUT);
    if (seen.length) faults[name] = seen;
    const hint = await player.ask("document.getElementById('hint').innerText.trim()");
    const button = await player.ask("(({ offsetParent, textContent }) => offsetParent && textContent)(document.getElementById('posture-chore'))");
    told.push([name, button, hint]);
    await player.shot(picture(name));
  };
  const go = async (x, z) => {
    await player.ask(`probe.game.net.send({ k: "goto", p: [${x}, 0, ${z}] }); 0`);
    await player.nap(500);
    await player.idle();
  };
  const offered = (name) => player.until(`probe.game.chores.some((chore) => chore.name === "${name}")`, `${name} to be offered`, 60_000);
  const free = async () => {
    await player.until("(probe.game.net.latest.flags & 8) !== 0", "the chore to begin", 60_000);
    await player.until("(probe.game.net.latest.flags & 8) === 0", "the chore to end", 90_000);
  };
  await look("away");
  await go(x, z);
  await offered("take");
  await look("fridge");
  await player.page.tap("#posture-chore");
  await player.until("[...probe.game.net.latest.joints].some((q) => Math.abs(q) > 0.8)", "the fridge to be open", 60_000);
  await look("opens");
  await player.until("(probe.game.net.latest.flags & 8) === 0", "the chore to end", 90_000);
  await offered("put");
  await look("carton");
  await player.page.tap("#posture-chore");
  await free();
  await player.page.setViewportSize({ width: 1280, height: 800 });
  await player.ask("probe.game.input.device = 'keys'; 0");
  await go(trayX, trayZ);
  await offered("lift");
  await look("counter");
  await player.press("k");
  await free();
  await player.press("s", 900);
  await look("tray");
  await offered("put");
  await player.press("k");
  await free();
  await player.press("p");
  await offered("phone");
  await look("phone");
  await player.press("p");
  await player.until("!probe.game.chores.length", "the phone to be put away", 60_000);
  await player.ask("probe.game.net.send({ k: 'leave' }); 0");
  await player.until("!!probe.over", "the end of the episode");
  return { told, layout: faults, ...(await player.close()) };
}

/** Lowest contrast that the ring around what has the focus has with anything behind it: of its two lines the better one counts. */
const RING = `(() => {
  const node = document.activeElement;
  const style = getComputedStyle(node.id === "view" ? document.body : node, node.id === "view" ? "::after" : null);
  const light = (text) => { const [r, g, b] = text.match(/[\\d.]+/g).map(Number).map((v) => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const lines = [...(style.outlineStyle !== "none" ? [style.outlineColor] : []), ...(style.boxShadow.match(/rgba?\\([^)]*\\)/g) ?? [])].map(light);
  const contrast = (a, b) => (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  const behind = Array.from({ length: 101 }, (_, k) => k / 100);
  return [node.id, lines.length ? Math.min(...behind.map((back) => Math.max(...lines.map((line) => contrast(line, back))))) : 1];
})()`;

/** Every size of window, with hints, reasons and all buttons that there can be: nothing lies on anything else. */
async function layout() {
  const faults = {};
  const rings = {};
  const lives = [];
  let stats;
  for (const [touch, sizes] of SIZES) {
    const player = await openPage(url, { width: sizes[0][0], height: sizes[0][1], touch });
    await player.started();
    await player.ask(`probe.game.input.device = "${touch ? "touch" : "mouse"}"; 0`);
    for (const [width, height] of sizes) {
      await player.page.setViewportSize({ width, height });
      const found = {};
      const look = async (what) => {
        await player.drawn(3);
        const seen = await player.ask(LAYOUT);
        if (seen.length) found[what] = seen;
      };
      const shot = (what) => player.shot(picture(`${width}x${height}_${touch ? "touch" : "mouse"}${what}`));
      const said = () => player.ask("(({ id, role, textContent, offsetParent }) => [role, textContent, getComputedStyle(document.getElementById('said')).display])(document.getElementById('said') ?? document.getElementById('toast'))");
      await look("playing");
      await shot("");
      await player.ask("probe.game.refused('There is nowhere to stand from which it could be put there.'); 0");
      await look("a reason");
      lives.push(await said());
      await shot("_reason");
      await player.ask("document.getElementById('button-pause').hidden = false; document.getElementById('button-leave').textContent = 'Dejar de participar en el estudio'; 0");
      await look("all buttons");
      await player.ask("document.getElementById('button-pause').hidden = true; 0");
      if (touch) {
        await player.ask(ALL_POSTURES);
        await look("all postures");
        await shot("_postures");
      }
      if (Object.keys(found).length) faults[`${width}x${height} ${touch ? "touch" : "mouse"}`] = found;
    }
    await player.ask("document.activeElement.blur(); 0");
    for (let n = 0; n < 12; n++) {
      await player.press("Tab", 20);
      const [id, contrast] = await player.ask(RING);
      if (id) rings[id] = contrast;
    }
    stats = await player.close();
    if (stats.faults.length) break;
  }
  return { layout: faults, rings, lives, ...stats };
}

/**
 * A pixel that shows the player's own body. The camera moves out slowly from whatever is behind the body, and close to a wall it shows
 * a part of the body or none: the view turns until it does.
 */
async function ownBody(player) {
  for (let turns = 0; turns < 12; turns++) {
    for (let looks = 0; looks < 5; looks++) {
      const pixel = await player.ask(`(() => { const { game } = probe;
        for (let y = 0.4; y > -1; y -= 0.1)
          for (let x = -0.6; x < 0.7; x += 0.1) {
            const pixel = [((x + 1) / 2) * innerWidth, ((1 - y) / 2) * innerHeight];
            if (game.pointing.agent(x, y, game.camera.camera) === game.manifest.me && document.elementFromPoint(...pixel)?.id === "view") return pixel;
          }
        return null; })()`);
      if (pixel) return pixel;
      await player.drawn(2);
    }
    await player.ask("probe.game.camera.look(Math.PI / 5, 0); 0");
  }
  throw new Error("The view was turned all around, and the own body was never seen");
}

/** An empty hand, a click on the own body, hints for a mouse and for fingers; also where there is nothing to take. */
async function hands() {
  const player = await openPage(url);
  await player.started();
  const text = (id) => player.ask(`document.getElementById('${id}').textContent`);
  const toasts = {};
  const goals = await player.ask("probe.game.manifest.goals.length");
  for (const key of ["q", "g", ...(goals ? [] : ["f", "c"])]) {
    await player.ask("document.getElementById('toast').textContent = ''; 0");
    await player.press(key);
    await player.nap(300);
    toasts[key] = await text("toast");
  }
  const keys = await text("hint");
  const help = await text("keys");
  const body = await ownBody(player);
  const seq = await player.ask("probe.game.net.seq");
  await player.page.mouse.click(...body);
  await player.drawn(3);
  const sent = (await player.ask("probe.game.net.seq")) - seq;
  const mouse = await text("hint");
  await player.page.keyboard.press("Shift");
  await player.drawn(3);
  const again = await text("hint");
  await player.shot(picture("hands"));
  return { toasts, keys, help, mouse, again, sent, ...(await player.close()) };
}

/** A task without things to take: by keys the person lies down near `LINK@X,Z`, gets up, and sits; by fingers it has the buttons. */
async function seats() {
  const [link, at] = url.split("@");
  const [x, z] = at.split(",").map(Number);
  const player = await openPage(link, { width: 1280, height: 720, touch: true, full: !!pictures });
  await player.started();
  const flags = "probe.game.net.latest.flags";
  const text = (id) => player.ask(`document.getElementById('${id}').textContent`);
  const help = [await text("keys"), await text("help-touch")];
  await player.ask("probe.game.input.device = 'keys'; 0");
  await player.drawn(3);
  const hint = await text("hint");
  await player.shot(picture("hint"));
  await player.press("x");
  await player.nap(1400);
  await player.shot(picture("waves"));
  await player.nap(3000);
  await player.press("p");
  await player.nap(1500);
  await player.shot(picture("phone"));
  await player.press("p");
  await player.nap(1000);
  await player.ask(`probe.game.net.send({ k: "goto", p: [${x}, 0, ${z}] }); 0`);
  await player.nap(500);
  await player.idle();
  await player.until(`(${flags} & 32) !== 0`, "lying down to be offered");
  await player.ask('probe.game.input.device = "touch"; 0');
  await player.drawn(3);
  const near = await player.ask("[...document.querySelectorAll('#postures button')].filter((button) => button.offsetParent).map((button) => button.textContent)");
  await player.shot(picture("near"));
  await player.press("l");
  await player.until(`(${flags} & 64) !== 0`, "the person to lie down", 60_000);
  await player.nap(9000);
  await player.shot(picture("lies"));
  await player.press("c");
  await player.until(`(${flags} & 72) === 0`, "the person to stand", 60_000);
  await player.press("c");
  await player.until(`(${flags} & 64) !== 0`, "the person to sit", 60_000);
  await player.nap(4500);
  await player.drawn(3);
  await player.shot(picture("sits"));
  return { help, hint, near, ...(await player.close()) };
}

/** Performs a motion of a file at `LINK@X,Z`: by a key, which ends it as well, and by a finger. */
async function acts() {
  const [link, at] = url.split("@");
  const [x, z] = at.split(",").map(Number);
  const player = await openPage(link, { width: 390, height: 844, touch: true, full: !!pictures });
  await player.started();
  const busy = (is) => player.until(`((probe.game.net.latest.flags & 8) !== 0) === ${is}`, "the motion to begin or end", 60_000);
  const text = (id) => player.ask(`document.getElementById('${id}').textContent`);
  await player.ask(`probe.game.net.send({ k: "goto", p: [${x}, 0, ${z}] }); 0`);
  await player.nap(500);
  await player.idle();
  await player.drawn(4);
  const buttons = await player.ask("[...document.querySelectorAll('#postures button')].filter((button) => button.offsetParent).map((button) => button.textContent)");
  const layout = await player.ask(LAYOUT);
  await player.shot(picture("offered"));
  await player.page.tap("#acts button");
  await busy(true);
  await player.nap(1500);
  await player.shot(picture("dances"));
  await busy(false);
  await player.ask("probe.game.input.device = 'keys'; 0");
  await player.drawn(3);
  const [hint, help] = [await text("hint"), await text("keys")];
  await player.page.setViewportSize({ width: 1280, height: 720 });
  await player.idle();
  await player.drawn(4);
  await player.press("1");
  await busy(true);
  await player.nap(1200);
  await player.shot(picture("keys"));
  await player.press("1");
  await busy(false);
  await player.ask("probe.game.net.send({ k: 'leave' }); 0");
  await player.until("!!probe.over", "the end of the episode");
  return { buttons, layout, hint, help, ...(await player.close()) };
}

/** The tutorial: to the ring, by a turn to the thing, then by one key. */
async function tutorial() {
  const player = await openPage(url);
  await player.started();
  const task = () => player.ask("document.getElementById('title').innerText");
  const texts = [await task()];
  const hint = () => player.ask("document.getElementById('hint').textContent");
  const hints = [await hint()];
  await player.shot(picture("ring"));
  await player.press("f");
  await player.until("document.getElementById('toast').innerText", "a reason why nothing can be taken yet");
  const refused = await player.ask("document.getElementById('toast').innerText");
  await player.ask("probe.game.net.send({ k: 'goto', p: probe.game.cues.marker.toArray() }); 0");
  await player.until("!probe.game.cues.marker", "the ring to be reached", 60_000);
  texts.push(await task());
  await player.shot(picture("look"));
  for (let k = 0; k < 40 && (await task()) === texts[1]; k++) {
    await player.press("a", 150);
    await player.nap(900); // it has to be looked at for half a second
  }
  texts.push(await task());
  await player.drawn(3);
  hints.push(await hint());
  for (let k = 0; k < 6 && !(await player.over); k++) {
    await player.press("f");
    await player.idle();
    if (!k) texts.push(await task());
  }
  await player.until("!!probe.over", "the end of the tutorial");
  await player.shot(picture("end"));
  return { hints, texts, refused, over: await player.over, ...(await player.close()) };
}

/** Clicks on a world point, an expression, through the person's eyes, once a click there would mean that: an expression over
 * `target`. A page that draws twice a second turns its camera late, and the other agent may walk by in front of it. */
async function clickOn(player, point, meant, name) {
  for (let turns = 0; turns < 20; turns++) {
    await player.ask(`(() => {
      probe.game.setView("first");
      const { camera, shown } = probe.game;
      const [at, eye] = [${point}, camera.camera.position];
      const yaw = Math.atan2(eye.z - at.z, at.x - eye.x) - shown.heading - camera.yaw;
      const pitch = Math.atan2(at.y - eye.y, Math.hypot(at.x - eye.x, at.z - eye.z)) - camera.pitch;
      camera.look(yaw - 2 * Math.PI * Math.round(yaw / (2 * Math.PI)), pitch);
    })()`);
    await player.drawn(3);
    await player.nap(500);
    await player.shot(picture(name));
    const pixel = await player.ask(`(() => {
      const { camera, pointing, held } = probe.game;
      const at = ${point}.clone().project(camera.camera);
      const target = pointing.target(at.x, at.y, camera.camera, held);
      return ${meant} ? [((at.x + 1) / 2) * innerWidth, ((1 - at.y) / 2) * innerHeight] : null;
    })()`);
    if (pixel) return player.page.mouse.click(...pixel);
  }
  throw new Error(`${meant} was never where a click goes`);
}

/** A click on the drawer that shuts in a thing opens it, a click on the thing takes it out; a third, on the drawer, may not. */
async function drawer() {
  const player = await openPage(url);
  await player.started();
  await player.until("probe.game.barriers.some(([own]) => own >= 0)", "word of what is shut in");
  const thing = await player.ask("probe.game.barriers.findIndex(([own]) => own >= 0)");
  const joint = await player.ask(`probe.game.barriers[${thing}][0]`);
  const handle = `probe.game.world.joints.handles[${joint}]`;
  const state = "probe.game.net.latest";
  // some steps before it, where it is in the picture
  await player.ask(`probe.game.net.send({ k: "goto", p: ((at, axis, sign) => at.clone().addScaledVector({ x: axis[0], y: 0, z: axis[2] }, sign * 1.3).setY(0).toArray())(
    ${handle}, probe.game.manifest.joints[${joint}].axis, Math.sign(probe.game.manifest.joints[${joint}].opened)) }); 0`);
  await player.idle();
  const todo = await player.ask("document.getElementById('todo').innerText");
  const lying = () => player.ask(`[...${state}.things[${thing}].pose.slice(0, 3)]`);
  const [shut, was] = [await player.ask(`${state}.joints[${joint}]`), await lying()];
  await clickOn(player, handle, `target.joint === ${joint}`, "before");
  await player.until(`Math.abs(${state}.joints[${joint}] - ${shut}) > 0.15`, "the drawer to move", 60_000);
  await player.shot(picture("during"));
  await player.idle();
  await player.drawn(3);
  const chips = await player.ask("[...document.querySelectorAll('#marks .mark:not([hidden]) .chip')].map((chip) => chip.textContent)");
  const [open, is] = [await player.ask(`${state}.joints[${joint}]`), await lying()];
  const place = `probe.game.world.things[${thing}].position`;
  await clickOn(player, place, `target.thing === ${thing}`, "open");
  await player.idle();
  const held = await player.ask(`${state}.things[${thing}].held === probe.game.manifest.me`);
  await player.press("o");
  await player.until("document.getElementById('toast').innerText", "a reason why a full hand closes nothing");
  const reason = await player.ask("document.getElementById('toast').innerText");
  await player.shot(picture("taken"));
  await player.ask("probe.drop(); 0");
  await player.until("probe.game.net.connects === 2 && document.body.dataset.state === 'playing'", "the connection to be back", 20_000);
  await player.nap(500);
  const still = await player.ask(`${state}.joints[${joint}]`);
  const moved = Math.hypot(...is.map((value, k) => value - was[k]));
  return { todo, chips, shut, open, moved, held, reason, still, ...(await player.close()) };
}

/** A closed door: a click opens it, and then a way leads through it, which the page predicts. */
async function door() {
  const player = await openPage(url);
  await player.started();
  const state = "probe.game.net.latest";
  const place = () => player.ask("[probe.game.shown.x, probe.game.shown.z]");
  const [x, z] = await place();
  const joint = await player.ask(`probe.game.manifest.joints
    .map((joint, k) => [Math.hypot(joint.handle[0] - ${x}, joint.handle[2] - ${z}), k])
    .filter(([, k]) => probe.game.manifest.joints[k].label === "door" && ${state}.joints[k] === probe.game.manifest.joints[k].closed)
    .sort(([a], [b]) => a - b)[0][1]`);
  const handle = `probe.game.world.joints.handles[${joint}]`;
  const at = await player.ask(`${handle}.toArray()`);
  await player.ask(`probe.game.net.send({ k: "open", j: ${joint}, lead: true }); 0`);
  await player.until(`${state}.joints[${joint}] !== probe.game.manifest.joints[${joint}].closed`, "the door to move", 90_000);
  const before = await place();
  await player.shot(picture("moves"));
  await player.idle();
  const open = await player.ask(`${state}.joints[${joint}]`);
  // by keys, so that the page predicts: it looks through the door
  const ahead = await player.ask(`(() => { const joint = probe.game.manifest.joints[${joint}];
    const middle = joint.kind === 2 ? [joint.handle[0] + joint.axis[0] * 0.36, joint.handle[2] + joint.axis[2] * 0.36] :
      [(joint.handle[0] + joint.origin[0]) / 2, (joint.handle[2] + joint.origin[2]) / 2]; return middle; })()`);
  const beside = [2 * ahead[0] - before[0], 2 * ahead[1] - before[1]];
  await player.ask(`probe.game.net.send({ k: "goto", p: [${beside[0]}, 0, ${beside[1]}] }); 0`);
  await player.idle();
  await player.shot(picture("through"));
  for (let k = 0; k < 4; k++) await player.press("w", 250);
  const after = await place();
  return { at, before, after, beside, open, ...(await player.close()) };
}

/** To the foot of the stairs by a click, up by keys, and on to a room by a click. */
async function stairs() {
  const player = await openPage(url);
  await player.started();
  const [x0, z0, x1, z1, low, high, axis, start, end] = await player.ask("probe.game.manifest.heights.find((row) => row[9])");
  const along = (share) => start + share * (end - start);
  const at = (share) => (axis ? [(x0 + x1) / 2, low, along(share)] : [along(share), low, (z0 + z1) / 2]);
  const far = Math.abs(end - start);
  const height = () => player.ask("probe.game.camera.floorY");
  const heights = [];
  for (const share of [-0.4 / far, 0.05]) {
    await player.ask(`probe.game.net.send({ k: "goto", p: ${JSON.stringify(at(share))} }); 0`);
    await player.idle();
  }
  heights.push(await height());
  await player.nap(600);
  await player.shot(picture("foot"));
  // by keys, so that the page predicts: it looks up the stairs, and the body turns there
  const up = Math.atan2(-(at(1)[2] - at(0)[2]), at(1)[0] - at(0)[0]);
  const look = `(() => { const { camera, shown } = probe.game; camera.yaw = Math.atan2(Math.sin(${up} - shown.heading), Math.cos(${up} - shown.heading)); })()`;
  await player.ask(look);
  for (let k = 0; k < 80 && (await height()) < low + 0.5 * (high - low); k++) await player.press("w", 250);
  heights.push(await height());
  await player.nap(600);
  await player.shot(picture("middle"));
  for (let k = 0; k < 80 && (await height()) < high - 0.01; k++) await player.press("w", 250);
  await player.nap(600);
  heights.push(await height());
  await player.shot(picture("top"));
  const body = await player.ask("(() => { const me = probe.game.net.latest.agents[probe.game.manifest.me]; return me.root[1]; })()");
  return { heights, low, high, body, ...(await player.close()) };
}

/** The pictures of the documentation: over the shoulder, with something in the hand, beside the robot, as a spectator. */
async function album() {
  const [seat, watch] = url.split(",");
  const player = await openPage(seat, { full: true });
  await player.started();
  const lookTo = (x, z, pitch) => player.ask(`(() => { const { camera, shown } = probe.game; camera.pitch = ${pitch};
    camera.yaw = Math.atan2(shown.z - (${z}), (${x}) - shown.x) - shown.heading; })()`);
  const state = "probe.game.net.latest";
  await player.ask("probe.game.camera.pitch = -0.15; 0");
  await player.nap(3000);
  await player.shot(picture("over"));
  for (let k = 0; k < 4 && !(await player.ask("probe.game.held >= 0")); k++) {
    await player.press("f");
    await player.idle();
  }
  await player.ask("probe.game.setView('first'); Object.assign(probe.game.camera, { pitch: -0.8, yaw: 0 }); 0");
  await player.drawn(3);
  await player.nap(1000);
  await player.shot(picture("hand"));
  await player.ask("probe.game.setView('third'); 0");
  const robot = await player.ask(`probe.game.manifest.agents.findIndex((agent) => agent.kind === "robot")`);
  const [x, z] = await player.ask(`[${state}.agents[${robot}].x, ${state}.agents[${robot}].z]`);
  await player.ask(`probe.game.net.send({ k: "goto", p: [${x} + 1.1, 0, ${z} + 0.4] }); 0`);
  await player.idle();
  await lookTo(`${state}.agents[${robot}].x`, `${state}.agents[${robot}].z`, -0.25);
  await player.drawn(3);
  await player.nap(1000);
  await player.shot(picture("robot"));
  const spectator = await openPage(watch, { full: true });
  await spectator.started();
  await spectator.nap(5000);
  await spectator.shot(picture("above"));
  await spectator.close();
  return player.close();
}

/** A task in words by keys and lists: talks (markup stays text), washes, brings by name, reports a problem, answers the question. */
async function words() {
  const player = await openPage(url);
  const { page } = player;
  await player.started();
  await player.drawn(3);
  const asked = "document.getElementById('ask').open";
  const log = "[...document.querySelectorAll('#log li')].map((row) => row.innerText)";
  if (!(await player.ask("probe.game.talk.shown"))) await player.press("t");
  await page.fill("#words", "<img src=x onerror='window.ran = true'> hello");
  await page.press("#words", "Enter");
  await player.until(`${log}.length > 0`, "the log");
  await page.selectOption("#phrases", { index: 1 });
  await player.until(`${log}.length > 1`, "the ready-made message");
  await player.drawn(2);
  await player.shot(picture("talk"));
  const thing = await player.ask("probe.game.deeds.uses.findIndex(Boolean)");
  const list = async (button) => {
    await page.focus("#view");
    await page.keyboard.press("b");
    await player.until("document.getElementById('do').open", "the list");
    if (button !== "#do-bring") await page.selectOption("#do-thing", String(thing));
    else {
      const spot = await player.ask(`(() => {
        const task = document.getElementById("title").innerText;
        const found = probe.game.manifest.spots.find((one) => task.includes(one.label.replace(/^on the /, "")) && task.includes(one.room));
        return found?.name ?? "";
      })()`);
      await page.selectOption("#do-place", spot);
      await player.shot(picture("list"));
    }
    await page.click(button);
    await player.nap(500);
    const stands = "probe.game.net.latest.ack >= probe.game.net.seq - 1 && (probe.game.net.latest.flags & 8) === 0";
    await player.until(`${asked} || (${stands})`, "the body to stand", 150_000);
  };
  if (thing >= 0) {
    await list("#do-use");
    await player.until("document.getElementById('lines').innerText.includes('now.')", "the line about what was done", 60_000);
  }
  await page.click("#button-finish");
  await page.fill("#problem", "The <b>robot</b> stands in the way.");
  await player.shot(picture("finish"));
  await page.click("#finish-problem");
  for (let k = 0; k < 4 && !(await player.ask("probe.game.held >= 0")); k++) await list("#do-take");
  await player.shot(picture("taken"));
  for (let k = 0; k < 4 && !(await player.ask(asked)); k++) await list("#do-bring");
  await player.until(asked, "the question", 60_000);
  const question = await player.ask("document.getElementById('ask-heading').innerText");
  await page.fill("#ask-more", "It was fun.");
  await player.shot(picture("question"));
  await page.click("#ask button[value=yes]");
  await player.until("!!probe.over", "the end of the episode");
  await player.shot(picture("end"));
  const markup = await player.ask("window.ran === true || !!document.querySelector('#log img, #marks img, #title img')");
  return { over: await player.over, question, markup, log: await player.ask(log), ...(await player.close()) };
}

/** How a task in words looks in a window of another size, with somebody's message over their head. */
async function wordsAt() {
  const [link, size] = url.split("@");
  const [width, height] = size.split("x").map(Number);
  const player = await openPage(link, { width, height, touch: width < 700 });
  await player.started();
  await player.drawn(3);
  if (!(await player.ask("probe.game.talk.shown"))) await player.page.click("#button-talk");
  await player.page.fill("#words", "Where are you?");
  await player.page.press("#words", "Enter");
  await player.until("document.querySelectorAll('#log li').length > 0", "the log");
  await player.drawn(3);
  await player.shot(picture(size));
  const boxes = await player.ask(OVERLAPS);
  const task = await player.ask("document.getElementById('task').innerText");
  const run = await player.ask("!!document.querySelector('#task img, #log img, #marks img')");
  return { boxes, task, run, ...(await player.close()) };
}

/** Pairs of parts of the page that lie on each other. */
const OVERLAPS = `(() => {
  const parts = ["task", "bar", "map", "talk", "hint", "stick", "postures", "thumbs"].map((id) => [id, document.getElementById(id).getBoundingClientRect()]);
  const seen = parts.filter(([, box]) => box.width > 0 && box.height > 0);
  const on = (a, b) => a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1;
  const out = seen.filter(([, box]) => box.left < -1 || box.top < -1 || box.right > innerWidth + 1 || box.bottom > innerHeight + 1).map(([id]) => [id, "out"]);
  return [...out, ...seen.flatMap(([a, one], k) => seen.slice(k + 1).flatMap(([b, two]) => (on(one, two) ? [[a, b]] : [])))];
})()`;

const SCENARIOS = { task, walk, names, click, reconnect, headset, headsetStays, together, sizes, layout, postures, seats, acts, chores, hands, tutorial, drawer, door, stairs, album, words, wordsAt };
if (!SCENARIOS[scenario]) throw new Error(`Expected one of ${Object.keys(SCENARIOS).join(", ")}, got ${scenario}`);
console.log(JSON.stringify(await SCENARIOS[scenario]()));
