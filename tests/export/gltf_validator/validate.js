// The Khronos glTF validator over files: fails at any error or warning. Run by `make check-gltf`.
const fs = require("fs");
const validator = require("gltf-validator");

async function main() {
  const files = process.argv.slice(2);
  let clean = 0;
  for (const file of files) {
    const { issues } = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)));
    if (issues.numErrors || issues.numWarnings) console.log(file, issues.messages.slice(0, 10));
    else clean += 1;
  }
  console.log(`${clean} of ${files.length} files without an error or a warning`);
  process.exitCode = clean === files.length && clean > 0 ? 0 : 1;
}

main();
