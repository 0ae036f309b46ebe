"""What `h3data.make` calls: one function per task, named in the entry points of the group ``h3data.tasks``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from h3data.errors import InputError
from h3data.scene import Scene

if TYPE_CHECKING:
    from gymnasium.vector import SyncVectorEnv

    from sim_kinematic.env import SocialNavEnv
    from sim_kinematic.parallel_env import SocialNavParallelEnv
    from sim_kinematic.rearrange_env import RearrangeEnv
    from sim_kinematic.rearrange_parallel_env import RearrangeParallelEnv
    from sim_kinematic.torch_env import SocialNavTorchEnv
    from sim_kinematic.vector_env import SocialNavVectorEnv


def social_nav(
    scenes: str | Scene | Sequence[str | Scene] = "h3-homes/train",
    *,
    worlds: int | None = None,
    num_envs: int | None = None,
    device: Any = None,
    agents: Sequence[str] = ("robot",),
    **options: Any,
) -> SocialNavEnv | SocialNavVectorEnv | SocialNavParallelEnv | SocialNavTorchEnv:
    """Social navigation: `SocialNavEnv`; with ``worlds`` (Gymnasium's ``num_envs``) `SocialNavVectorEnv`; with a torch
    ``device`` as well `SocialNavTorchEnv`; with ``agents=("robot", "human")`` `SocialNavParallelEnv`, which has one world.

    Raises:
        InputError: scenes, agents or an option are none that we know, or both ``worlds`` and two agents are wanted.
    """
    if worlds is not None and num_envs is not None:
        raise InputError("worlds and num_envs are the same. Hint: leave out one.")
    worlds = num_envs if worlds is None else worlds
    if sorted(agents) not in (["robot"], ["human", "robot"]):
        raise InputError(f"Expected agents ('robot',) or ('robot', 'human'), got {agents!r}.")
    if len(agents) == 2:
        if worlds is not None or device is not None:
            raise InputError(
                "An environment of two agents has one world, on no device. Hint: leave out worlds and device."
            )
        from sim_kinematic.parallel_env import SocialNavParallelEnv

        return SocialNavParallelEnv(scenes, **options)
    if device is not None:
        from sim_kinematic.torch_env import SocialNavTorchEnv

        return SocialNavTorchEnv(1 if worlds is None else worlds, scenes, device=device, **options)
    if worlds is not None:
        from sim_kinematic.vector_env import SocialNavVectorEnv

        return SocialNavVectorEnv(worlds, scenes, **options)
    from sim_kinematic.env import SocialNavEnv

    return SocialNavEnv(scenes, **options)


def rearrange(
    scenes: str | Scene | Sequence[str | Scene] = "h3-homes/train",
    *,
    worlds: int | None = None,
    agents: Sequence[str] = ("robot",),
    **options: Any,
) -> RearrangeEnv | RearrangeParallelEnv | SyncVectorEnv:
    """Social rearrangement: `RearrangeEnv` of a robot or, with ``agents=("human",)``, of a person; with ``worlds`` so many of
    them in Gymnasium's `SyncVectorEnv`; with both agents `RearrangeParallelEnv`, which has one world.

    Raises:
        InputError: scenes, agents or an option are none that we know, or both ``worlds`` and two agents are wanted.
    """
    if sorted(agents) not in (["robot"], ["human"], ["human", "robot"]):
        raise InputError(f"Expected agents ('robot',), ('human',) or ('robot', 'human'), got {agents!r}.")
    if len(agents) == 2:
        if worlds is not None:
            raise InputError("An environment of two agents has one world. Hint: leave out worlds.")
        from sim_kinematic.rearrange_parallel_env import RearrangeParallelEnv

        return RearrangeParallelEnv(scenes, **options)
    from sim_kinematic.rearrange_env import RearrangeEnv

    if worlds is None:
        return RearrangeEnv(scenes, agent=agents[0], **options)
    if isinstance(worlds, bool) or not isinstance(worlds, int) or worlds < 1:
        raise InputError(f"Expected at least 1 world, a whole number, got {worlds!r}.")
    from gymnasium.vector import SyncVectorEnv

    return SyncVectorEnv([lambda: RearrangeEnv(scenes, agent=agents[0], **options)] * worlds)
