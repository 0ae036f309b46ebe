// Measures pages of the documentation: node site.mjs page.html ...; prints one line of JSON: code blocks seen, what is wider than its place.
import { pathToFileURL } from "node:url";
import { chromium } from "playwright-core";

const files = process.argv.slice(2);
const browser = await chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: ["--no-sandbox"] });
let blocks = 0;
const cut = [];
for (const [width, height] of [[1280, 800], [390, 844]]) {
  const page = await (await browser.newContext({ viewport: { width, height } })).newPage();
  for (const file of files) {
    await page.goto(pathToFileURL(file).href);
    const found = await page.evaluate(() => [...document.querySelectorAll(".content pre")].map((block) => [block.scrollWidth - block.clientWidth, block.textContent.slice(0, 60)]));
    blocks += found.length;
    for (const [over, text] of found) if (over > 1) cut.push([width, file, over, text]);
    const over = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
    if (over > 1) cut.push([width, file, over, "the page"]);
  }
}
await browser.close();
console.log(JSON.stringify({ blocks, cut }));
