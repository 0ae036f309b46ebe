/** A scripted player in a real browser without a window. */

import { createRequire } from "node:module";
import { chromium } from "playwright-core";

const BUSY = 8;
const START_MS = 150_000;
const emulator = createRequire(import.meta.url).resolve("iwer/build/iwer.min.js");

/**
 * The page in a window of this size, with few pixels and without shadows: a software renderer then draws several times as many
 * pictures. ``full`` draws what players see.
 */
export async function openPage(url, { width = 1280, height = 720, headset = false, touch = false, full = false } = {}) {
  const browser = await chromium.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"],
  });
  const context = await browser.newContext({ viewport: { width, height }, hasTouch: touch });
  const page = await context.newPage();
  const faults = [];
  // a busy server answers 503, and the page asks again; Chromium prints an error for either
  const asksAgain = (message) => message.text().includes("status of 503");
  page.on("console", (message) => message.type() === "error" && !asksAgain(message) && faults.push(message.text()));
  page.on("pageerror", (error) => faults.push(error.message));
  if (headset) {
    await page.addInitScript({ path: emulator });
    await page.addInitScript(() => {
      const device = new window.IWER.XRDevice(window.IWER.metaQuest3);
      device.installRuntime({ forceInstall: true }); // Chromium has a `navigator.xr` of its own, without any device
      window.headset = device;
    });
  }
  const address = new URL(url);
  if (!full) for (const [name, value] of [["plain", ""], ["dpr", "0.25"]]) address.searchParams.set(name, value);
  await page.goto(address.href);
  return new Player(browser, page, faults);
}

export class Player {
  constructor(browser, page, faults) {
    Object.assign(this, { browser, page, faults, seq: 0 });
  }

  /** Evaluates an expression in the page. Playwright's waitForFunction needs `eval` there, which the page's policy forbids. */
  ask(expression) {
    return this.page.evaluate(expression);
  }

  nap(ms) {
    return this.page.waitForTimeout(ms);
  }

  async until(expression, what, ms = 30_000) {
    for (const end = Date.now() + ms; Date.now() < end; await this.nap(50)) if (await this.ask(expression)) return;
    const cover = await this.ask("document.body.dataset.state + ': ' + document.getElementById('cover').innerText");
    const toast = await this.ask("document.getElementById('toast')?.innerText ?? ''");
    throw new Error(`Waited ${ms / 1000} s for ${what}; the page says ${cover}; ${toast}; faults: ${this.faults.join(" | ")}`);
  }

  /** Until the page has drawn so many more pictures. */
  async drawn(count) {
    const frames = await this.ask("probe.game.frames");
    await this.until(`probe.game.frames >= ${frames + count}`, `${count} pictures`);
  }

  started() {
    return this.until("!!window.probe && probe.game.frames > 2 && document.body.dataset.state === 'playing'", "the first frame", START_MS);
  }

  async press(key, ms = 60) {
    await this.page.keyboard.down(key);
    await this.nap(ms);
    await this.page.keyboard.up(key);
  }

  /** Until everything that was asked for has acted, and no skill and no walk of the server's moves the player's body. */
  async idle(ms = 60_000) {
    const latest = "probe.game.net.latest";
    // a page that draws twice a second is late to send, too
    for (const end = Date.now() + 3000; Date.now() < end && (await this.ask("probe.game.net.seq")) <= this.seq; ) await this.nap(50);
    this.seq = await this.ask("probe.game.net.seq");
    await this.until(`!!probe.over || ${latest}.ack >= probe.game.net.seq - 1`, "the server to hear", ms);
    await this.nap(100);
    await this.until(`!!probe.over || (${latest}.flags & ${BUSY}) === 0`, "the body to stand", ms);
  }

  get over() {
    return this.ask("window.probe.over");
  }

  shot(path) {
    return path ? this.page.screenshot({ path }) : undefined;
  }

  async close() {
    const stats = await this.ask("window.probe ? probe.stats() : null");
    await this.browser.close();
    return { ...stats, faults: this.faults };
  }
}
