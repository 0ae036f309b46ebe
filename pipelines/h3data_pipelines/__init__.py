"""Jobs over many episodes and the commands of `h3data` (ARCHITECTURE.md)."""

import h3data  # noqa: F401 - from then on, imports of modules that have moved say where they are
