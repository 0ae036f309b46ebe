"""The GPU back end without a GPU: its CUDA C compiled by g++ with `cuda_on_cpu.h`, its tensors on the CPU."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import torch

from h3data_gpu.cuda import source_text
from h3data_gpu.renderer import GpuRenderer

COMPILER = shutil.which("g++")
KERNELS = {
    "place": "World",
    "palette": "Deform",
    "deform": "Deform",
    "raster": "Raster",
    "identify": "Shade",
    "shade": "Shade",
    "occlude": "Occlude",
    "blur": "Occlude",
}


class EmulatedProgram:
    """Stands in for `h3data_gpu.cuda.Program`."""

    def __init__(self, folder: Path, defines: dict[str, int]) -> None:
        path = folder / f"kernels_{'_'.join(map(str, defines.values()))}.so"
        if not path.exists():
            source = re.sub(r"extern __shared__ (\w+) (\w+)\[\];", r"\1* \2 = (\1*)dynamic_shared;", source_text())
            source = source.replace("__shared__", "static")
            calls = "".join(
                f"static {struct} {name}_argument;\nstatic void run_{name}() {{ {name}({name}_argument); }}\n"
                f'extern "C" void launch_{name}(const {struct}* s, int blocks, int threads) '
                f"{{ {name}_argument = *s; emulator::launch(run_{name}, blocks, threads); }}\n"
                for name, struct in KERNELS.items()
            )
            text = '#include "cuda_on_cpu.h"\nalignas(16) static char dynamic_shared[1 << 18];\n' + source + calls
            (folder / "kernels.cpp").write_text(text)
            assert COMPILER
            subprocess.run(
                [
                    COMPILER,
                    "-O2",
                    "-std=c++17",
                    "-w",
                    "-fPIC",
                    "-shared",
                    "-U_FORTIFY_SOURCE",
                    "-ffp-contract=off",
                    f"-I{Path(__file__).parent}",
                    *(f"-D{name}={value}" for name, value in defines.items()),
                    str(folder / "kernels.cpp"),
                    "-o",
                    str(path),
                ],
                check=True,
            )
        self._library = ctypes.CDLL(str(path))

    def launch(
        self, name: str, blocks: int, threads: int, argument: ctypes.Structure, *, shared_bytes: int = 0
    ) -> None:
        getattr(self._library, f"launch_{name}")(ctypes.byref(argument), blocks, threads)


class EmulatedRenderer(GpuRenderer):
    """A `GpuRenderer` on the CPU; slow, for small pictures."""

    folder: Path

    def _find_device(self, device: Any) -> torch.device:
        return torch.device("cpu")

    def _compile(self, defines: dict[str, int]) -> Any:
        return EmulatedProgram(self.folder, defines)
