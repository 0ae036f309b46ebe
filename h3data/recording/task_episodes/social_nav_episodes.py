"""Social-navigation episodes in Habitat's files: the starts and way points that Habitat itself draws anew every time.

Habitat stores neither where the two agents begin nor where the person walks (spec/habitat.md 1.2). Ours lie under
``info["h3data"]``, which Habitat carries along unread, so that one file serves both.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from h3data.bodies.names import split_walk
from h3data.errors import InputError
from h3data.recording import Recording
from h3data.recording.task_episodes.rearrange_episode import Matrix, RearrangeEpisode, RigidObject
from h3data.recording.task_episodes.stored_episodes import Start, info_block, plain, read_info_block, start_fields

TASK = "social_nav"


class SocialNavEpisode(msgspec.Struct, frozen=True, kw_only=True):
    """Who begins where and where the person walks: all that a simulator needs besides the scene."""

    robot_start: Start
    human_start: Start
    human_goals: tuple[tuple[float, float], ...]
    """Floor points ``(x, z)`` that the person walks to one after the other, on shortest paths [m]."""
    goals_within_m: float = 0.0
    """Largest distance of a goal from the one that was truly walked to [m]; 0 = exact."""
    goals_complete: bool = True
    """True if the person needs no further goal in ``max_steps``; False where an episode ended early."""
    floor_y: float = 0.0
    """Height of the floor [m]."""
    max_steps: int = 1500
    seed: int = 0
    robot: str = ""
    """Model, such as ``robot/quad_arm``."""
    human: str = ""
    scene_sha256: str = ""
    """Digest of the scene (`h3data.scene.scene_digest`), to tell that it is the same home."""
    scene_source: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Source from which the scene is made again: generator and seed, or file."""
    rules: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Speeds, distances and so on, as ``SocialNavSpec`` names them."""
    recording: str = ""
    """uid of the recording that it was taken from."""


def social_nav_episode(
    nav: SocialNavEpisode,
    *,
    episode_id: str,
    scene_id: str,
    scene_dataset_config: str = "default",
    rigid_objects: Sequence[RigidObject] = (),
    targets: Mapping[str, Matrix] | None = None,
) -> RearrangeEpisode:
    """A Habitat episode that carries ``nav``; `write_episodes` writes it, `read_social_nav` gets it back.

    Habitat's own fields hold the robot's start. Its social-navigation task also looks for a target object when it
    resets (spec/habitat.md 1.2); give it one by ``rigid_objects`` and ``targets`` if the file is to be run there.
    """
    _require_finite(nav)
    return RearrangeEpisode(
        episode_id=episode_id,
        scene_id=scene_id,
        scene_dataset_config=scene_dataset_config,
        **start_fields(nav.robot_start, nav.floor_y),
        rigid_objects=tuple(sorted(rigid_objects, key=lambda thing: thing.config)),
        targets=targets or {},
        info=info_block(TASK, nav),
    )


def read_social_nav(episode: RearrangeEpisode) -> SocialNavEpisode | None:
    """The starts and way points that an episode carries; None if it has none of ours.

    Raises:
        FormatError: ours, but damaged or from a newer version.
    """
    return read_info_block(episode, TASK, SocialNavEpisode)


def social_nav_of(recording: Recording) -> SocialNavEpisode:
    """Starts and way points of a recorded episode, to run it again with another policy.

    The person's goals are taken from ``episode.info["human_goals"]`` if they are there, else from the ``new_goal``
    events, which name them to the centimetre (``goals_within_m``).

    Raises:
        InputError: the recording is of another task, or does not say where they began.
    """
    info = recording.episode.info
    name = recording.episode.episode_id
    if recording.episode.task != TASK:
        raise InputError(
            f"Expected a recording of social_nav, {name!r} is one of {recording.episode.task!r}.", code="H3-HABITAT-039"
        )
    robots = [k for k, agent in enumerate(recording.agents) if agent.kind == "robot"]
    humans = [k for k, agent in enumerate(recording.agents) if agent.kind == "human"]
    if len(robots) != 1 or len(humans) != 1 or not len(recording):
        raise InputError(
            f"Expected one robot, one human and some steps, {name!r} has {len(robots)}, {len(humans)}, {len(recording)}.",
            code="H3-HABITAT-040",
        )
    goals, within = _goals(recording, humans[0])
    floor_y = float(recording.agent_column(robots[0], "base_pose")[0, 1])
    try:
        nav = msgspec.convert(
            {
                "robot_start": info.get("robot_start"),
                "human_start": info.get("human_start"),
                "human_goals": goals,
                "goals_within_m": within,
                "goals_complete": len(recording) >= int(info.get("max_steps", 0)) > 0,
                "floor_y": floor_y,
                "max_steps": info.get("max_steps", len(recording)),
                "seed": recording.episode.seed,
                "robot": recording.agents[robots[0]].model,
                "human": split_walk(recording.agents[humans[0]].model)[0],
                "scene_sha256": info.get("scene_sha256", ""),
                "scene_source": plain(info.get("scene_source", {})),
                "rules": plain(info.get("spec", {})),
                "recording": recording.episode.uid,
            },
            SocialNavEpisode,
        )
    except (msgspec.ValidationError, TypeError, ValueError) as fault:
        raise InputError(
            f"The info of recording {name!r} lacks something: {str(fault).replace('`', '')}", code="H3-HABITAT-043"
        ) from None
    _require_finite(nav)
    return nav


_POINT = re.compile(r"\((-?\d+\.?\d*), (-?\d+\.?\d*)\)")


def _goals(recording: Recording, human: int) -> tuple[Any, float]:
    """The person's goals, and how far they may be off [m]."""
    exact = recording.episode.info.get("human_goals")
    if exact is not None:
        return exact, 0.0
    goals: list[tuple[float, float]] = []
    for event in recording.events:
        if event.kind != "new_goal" or event.agent != human:
            continue
        point = _POINT.fullmatch(event.detail)
        if point is None:
            raise InputError(
                f"Expected a point like (1.20, -3.40) in the event of step {event.step}, got {event.detail!r}.",
                code="H3-HABITAT-044",
            )
        goals.append((float(point[1]), float(point[2])))
    column = recording.columns.get("sim.human_goal")
    count = int(np.max(column)) + 1 if column is not None and len(column) else len(goals)
    if count != len(goals):
        raise InputError(
            f"Recording {recording.episode.episode_id!r} has {len(goals)} events new_goal, its steps speak of {count}.",
            code="H3-HABITAT-041",
        )
    return goals, 0.01


def _require_finite(nav: SocialNavEpisode) -> None:
    numbers = [*nav.robot_start, *nav.human_start, *(v for goal in nav.human_goals for v in goal), nav.floor_y]
    if not all(map(math.isfinite, numbers)):
        raise InputError(
            "Expected finite starts and way points, there is a NaN or an infinity among them.", code="H3-HABITAT-042"
        )
