"""What `h3data.make` calls: one function per task, named in the entry points of the group ``h3data.tasks``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from h3data.errors import InputError
from h3data.scene import Scene

if TYPE_CHECKING:
    from sim_kinematic.envs.rearrange_env import RearrangeEnv
    from sim_kinematic.envs.rearrange_parallel_env import RearrangeParallelEnv
    from sim_kinematic.envs.rearrange_vector_env import RearrangeVectorEnv
    from sim_kinematic.envs.social_nav_env import SocialNavEnv
    from sim_kinematic.envs.social_nav_parallel_env import SocialNavParallelEnv
    from sim_kinematic.envs.social_nav_torch_env import SocialNavTorchEnv
    from sim_kinematic.envs.social_nav_vector_env import SocialNavVectorEnv


def social_nav(
    scenes: str | Scene | Sequence[str | Scene] = "h3-homes/train",
    *,
    num_envs: int | None = None,
    device: Any = None,
    agents: Sequence[str] = ("robot",),
    **options: Any,
) -> SocialNavEnv | SocialNavVectorEnv | SocialNavParallelEnv | SocialNavTorchEnv:
    """Social navigation: `SocialNavEnv`; with ``num_envs`` `SocialNavVectorEnv`; with a torch
    ``device`` as well `SocialNavTorchEnv`; with ``agents=("robot", "human")`` `SocialNavParallelEnv`, which has one world.

    Raises:
        InputError: scenes, agents or an option are none that we know, or both ``num_envs`` and two agents are wanted.
    """
    if sorted(agents) not in (["robot"], ["human", "robot"]):
        raise InputError(f"Expected agents ('robot',) or ('robot', 'human'), got {agents!r}.")
    if len(agents) == 2:
        if num_envs is not None or device is not None:
            raise InputError(
                "An environment of two agents has one world, on no device. Hint: leave out num_envs and device."
            )
        from sim_kinematic.envs.social_nav_parallel_env import SocialNavParallelEnv

        return SocialNavParallelEnv(scenes, **options)
    if device is not None:
        from sim_kinematic.envs.social_nav_torch_env import SocialNavTorchEnv

        return SocialNavTorchEnv(1 if num_envs is None else num_envs, scenes, device=device, **options)
    if num_envs is not None:
        from sim_kinematic.envs.social_nav_vector_env import SocialNavVectorEnv

        return SocialNavVectorEnv(num_envs, scenes, **options)
    from sim_kinematic.envs.social_nav_env import SocialNavEnv

    return SocialNavEnv(scenes, **options)


def rearrange(
    scenes: str | Scene | Sequence[str | Scene] = "h3-homes/train",
    *,
    num_envs: int | None = None,
    agents: Sequence[str] = ("robot",),
    **options: Any,
) -> RearrangeEnv | RearrangeParallelEnv | RearrangeVectorEnv:
    """Social rearrangement: `RearrangeEnv` of a robot or, with ``agents=("human",)``, of a person; with ``num_envs``
    `RearrangeVectorEnv`; with both agents `RearrangeParallelEnv`, which has one world.

    Raises:
        InputError: scenes, agents or an option are none that we know, or both ``num_envs`` and two agents are wanted.
    """
    if sorted(agents) not in (["robot"], ["human"], ["human", "robot"]):
        raise InputError(f"Expected agents ('robot',), ('human',) or ('robot', 'human'), got {agents!r}.")
    if len(agents) == 2:
        if num_envs is not None:
            raise InputError("An environment of two agents has one world. Hint: leave out num_envs.")
        from sim_kinematic.envs.rearrange_parallel_env import RearrangeParallelEnv

        return RearrangeParallelEnv(scenes, **options)
    if num_envs is not None:
        from sim_kinematic.envs.rearrange_vector_env import RearrangeVectorEnv

        return RearrangeVectorEnv(num_envs, scenes, agent=agents[0], **options)
    from sim_kinematic.envs.rearrange_env import RearrangeEnv

    return RearrangeEnv(scenes, agent=agents[0], **options)
