"""``--force`` of ``h3data train``: nothing of an earlier run stays, and nothing is deleted by a command that cannot run."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from h3data.errors import InputError
from h3data_training.commands.folders import run_folder

RUN = ("checkpoint.pt", "policy.npz", "partner_0.npz", "curve.parquet", "episodes.npz", "tensorboard/events")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An earlier run, and a file that is none of its own."""
    for name in (*RUN, "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    return tmp_path


def claim(folder: Path, *, force: bool = True, device: str = "cpu", keep: Path | None = None) -> list[str]:
    run_folder(folder, force=force, resume=False, device=device, checkpoint_bytes=1, keep=keep)
    return sorted(path.name for path in folder.iterdir())


def test_force_leaves_nothing_of_an_earlier_run(folder: Path) -> None:
    assert claim(folder, keep=folder / "episodes.npz") == ["episodes.npz", "notes.txt"]
    assert claim(folder) == ["notes.txt"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_nothing_is_deleted_for_a_device_that_is_not_there(folder: Path) -> None:
    for device in ("cuda", "tpu"):
        with pytest.raises(InputError, match=r"H3-ENV-01(3|7)"):
            claim(folder, device=device)
    with pytest.raises(InputError, match=r"(?s)a training run.*H3-OPTION-009"):
        claim(folder, force=False)
    assert all((folder / name).is_file() for name in RUN)
