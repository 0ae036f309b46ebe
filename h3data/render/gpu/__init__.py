"""The renderer for NVIDIA GPUs: thousands of worlds a launch, outputs as torch tensors on the device."""

from h3data.render.gpu.auto import AutoEngine
from h3data.render.gpu.cuda import GpuError, gpu_problem
from h3data.render.gpu.engine import GpuEngine
from h3data.render.gpu.renderer import GpuRenderer
from h3data.render.gpu.stage import GpuScene

__all__ = ["AutoEngine", "GpuEngine", "GpuError", "GpuRenderer", "GpuScene", "gpu_problem"]
