"""Compiled functions: the decorators `kernel` and `kernel_part`, and what this process has compiled.

Many kernels come compiled, as files of the package ``h3data_kernels`` (`h3data.kernels.shipped`). All others are compiled
at first use and kept by numba, in ``NUMBA_CACHE_DIR`` or beside the package (`h3data.kernels.decorators`).
"""

from h3data.kernels.decorators import compiled_count, compiled_files, kernel, kernel_part

__all__ = ["compiled_count", "compiled_files", "kernel", "kernel_part"]
