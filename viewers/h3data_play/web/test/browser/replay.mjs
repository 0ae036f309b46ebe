// Plays a replay from disk: node replay.mjs file.html [folder of pictures]; prints one line of JSON.
import { pathToFileURL } from "node:url";
import { chromium } from "playwright-core";

const [file, pictures] = process.argv.slice(2);
const START_MS = 60_000;
const SIZES = { wide: [1280, 720], zoomed: [640, 360], phone: [390, 844], large: [1920, 1080] };

const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"],
});
const context = await browser.newContext({ viewport: { width: 1280, height: 720 } });
const page = await context.newPage();
const faults = [];
const asked = [];
page.on("console", (message) => message.type() === "error" && faults.push(message.text()));
page.on("pageerror", (error) => faults.push(error.message));
page.on("request", (request) => asked.push(request.url()));
await page.goto(pathToFileURL(file).href);

const ask = (expression) => page.evaluate(expression);
const nap = (ms) => page.waitForTimeout(ms);
async function until(expression, what, ms = 30_000) {
  for (const end = Date.now() + ms; Date.now() < end; await nap(50)) if (await ask(expression)) return;
  throw new Error(`Waited ${ms / 1000} s for ${what}; the page says ${await ask("document.getElementById('loading').innerText")}; ${faults.join(" | ")}`);
}
const row = () => ask("player.clock.row");
const shot = async (name) => pictures && page.screenshot({ path: `${pictures}_${name}.png` });
async function press(key) {
  await page.keyboard.press(key);
  await nap(60);
  return row();
}

await until("!!window.player && player.frames > 2", "the first frame", START_MS);
const said = { title: await page.title(), rows: await ask("player.episode.rows"), bones: await ask("player.world.bonesFound") };
await until("player.clock.seconds > 0.2", "the replay to play on load");
said.playsOnLoad = true;

// keys alone
await press("Space");
said.paused = !(await ask("player.clock.playing"));
said.home = await press("Home");
said.right = await press("ArrowRight");
said.left = await press("ArrowLeft");
said.end = await press("End");
await press("Home");
said.nextEvent = await press("n");
said.speed = (await press("ArrowUp"), await ask("player.clock.speed"));
await press("ArrowDown");

// every camera shows the home, somewhere in the middle
await ask("player.clock.seek(player.episode.seconds * 0.55)");
said.cameras = [];
for (let k = 0; k < (await ask("player.views.list.length")); k++) {
  await press(String(k + 1));
  const frames = await ask("player.frames");
  await ask("player.clock.seek(player.clock.seconds)");
  await until(`player.frames > ${frames}`, "a frame of another camera");
  said.cameras.push(await ask("player.views.view.label"));
  await shot(`camera_${k + 1}`);
}
await press("1");

// the cursor of the charts goes with the scrub bar
const cursors = "[...document.querySelectorAll('#charts .cursor')].map((line) => Number(line.getAttribute('x1')))";
await press("Home");
await nap(200);
const before = await ask(cursors);
await page.locator("#scrub").focus();
await press("End");
await nap(200);
const after = await ask(cursors);
said.charts = after.length;
said.cursorsMoved = after.every((x, k) => x > before[k] + 50);

// a click on an event goes there
const events = page.locator("#events li:not([hidden]) button");
said.events = await events.count();
if (said.events) {
  await events.nth(Math.floor(said.events / 2)).click();
  await nap(100);
  said.eventRow = await row();
  said.eventStep = await ask(`player.episode.about.events.filter((_, k) => !document.querySelectorAll('#events li')[k].hidden)[${Math.floor(said.events / 2)}].step`);
}
await ask("document.activeElement.blur(); player.clock.seek(player.episode.seconds * 0.55)");

// the page at several sizes: nothing runs out of it sideways, and everything can be reached
said.fits = {};
for (const [name, [width, height]] of Object.entries(SIZES)) {
  await page.setViewportSize({ width, height });
  await nap(700);
  said.fits[name] = await ask("document.documentElement.scrollWidth <= innerWidth");
  await shot(name);
}

// on a phone no name or goal lies on a robot or a person
await page.setViewportSize({ width: 390, height: 844 });
await nap(300);
said.covered = [];
for (let part = 0; part <= 10; part++) {
  const frames = await ask(`(player.clock.seek(player.episode.seconds * ${part / 10}), player.frames)`);
  await until(`player.frames > ${frames}`, "a frame of another step");
  said.covered.push(...(await ask(`(() => {
    const picture = document.getElementById("picture").getBoundingClientRect();
    const { marks, clock, views, canvas } = player;
    const bodies = marks.bodies(clock.row, views.view.agent, views.camera, canvas.clientWidth, canvas.clientHeight);
    const pills = [...document.querySelectorAll("#marks .mark:not(.squeezed)")].filter((pill) => !pill.hidden);
    return pills.flatMap((pill) => {
      const box = pill.getBoundingClientRect();
      const [left, top] = [box.left - picture.left, box.top - picture.top];
      const lies = bodies.some((body) => left + 1 < body.left + body.width && body.left < left + box.width - 1 && top + 1 < body.top + body.height && body.top < top + box.height - 1);
      return lies ? [[clock.row, pill.textContent]] : [];
    });
  })()`)));
  if (part === 3) await shot("pills");
}
await page.setViewportSize({ width: 1280, height: 720 });
await ask("document.body.focus()");
await press("?");
said.help = await ask("document.getElementById('help').open");
await shot("keys");
said.hostile = await ask("window.hostile ?? null");
said.network = asked.filter((url) => !/^(file|blob|data):/.test(url));
said.faults = faults;
await browser.close();
console.log(JSON.stringify(said));
