"""Gymnasium ids of the built-in tasks, registered by importing this module.

```python
import gymnasium
import h3data.envs

gymnasium.make("h3data/SocialNav-v0", scenes="small:1")
gymnasium.make_vec("h3data/SocialNav-v0", num_envs=64)
gymnasium.make("h3data.envs:h3data/Rearrange-v0")  # without any other import: Gymnasium imports the module
```

Keyword arguments are those of `h3data.make`. Gymnasium 1.0 dropped entry points for plug-ins, so that a package has to register
its environments when it is imported; `h3data` itself does not, because ``import h3data`` must not import Gymnasium.
"""

from __future__ import annotations

from h3data.errors import MissingExtraError

try:
    import gymnasium
except ImportError as error:
    raise MissingExtraError(
        "Environments need Gymnasium. Hint: pip install 'h3data[env]'", code="H3-FILE-008"
    ) from error

IDS = {"h3data/SocialNav-v0": "social_nav", "h3data/Rearrange-v0": "rearrange", "h3data/Wander-v0": "wander"}
"""Name of the task by id."""

for _id, _task in IDS.items():
    if _id not in gymnasium.registry:  # a reload would make Gymnasium warn
        gymnasium.register(
            _id, entry_point="h3data.api:make", vector_entry_point="h3data.api:make", kwargs={"task": _task}
        )
