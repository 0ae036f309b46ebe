/** Takes part in a study as a person would, by mouse and keys, and prints what the pages said as JSON.
 *
 * node study.mjs URL [PICTURES]
 */

import { openPage } from "./browser.mjs";

const [url, pictures = ""] = process.argv.slice(2);
const player = await openPage(`${url}?PROLIFIC_PID=5f00000000000000000000ff&STUDY_ID=s&SESSION_ID=e`, { width: 1000, height: 720 });
const { page } = player;
const stages = [];
const seen = new Set();

const stage = () => player.ask("document.querySelector('#study:not([hidden]) section.card')?.dataset.stage ?? ''");
const press = (text) => page.locator("#study button", { hasText: text }).click();

async function shot(name) {
  if (!pictures || seen.has(name)) return;
  seen.add(name);
  await page.screenshot({ path: `${pictures}_${name}.png` });
}

/** Every question of a form, once without answers: then the page says what is missing. */
async function fill() {
  let warned = true;
  if (await page.locator("#study fieldset, #study input[type=range]").count()) {
    await press("Send");
    warned = await player.ask("document.querySelector('#study .warning').textContent !== ''");
  }
  for (const group of await page.locator("#study fieldset").all()) {
    const points = group.locator("label");
    await points.nth((await points.count()) >> 1).click();
  }
  for (const slider of await page.locator("#study input[type=range]").all()) {
    await slider.focus();
    await page.keyboard.press("ArrowRight");
  }
  for (const input of await page.locator("#study input[type=number]").all()) await input.fill("42");
  return warned;
}

/** The tutorial's ring and the look at the thing; what follows is done by one key, as in an episode. */
async function learn() {
  await player.until("!!probe.game.cues.marker", "the ring");
  await player.ask("probe.game.net.send({ k: 'goto', p: probe.game.cues.marker.toArray() }); 0");
  await player.until("!probe.game.cues.marker", "the ring to be reached", 60_000);
  for (let k = 0; k < 60 && !(await player.ask("document.getElementById('title').textContent")).startsWith("Take"); k++) {
    await player.press("a", 120);
    await player.nap(900);
  }
}

let warned = true;
/** Width of a questionnaire's slider on a small phone, px. */
let slider = 0;
let paused = "";
let resumed = false;
for (let k = 0; k < 40; k++) {
  await player.until("!document.getElementById('study').hidden && !!document.querySelector('#study section.card:not([data-seen])')", "a page of the study");
  const kind = await stage();
  if (kind !== "device") await player.ask("document.querySelector('#study section.card').dataset.seen = ''");
  if (kind === "device") {
    await player.until("document.querySelector('#study section.card')?.dataset.stage !== 'device'", "the check of the device", 20_000);
    continue;
  }
  stages.push(kind);
  if (kind === "end") break;
  await shot(kind);
  if (kind === "consent") await press("I agree");
  else if (kind === "form") {
    warned = (await fill()) && warned;
    if (!slider && (await page.locator("#study input[type=range]").count())) {
      await page.setViewportSize({ width: 320, height: 568 });
      slider = await player.ask("Math.min(...[...document.querySelectorAll('#study input[type=range]')].map((node) => node.getBoundingClientRect().width))");
      await shot("form_narrow");
      await page.setViewportSize({ width: 1000, height: 720 });
    }
    await shot(`form_${k}`);
    await press("Send");
  } else {
    await press("Begin");
    await player.started();
    if (!paused) {
      await page.click("#button-pause");
      paused = await player.ask("document.getElementById('cover-title').textContent");
      const before = await player.ask("probe.game.net.latest.step");
      await player.nap(700);
      await shot("paused");
      await page.click("#cover-button");
      await player.until("document.body.dataset.state === 'playing'", "the home to go on", 10_000);
      resumed = before <= (await player.ask("probe.game.net.latest.step"));
    }
    if (kind === "tutorial") await learn();
    for (let n = 0; n < 14 && !(await player.over); n++) {
      await player.press("f");
      await player.idle(90_000);
      if (n === 0) await shot(`${kind}_played`);
    }
    await player.until("!!probe.over", "the end of the episode", 90_000);
    await page.click("#cover-button");
  }
}
await shot("end");
const text = await player.ask("document.querySelector('#study section.card').innerText");
const address = await player.ask("location.search");
const { faults } = await player.close();
console.log(JSON.stringify({ stages, text, warned, slider, paused, resumed, address, faults }));
