"""Speed, measured: ``python -m benchmarks [GROUP]`` prints flat ``name value unit`` lines (names: ARCHITECTURE.md)."""
