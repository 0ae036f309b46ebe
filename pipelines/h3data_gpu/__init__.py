"""Renderer for NVIDIA GPUs, with thousands of worlds per launch and torch tensors as outputs (h3data docs gpu).

- `renderer`: `GpuRenderer`; `engine`, `auto`: the back ends ``gpu`` and ``auto`` of `h3data.render.Renderer`
- `gpu_scene`: the moving parts of a scene; `packing`, `pool`, `deformables`, `meshlets`: scenes as arrays for the kernels
- `cuda`: NVRTC and the driver; `layout`: the kernels' structs; `views`: cameras; `shader`: ids, normals and RGB
"""

from h3data_gpu.auto import AutoEngine
from h3data_gpu.cuda import GpuError, gpu_problem
from h3data_gpu.engine import GpuEngine
from h3data_gpu.gpu_scene import GpuScene
from h3data_gpu.renderer import GpuRenderer

__all__ = ["AutoEngine", "GpuEngine", "GpuError", "GpuRenderer", "GpuScene", "gpu_problem"]
