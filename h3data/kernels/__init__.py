"""Compiled functions (kernels): the decorators `kernel` and `kernel_part`, and a list of kernels compiled in this process.

Many kernels are shipped in compiled form, as files of the package ``h3data_kernels`` (`h3data.kernels.shipped`). All
others are compiled at first use and cached by numba, in ``NUMBA_CACHE_DIR`` or next to the package
(`h3data.kernels.decorators`).
"""

from h3data.kernels.decorators import compiled_count, compiled_files, kernel, kernel_part

__all__ = ["compiled_count", "compiled_files", "kernel", "kernel_part"]
