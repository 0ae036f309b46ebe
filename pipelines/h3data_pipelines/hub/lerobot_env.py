"""Folder with the ``env.py`` that LeRobot expects on the Hub, which provides the environment of a dataset."""

from __future__ import annotations

from pathlib import Path

from h3data.errors import InputError
from h3data.recording import Dataset
from h3data.recording.demonstrations import read_demonstrations
from h3data.recording.storage import local

# nothing of the dataset goes into Python code but the checked name of its repository
_ENV = '''"""Environment of the dataset {repo}, which shows policies what they have learned from.

    from lerobot.envs.factory import make_env

    envs = make_env("{repo}", n_envs=2, trust_remote_code=True)
"""

from __future__ import annotations

import os

REPO = "{repo}"
"""The dataset on the Hub. H3DATA_ENV_DATASET names a folder that is used instead."""


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    """Return Gymnasium's vector environment; ``cfg`` may have ``dataset``, the folder of the dataset, and ``episodes``."""
    from lerobot_env_h3data.env import make_vector

    folder = getattr(cfg, "dataset", None) or os.environ.get("H3DATA_ENV_DATASET")
    if folder is None:
        from huggingface_hub import snapshot_download

        folder = snapshot_download(REPO, repo_type="dataset")
    return make_vector(folder, n_envs, use_async_envs, episodes=getattr(cfg, "episodes", None) or "sampled")
'''
_README = """---
tags:
- LeRobot
- h3data
---

# Environment of {repo}

`env.py` makes the environment of the dataset [{repo}](https://huggingface.co/datasets/{repo}) for LeRobot
({instruction}). It shows a policy what the dataset held: {shown}.

```bash
pip install -r requirements.txt
```
```python
from lerobot.envs.factory import make_env

envs = make_env("{repo}", n_envs=2, trust_remote_code=True)
```
"""
FILES = ("env.py", "requirements.txt", "README.md")


def write_env(dataset: Dataset, folder: Path, *, repo: str) -> list[Path]:
    """Write ``env.py``, ``requirements.txt`` and ``README.md`` for the Hub dataset ``repo``, and return their paths.

    LeRobot looks for ``env.py`` in a model repository, which is separate from the dataset repository of the same name.

    Raises:
        InputError: the dataset was not exported to LeRobot, or the folder holds different files with these names.
    """
    shown = read_demonstrations(dataset.root)
    cameras = ", ".join(f"{camera.key} [{camera.stored_height}, {camera.stored_width}, 3]" for camera in shown.cameras)
    facts = {
        "repo": repo,
        "instruction": shown.instruction or shown.task,
        "shown": f"{shown.state_key} [{len(shown.state_names)}]" + (f", {cameras}" if cameras else ""),
    }
    texts = (_ENV.format(**facts), "h3data[env]\nlerobot_env_h3data\nhuggingface_hub\n", _README.format(**facts))
    paths = [local(folder) / name for name in FILES]
    for path, text in zip(paths, texts, strict=True):
        if path.exists() and path.read_text(encoding="utf-8") != text:
            raise InputError(
                f"Another file of this name is there. Hint: give --env an empty folder: {path}", code="H3-HUB-017"
            )
    paths[0].parent.mkdir(parents=True, exist_ok=True)
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text, encoding="utf-8")
    return paths
