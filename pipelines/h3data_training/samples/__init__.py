"""Training samples from datasets, for PyTorch's loaders."""

from h3data_training.samples.windows import WindowDataset

__all__ = ["WindowDataset"]
