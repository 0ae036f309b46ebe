"""Compilation of CUDA C at first use, and launches on torch's stream, by NVRTC and the CUDA driver through ctypes.

NVRTC is part of torch's CUDA packages. Compiled code is cached (`h3data.files.cache_folder`), with one file for each
combination of source, options, device and NVRTC version.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from h3data.errors import H3DataError, InputError
from h3data.files import cache_folder, part_file

if TYPE_CHECKING:
    import torch

SOURCES = ("common.cuh", "deform.cu", "tile.cuh", "triangles.cuh", "raster.cu", "shade.cu", "occlusion.cu")
_DYNAMIC_SHARED_BYTES = 8  # CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES


class GpuError(H3DataError):
    """Error of a CUDA call; the message quotes CUDA's own error text."""


def gpu_problem() -> str | None:
    """Return the reason why no GPU can be used, as a sentence, or None if one can be used."""
    import torch

    if not torch.cuda.is_available():
        built = torch.version.cuda
        reason = "this torch is built without CUDA" if built is None else f"torch (CUDA {built}) sees no device"
        return f"No CUDA device: {reason}. Hint: use the CPU renderer (h3data.render.Renderer)."
    try:
        _nvrtc()
    except GpuError as error:
        return str(error)
    return None


def resolve_device(device: str | torch.device | None) -> torch.device:
    """Return the CUDA device with its index, or the current device if ``device`` is None.

    Raises:
        InputError: the machine has no CUDA device, or ``device`` does not name one.
    """
    import torch

    problem = gpu_problem()
    if problem:
        raise InputError(problem, code="H3-RENDER-014")
    chosen = torch.device("cuda" if device is None else device)
    if chosen.type != "cuda" or (chosen.index or 0) >= torch.cuda.device_count():
        raise InputError(
            f"Expected one of {torch.cuda.device_count()} CUDA devices, got {str(chosen)!r}.", code="H3-RENDER-015"
        )
    return torch.device("cuda", torch.cuda.current_device() if chosen.index is None else chosen.index)


def source_text() -> str:
    """Return all CUDA C sources of this package, concatenated."""
    folder = Path(__file__).parent
    return "".join(f'#line 1 "{name}"\n{(folder / name).read_text(encoding="utf-8")}' for name in SOURCES)


class Program:
    """The compiled kernels for one device."""

    def __init__(self, device: torch.device, defines: Mapping[str, int]) -> None:
        import torch

        self.device = device
        major, minor = torch.cuda.get_device_capability(device)
        image = compiled(source_text(), (major, minor), tuple(f"-D{k}={v}" for k, v in sorted(defines.items())))
        self._driver = _driver()
        self._module = ctypes.c_void_p()
        torch.cuda.synchronize(device)  # makes torch's context the current one
        with torch.cuda.device(device):
            _call(self._driver, "cuModuleLoadData", ctypes.byref(self._module), image)
        self._functions: dict[str, tuple[ctypes.c_void_p, int]] = {}

    def launch(
        self, name: str, blocks: int, threads: int, argument: ctypes.Structure, *, shared_bytes: int = 0
    ) -> None:
        """Launch a kernel, whose only parameter is a struct, on torch's current stream of this program's device."""
        import torch

        if blocks == 0:
            return
        parameters = (ctypes.c_void_p * 1)(ctypes.addressof(argument))
        stream = ctypes.c_void_p(torch.cuda.current_stream(self.device).cuda_stream)
        grid, block = (blocks, 1, 1), (threads, 1, 1)
        with torch.cuda.device(self.device):  # a kernel, and a graph that captures it, belong to the context of one GPU
            function = self._function(name, shared_bytes)
            _call(self._driver, "cuLaunchKernel", function, *grid, *block, shared_bytes, stream, parameters, None)

    def _function(self, name: str, shared_bytes: int) -> ctypes.c_void_p:
        function, allowed = self._functions.get(name, (None, 48 * 1024))
        if function is None:
            function = ctypes.c_void_p()
            _call(self._driver, "cuModuleGetFunction", ctypes.byref(function), self._module, name.encode())
        if shared_bytes > allowed:
            _call(self._driver, "cuFuncSetAttribute", function, _DYNAMIC_SHARED_BYTES, shared_bytes)
            allowed = shared_bytes
        self._functions[name] = function, allowed
        return function


