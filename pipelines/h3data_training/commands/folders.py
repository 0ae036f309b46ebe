"""Folders of training runs, which are checked for disk space, and cleared of an earlier run by ``--force``."""

from __future__ import annotations

import shutil
from pathlib import Path

from h3data.commands.command import claim_folder
from h3data.errors import InputError

LEFT = (
    "checkpoint.pt",
    "policy.npz",
    "partner_*.npz",
    "curve.parquet",
    "tensorboard",
    "episodes.json.gz",
    "episodes.npz",
    "starts.npz",
)
"""Names of files that runs write into their folders (h3data docs training, h3data docs populations, h3data docs
skills)."""


def run_folder(
    out: Path, *, force: bool, resume: bool, device: str, checkpoint_bytes: int, keep: Path | None = None
) -> Path:
    """Prepare the folder of a training run.

    With ``force``, all files of an earlier run are deleted, because its partners, starts and learning curve would
    otherwise be mistaken for those of the new run.

    Args:
        out: the folder.
        force: True starts from the beginning.
        resume: True continues from the last checkpoint.
        device: device of the run, which is checked before anything is deleted.
        checkpoint_bytes: size of a checkpoint; there must be room for two.
        keep: a file of the folder that is not deleted.

    Raises:
        InputError: the folder is not empty, the disk is full, or there is no such device.
    """
    left = any(path for pattern in LEFT for path in out.glob(pattern))
    unfinished = "a training run" if left else ""
    folder, needed = claim_folder(out, force=force or resume, unfinished=lambda: unfinished), 2 * checkpoint_bytes
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise InputError(
            f"Expected {needed >> 20} MiB of free disk for checkpoints, got {free >> 20}. Folder: {folder}",
            code="H3-TRAIN-007",
        )
    if force:
        from h3data_training.envs.torch_env import checked_device

        checked_device(device)
        for path in (path for pattern in LEFT for path in folder.glob(pattern)):
            if path.is_dir():
                shutil.rmtree(path)
            elif keep is None or path.resolve() != keep.resolve():
                path.unlink()
    return folder
