"""Command ``h3data doctor``, which checks the installation on this machine."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from h3data.commands.command import JsonFlag, Outcome
from h3data.files import cache_folder, size_text
from h3data_pipelines.machine.caches import cache_lines, find_caches

CPU_TORCH = "pip install --force-reinstall torch --index-url https://download.pytorch.org/whl/cpu"

_PACKAGES = (
    "numpy",
    "numba",
    "scipy",
    "shapely",
    "torch",
    "trimesh",
    "python-fcl",
    "mcap",
    "pyarrow",
    "rerun-sdk",
    "opencv-python-headless",
    "av",
    "msgspec",
    "jinja2",
    "tyro",
)

_OPTIONAL = ("compiled kernels", "browser (h3data play)", "GPU (torch CUDA)", "Hugging Face Hub")
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "microsoft-edge", "firefox")


@dataclass(frozen=True)
class Doctor:
    """Check the installation and list its files on this machine.

    The checks cover renderers, video codecs, collision, browsers, the GPU, the Hugging Face Hub, package versions, free
    disk space and caches.

    Examples:
        h3data doctor
        h3data doctor --json
    """

    json: JsonFlag = False

    def run(self) -> Outcome:
        """Run all checks and return their results."""
        checks = {
            "CPU renderer (numba)": _cpu_renderer,
            "compiled kernels": _kernels,
            "collision (FCL)": _collision,
            "video (PyAV, FFmpeg)": _video,
            "Rerun files": _rerun,
            "built-in bodies and robots": _builtin,
            "browser (h3data play)": _browser,
            "GPU (torch CUDA)": _gpu,
            "Hugging Face Hub": _hub,
        }
        caches = find_caches()
        disks = _disks()
        results = {name: _attempt(check) for name, check in checks.items()}
        versions = {name: _version(name) for name in ("h3data", *_PACKAGES)}
        data: dict[str, Any] = {
            "python": sys.version.split()[0],
            "platform": platform.platform(),
            "cpus": os.cpu_count(),
            "checks": results,
            "versions": versions,
            "free_bytes": disks,
            "caches": {cache.name: cache.row() for cache in caches},
        }
        required = [name for name in results if name not in _OPTIONAL]
        broken = [name for name in required if not results[name]["ok"]]
        lines = [f"Python {data['python']} on {data['platform']}, {data['cpus']} CPUs", ""]
        lines += [f"  {'ok ' if r['ok'] else 'no '} {name:<28} {r['detail']}" for name, r in results.items()]
        lines += ["", "  " + ", ".join(f"{name} {version or 'MISSING'}" for name, version in versions.items())]
        lines += ["", "Free disk space", *(f"  {free / 1e9:9.1f} GB  {place}" for place, free in disks.items())]
        lines += ["", "Caches, which `h3data cache clear [NAME ...]` deletes", *cache_lines(caches)]
        if broken:
            lines += ["", f"Not working: {', '.join(broken)}. Hint: pip install --force-reinstall h3data"]
        return Outcome(text="\n".join(lines), data=data, exit_code=1 if broken else 0)


def _attempt(check: Callable[[], str]) -> dict[str, Any]:
    try:
        return {"ok": True, "detail": check()}
    except Exception as error:  # every failure is a finding here, whatever its type
        return {"ok": False, "detail": f"{type(error).__name__}: {error}".splitlines()[0]}


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _cpu_renderer() -> str:
    import llvmlite.binding as llvm
    import numpy as np

    from h3data.render import Renderer, RenderInstance, RenderScene, pinhole
    from h3data.scene import Mesh

    triangle = Mesh(
        vertices=np.array([[-9, -9, 2], [9, -9, 2], [0, 9, 2]], np.float32),
        faces=np.array([[0, 1, 2]], np.int32),
        colors=np.full((3, 3), 200, np.uint8),
    )
    scene = RenderScene([triangle], [RenderInstance(mesh=0, matrix=np.eye(4))])
    depth = Renderer(scene).render(pinhole(32, 24, hfov_deg=60), outputs=("depth",))["depth"]
    if abs(float(depth[12, 16]) - 2.0) > 1e-4:
        raise RuntimeError(f"a wall at 2 m is rendered at {depth[12, 16]} m")
    features = llvm.get_host_cpu_features()
    simd = next((name for name in ("avx512f", "avx2", "avx", "sse4.2", "neon") if features.get(name)), "scalar")
    return f"depth exact, SIMD {simd}"


def _collision() -> str:
    import fcl
    import numpy as np

    a = fcl.CollisionObject(fcl.Sphere(0.5), fcl.Transform(np.array([0.9, 0.0, 0.0])))
    b = fcl.CollisionObject(fcl.Sphere(0.5))
    if not fcl.collide(a, b, fcl.CollisionRequest(), fcl.CollisionResult()):
        raise RuntimeError("two overlapping spheres do not collide")
    return "primitives collide"


def _video() -> str:
    import av

    encoders = []
    for name in ("libx264", "libsvtav1", "libaom-av1"):
        try:
            encoders.append(av.Codec(name, "w").name)
        except ValueError:
            if name == "libx264":  # the one that all our videos need
                raise
    libraries = {name: ".".join(map(str, number)) for name, number in av.library_versions.items()}
    shown = ", ".join(f"{name} {libraries[name]}" for name in ("libavcodec", "libavformat", "libswscale"))
    return f"encoders {', '.join(encoders)}; PyAV {av.__version__}, {shown}"


def _kernels() -> str:
    """Return whether kernels that came compiled fit this machine."""
    from h3data.kernels import shipped

    folders = shipped.folders()
    if not folders:
        raise RuntimeError(f"{shipped.missing()} (not needed: all are compiled at first use, a minute in all)")
    sizes = {folder: [file.stat().st_size for file in folder.iterdir()] for folder in folders}
    return "; ".join(f"{len(files)}, {size_text(sum(files))}, in {folder}" for folder, files in sizes.items())


def _browser() -> str:
    """Return the browsers on this machine; people may also play from any other one."""
    found = []
    for name in _BROWSERS:
        if path := shutil.which(name):
            done = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=20, check=False)
            found.append((done.stdout.strip().splitlines() or [f"{name} of unknown version"])[-1])
    if not found:
        raise RuntimeError(f"none of {', '.join(_BROWSERS)} (not needed: any browser of the network can play)")
    return ", ".join(dict.fromkeys(found))


def _disks() -> dict[str, int]:
    """Return the free space [bytes] where results, temporary files and caches go."""
    places = [Path.cwd(), Path(tempfile.gettempdir())]
    if (cache := cache_folder("")) is not None:
        places.append(next(path for path in (cache, *cache.parents) if path.exists()))
    return {str(place): shutil.disk_usage(place).free for place in places}


def _rerun() -> str:
    import rerun

    return f"rerun {rerun.__version__}"


def _builtin() -> str:
    from h3data.builtin import builtin_root

    root = builtin_root()
    bodies = sorted(p.stem for p in (root / "bodies").glob("*.npz"))
    robots = sorted(p.name for p in (root / "robots").iterdir() if p.is_dir())
    if not bodies or not robots:
        raise RuntimeError(f"expected bodies and robots, found {bodies} and {robots}")
    return ", ".join([*bodies, *robots])


def _hub() -> str:
    try:
        import huggingface_hub
    except ImportError:
        raise RuntimeError('for push and pull: pip install "h3data[hub]"') from None
    token = "a token" if huggingface_hub.get_token() else "no token: hf auth login"
    return f"huggingface_hub {huggingface_hub.__version__}, {token}"


def _gpu() -> str:
    import torch

    if not torch.cuda.is_available():
        hint = (
            f"; torch {torch.__version__} brought gigabytes of CUDA: {CPU_TORCH} frees them"
            if torch.version.cuda
            else ""
        )
        raise RuntimeError(f"no CUDA device (not needed{hint})")
    return torch.cuda.get_device_name(0)