def compiled(source: str, capability: tuple[int, int], options: Sequence[str]) -> bytes:
    """Compile CUDA C to machine code (PTX for devices newer than NVRTC), or read it from the cache.

    Raises:
        GpuError: the source does not compile.
    """
    nvrtc = _nvrtc()
    version = (ctypes.c_int(), ctypes.c_int())
    _call(nvrtc, "nvrtcVersion", ctypes.byref(version[0]), ctypes.byref(version[1]))
    number = 10 * capability[0] + capability[1]
    newest = max(_supported(nvrtc))
    arch = f"sm_{number}" if number <= newest else f"compute_{newest}"
    options = (f"--gpu-architecture={arch}", "--std=c++17", "--use_fast_math", *options)
    key = repr((source, options, version[0].value, version[1].value))
    folder = _cache_folder()
    path = None if folder is None else folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.cubin"
    if path is not None and path.exists():
        return path.read_bytes()
    image = _compile(nvrtc, source, options, ptx=arch.startswith("compute"))
    if path is not None:
        with part_file(path, shared=True) as part:
            part.write_bytes(image)
    return image


def _cache_folder() -> Path | None:
    """Return the folder for compiled code; None if caching is off or the folder cannot be written."""
    folder = cache_folder("gpu")
    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


def _supported(nvrtc: Any) -> list[int]:
    count = ctypes.c_int()
    _call(nvrtc, "nvrtcGetNumSupportedArchs", ctypes.byref(count))
    archs = (ctypes.c_int * count.value)()
    _call(nvrtc, "nvrtcGetSupportedArchs", archs)
    return list(archs)


def _compile(nvrtc: Any, source: str, options: Sequence[str], *, ptx: bool) -> bytes:
    program, size = ctypes.c_void_p(), ctypes.c_size_t()
    _call(nvrtc, "nvrtcCreateProgram", ctypes.byref(program), source.encode(), b"h3data.cu", 0, None, None)
    try:
        words = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
        if nvrtc.nvrtcCompileProgram(program, len(options), words):
            nvrtc.nvrtcGetProgramLogSize(program, ctypes.byref(size))
            log = ctypes.create_string_buffer(size.value)
            nvrtc.nvrtcGetProgramLog(program, log)
            raise GpuError(
                f"The CUDA code did not compile:\n{log.value.decode(errors='replace')}", code="H3-RENDER-017"
            )
        kind = "PTX" if ptx else "CUBIN"
        _call(nvrtc, f"nvrtcGet{kind}Size", program, ctypes.byref(size))
        image = ctypes.create_string_buffer(size.value)
        _call(nvrtc, f"nvrtcGet{kind}", program, image)
        return image.raw
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


# --- the two libraries ----------------------------------------------------------------------------------------------
@functools.cache
def _driver() -> Any:
    try:
        return ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        raise GpuError(f"The CUDA driver's libcuda.so.1 cannot be loaded: {error}.", code="H3-RENDER-018") from None


@functools.cache
def _nvrtc() -> Any:
    """Return the NVRTC of torch's CUDA version, from torch itself, from NVIDIA's packages, or from the system."""
    import torch

    major = (torch.version.cuda or "").split(".")[0]
    beside = Path(torch.__file__).parent / "lib"
    site = Path(torch.__file__).parents[1]
    candidates = [
        path
        for path in sorted([*beside.glob("libnvrtc*.so*"), *site.glob("nvidia/*/lib/libnvrtc.so*")])
        if "builtins" not in path.name and "alt" not in path.name
    ]
    exact = [path for path in candidates if re.search(rf"\.so\.{major}\b", path.name)]
    for name in [*map(str, exact), f"libnvrtc.so.{major}", *map(str, candidates), "libnvrtc.so"]:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise GpuError(
        f"NVRTC of CUDA {major} was not found beside torch. "
        f"Hint: pip install nvidia-cuda-nvrtc{'-cu12' if major == '12' else ''}.",
        code="H3-RENDER-013",
    )


def _call(library: Any, name: str, *arguments: Any) -> None:
    status = getattr(library, name)(*arguments)
    if status:
        raise GpuError(f"{name} failed: {_words(library, name, status)}.", code="H3-RENDER-016")


def _words(library: Any, name: str, status: int) -> str:
    if name.startswith("nvrtc"):
        library.nvrtcGetErrorString.restype = ctypes.c_char_p
        return library.nvrtcGetErrorString(status).decode()
    text = ctypes.c_char_p()
    library.cuGetErrorString(status, ctypes.byref(text))
    return (text.value or b"unknown error").decode() + f" ({status})"
