/** The page's words, which its build puts into the page. Imported before what says them. */

import { readFileSync } from "node:fs";

const file = JSON.parse(readFileSync("../texts/en.json", "utf-8")) as { live: Record<string, string> };
Object.assign(globalThis, { ENGLISH: file.live });
