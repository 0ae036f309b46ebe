"""Training environments of h3data and their Gymnasium ids, which are registered when this module is imported.

```python
import gymnasium
import h3data

gymnasium.make("h3data/SocialNav-v0", scenes="small:1")
gymnasium.make_vec("h3data/SocialNav-v0", num_envs=64)
gymnasium.make("h3data:h3data/Rearrange-v0")  # without any other import: Gymnasium imports the module
```

Keyword arguments are those of `h3data.make`. Gymnasium 1.0 dropped entry points for plug-ins, so that a package has to
register its environments when it is imported. ``import h3data`` does so too, before or after ``import gymnasium``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from h3data.errors import MissingExtraError
from h3data.moved import lazy_names
from h3data.plugins import own_entries

if TYPE_CHECKING:
    from h3data_training.envs.dataset_env import DatasetEnv
    from sim_kinematic.envs.make import make
    from sim_kinematic.envs.parallel import TaskParallelEnv
    from sim_kinematic.envs.single import TaskEnv
    from sim_kinematic.envs.stepper import Options, Stepper
    from sim_kinematic.envs.vector import TaskVectorEnv

__all__ = ["IDS", "DatasetEnv", "Options", "Stepper", "TaskEnv", "TaskParallelEnv", "TaskVectorEnv", "make"]

try:
    import gymnasium
except ImportError as error:
    raise MissingExtraError(
        "Environments need Gymnasium. Hint: pip install 'h3data[env]'", code="H3-FILE-008"
    ) from error

IDS = {f"h3data/{name.title().replace('_', '')}-v0": name for name in own_entries("h3data.tasks")}
"""Names of tasks by Gymnasium id."""

for _id, _task in IDS.items():
    if _id not in gymnasium.registry:  # a reload would make Gymnasium warn
        gymnasium.register(_id, entry_point="h3data:make", vector_entry_point="h3data:make", kwargs={"task": _task})

# imported when they are asked for: what is here needs more than registering ids does
__getattr__ = lazy_names(
    __name__,
    {
        "DatasetEnv": "h3data_training.envs.dataset_env",
        "Options": "sim_kinematic.envs.stepper",
        "Stepper": "sim_kinematic.envs.stepper",
        "TaskEnv": "sim_kinematic.envs.single",
        "TaskParallelEnv": "sim_kinematic.envs.parallel",
        "TaskVectorEnv": "sim_kinematic.envs.vector",
        "make": "sim_kinematic.envs.make",
    },
)
