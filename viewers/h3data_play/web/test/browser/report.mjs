// Measures the heat maps of a report: node report.mjs report.html PICTURES; prints one line of JSON: how many heads of columns there
// are, those that are broken into lines, and how much wider than the window the page is.
import { pathToFileURL } from "node:url";
import { chromium } from "playwright-core";

const [file, pictures] = process.argv.slice(2);
const browser = await chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: ["--no-sandbox"] });
let heads = 0;
const broken = [];
const over = [];
for (const [width, height] of [[1280, 800], [1024, 768], [390, 844]]) {
  const page = await (await browser.newContext({ viewport: { width, height } })).newPage();
  await page.goto(pathToFileURL(file).href);
  const found = await page.evaluate(() => [...document.querySelectorAll(".heats thead th[scope=col]")].map((head) => {
    const text = document.createRange();
    text.selectNodeContents(head);
    return [head.textContent.trim(), new Set([...text.getClientRects()].map((box) => Math.round(box.top))).size];
  }));
  heads += found.length;
  for (const [text, lines] of found) if (lines > 1) broken.push([width, text, lines]);
  over.push(await page.evaluate(() => document.documentElement.scrollWidth - innerWidth));
  await page.locator(".heats").first().screenshot({ path: `${pictures}_${width}.png` });
}
console.log(JSON.stringify({ heads, broken, over }));
await browser.close();
