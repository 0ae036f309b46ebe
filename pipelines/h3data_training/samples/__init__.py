"""Training samples from datasets, for PyTorch's data loaders."""

from h3data_training.samples.windows import WindowDataset

__all__ = ["WindowDataset"]
