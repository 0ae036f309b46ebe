"""Social-navigation episodes in Habitat's files: starts and waypoints, which Habitat itself samples again at each reset.

Habitat stores neither the start poses of the two agents nor the waypoints of the person (spec/habitat.md 1.2). h3data
stores them under ``info["h3data"]``, which Habitat ignores, so both programs can use the same file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from h3data.errors import InputError
from h3data.recording.task_episodes.rearrange_episode import Matrix, RearrangeEpisode, RigidObject
from h3data.recording.task_episodes.stored_episodes import Start, info_block, read_info_block, start_fields

TASK = "social_nav"


class SocialNavEpisode(msgspec.Struct, frozen=True, kw_only=True):
    """Starts of both agents and waypoints of the person: all data that a simulator needs besides the scene."""

    robot_start: Start
    human_start: Start
    human_goals: tuple[tuple[float, float], ...]
    """Floor points ``(x, z)`` [m] to which the person walks in this order, on shortest paths."""
    goals_within_m: float = 0.0
    """Largest distance between a goal and the position to which the person actually walked [m]; 0 = exact."""
    goals_complete: bool = True
    """True if the person needs no further goal in ``max_steps``; False where an episode ended early."""
    floor_y: float = 0.0
    """Height of the floor [m]."""
    max_steps: int = 1500
    seed: int = 0
    robot: str = ""
    """Model of the robot, such as ``robot/quad_arm``."""
    human: str = ""
    scene_sha256: str = ""
    """Digest of the scene (`h3data.scene.scene_digest`), which identifies the home."""
    scene_source: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Source of the scene: generator and seed, or file."""
    rules: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Rules of the episode, such as speeds and distances, by the field names of ``SocialNavSpec``."""
    recording: str = ""
    """Identity (uid) of the recording from which the episode was taken."""


def social_nav_episode(
    nav: SocialNavEpisode,
    *,
    episode_id: str,
    scene_id: str,
    scene_dataset_config: str = "default",
    rigid_objects: Sequence[RigidObject] = (),
    targets: Mapping[str, Matrix] | None = None,
) -> RearrangeEpisode:
    """Return a Habitat episode that contains ``nav``, for `write_episodes`; `read_social_nav` is the inverse.

    Habitat's own fields hold the robot's start. Its social-navigation task also looks for a target object when it
    resets (spec/habitat.md 1.2); provide one by ``rigid_objects`` and ``targets`` if the file is for use in Habitat.
    """
    require_finite(nav)
    return RearrangeEpisode(
        episode_id=episode_id,
        scene_id=scene_id,
        scene_dataset_config=scene_dataset_config,
        **start_fields(nav.robot_start, nav.floor_y),
        # Habitat adds objects in the order of their templates, and numbers the handles so
        rigid_objects=tuple(sorted(rigid_objects, key=lambda thing: thing.config)),
        targets=targets or {},
        info=info_block(TASK, nav),
    )


def read_social_nav(episode: RearrangeEpisode) -> SocialNavEpisode | None:
    """Return the starts and waypoints in an episode of h3data; None for other episodes.

    Raises:
        FormatError: an episode of h3data is damaged or from a newer version.
    """
    return read_info_block(episode, TASK, SocialNavEpisode)


def require_finite(nav: SocialNavEpisode) -> None:
    """Raise an InputError if a start or waypoint is NaN or infinite."""
    numbers = [*nav.robot_start, *nav.human_start, *(v for goal in nav.human_goals for v in goal), nav.floor_y]
    if not all(map(math.isfinite, numbers)):
        raise InputError(
            "Expected finite starts and waypoints, there is a NaN or an infinity among them.", code="H3-HABITAT-042"
        )
