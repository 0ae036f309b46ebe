"""The renderer for NVIDIA GPUs: thousands of worlds a launch, outputs as torch tensors on the device."""

from h3data.render.gpu.cuda import GpuError, gpu_problem
from h3data.render.gpu.packing import GpuScene
from h3data.render.gpu.renderer import GpuRenderer

__all__ = ["GpuError", "GpuRenderer", "GpuScene", "gpu_problem"]
