"""Let the torch of PyPI, which is built for CUDA, load on a CPU without the gigabytes of CUDA's libraries.

``python absent_cuda.py FOLDER`` gets the folder of packages that torch is in. The libraries that torch names and nobody has
are there from then on as one small library: it has each function that torch looks for, which answers "there is no device".
Needs a C compiler, nm and readelf.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

NO_DEVICE = 100
"""cudaErrorNoDevice and CUDA_ERROR_NO_DEVICE."""
NAME = "libabsent_cuda.so"


def printed(*command: str | Path) -> str:
    """Output of a command that must succeed."""
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def write_absent_libraries(folder: Path) -> list[str]:
    """Write the library and its names beside those of torch; returns the names."""
    libraries = sorted(path for path in folder.glob("lib*.so*") if not path.is_symlink() and path.name != NAME)
    needed = {
        name for path in libraries for name in re.findall(r"\(NEEDED\).*\[(.*)\]", printed("readelf", "-d", path))
    }
    absent = sorted(name for name in needed if re.match(r"lib(cu|nv|nccl)", name))
    versions: dict[str, set[str]] = defaultdict(set)
    for path in libraries:
        for name, version in re.findall(
            r" [Uw] ((?:__cuda|cu|nv|nccl)\w+)(?:@(\S+))?", printed("nm", "-D", "-u", path)
        ):
            versions[version].add(name)
    functions = sorted(set().union(*versions.values()))
    source = "".join(f"int {name}(void) {{ return {NO_DEVICE}; }}\n" for name in functions)
    # a symbol without a version stands outside of all of them
    script = "".join(
        f"{version} {{ {'; '.join(sorted(names))}; }};\n" for version, names in versions.items() if version
    )
    map_file = folder / "absent_cuda.map"
    map_file.write_text(script)
    command = ["cc", "-w", "-shared", "-fPIC", "-x", "c", "-", "-o", folder / NAME, f"-Wl,--version-script={map_file}"]
    subprocess.run(command, input=source, text=True, check=True)
    for name in absent:
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(NAME)
    return absent


if __name__ == "__main__":
    (torch,) = Path(sys.argv[1]).glob("**/torch/lib")
    sys.stdout.write(f"{len(write_absent_libraries(torch))} libraries of CUDA stay away\n")
