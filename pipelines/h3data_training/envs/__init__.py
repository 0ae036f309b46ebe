"""Environments whose worlds are tensors on a torch device: what `h3data.make(task, device=...)` returns.

The functions are entry points of `h3data.device_envs`, by the name of the task.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from h3data.errors import InputError
from sim_kinematic.tasks.sources import Scenes

if TYPE_CHECKING:
    from h3data_training.envs.rearrange_torch_env import RearrangeTorchEnv
    from h3data_training.envs.social_nav_torch_env import SocialNavTorchEnv


def make_social_nav(
    worlds: int, scenes: Scenes, *, device: Any, agents: Sequence[str], **options: Any
) -> SocialNavTorchEnv:
    """Social navigation of the robot; ``options`` are those of `SocialNavTorchEnv`.

    Raises:
        InputError: others than the robot are asked to act, or an option is wrong.
    """
    if tuple(agents) != ("robot",):
        raise InputError(
            "On a torch device only the robot acts in social_nav. Hint: leave out agents or device.", code="H3-ENV-001"
        )
    from h3data_training.envs.social_nav_torch_env import SocialNavTorchEnv

    return SocialNavTorchEnv(worlds, scenes, device=device, **options)


def make_rearrange(
    worlds: int, scenes: Scenes, *, device: Any, agents: Sequence[str], **options: Any
) -> RearrangeTorchEnv:
    """Rearrangement with oracle skills; ``options`` are those of `RearrangeTorchEnv`.

    Raises:
        InputError: an option is wrong.
    """
    from h3data_training.envs.rearrange_torch_env import RearrangeTorchEnv

    return RearrangeTorchEnv(worlds, scenes, device=device, agents=agents, **options)
