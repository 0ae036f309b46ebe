// Measures pages of the documentation: node site.mjs page.html ...; prints one line of JSON: code blocks seen, what is wider than its
// place, and what beside the text would be printed.
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
const printed = [];
const paper = await (await browser.newContext({ viewport: { width: 720, height: 1000 } })).newPage();
await paper.emulateMedia({ media: "print" });
for (const file of files) {
  await paper.goto(pathToFileURL(file).href);
  const beside = ".sidebar-drawer, .toc-drawer, .mobile-header, .related-pages, .copybtn, .back-to-top";
  const seen = await paper.evaluate((found) => [...document.querySelectorAll(found)].filter((part) => part.checkVisibility()).map((part) => part.className), beside);
  const narrow = await paper.evaluate(() => document.querySelector("article").clientWidth < 0.9 * innerWidth);
  if (seen.length || narrow) printed.push([file, seen, narrow]);
}
await browser.close();
console.log(JSON.stringify({ blocks, cut, printed }));
