"""Codec of episodes of social navigation, for episode files and the info of recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import lru_cache
from typing import Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.bodies.names import split_walk
from h3data.errors import InputError, SceneError
from h3data.plugins import names_from_data
from h3data.recording import Recording
from h3data.recording.assets.scenes import scene_attachment
from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode as FileEntry
from h3data.recording.task_episodes.social_nav_episodes import SocialNavEpisode, read_social_nav, social_nav_episode
from h3data.scene import FreeSpace, Scene, scene_digest
from sim_kinematic.agents.roster import ROBOT_BODY, make_roster, with_body
from sim_kinematic.agents.waypoint_walker import HumanPlan, human_plan
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.motion.state import HUMAN, ROBOT
from sim_kinematic.policies.assignment import AssignedPolicy
from sim_kinematic.policies.waypoints import WaypointPolicy
from sim_kinematic.tasks.codec import (
    SNAP_M,
    EpisodeCodec,
    EpisodePlace,
    SceneAndMap,
    malformed_info,
    read_rules,
    require_info,
    uid_of,
)
from sim_kinematic.tasks.episode import Episode, Starts, rules_dict
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rules.oracle import oracle_min_steps


class SocialNavCodec(EpisodeCodec[SocialNavEpisode]):
    """Codec of episodes that consist of two starts, the person's goals and the rules."""

    records_judgement: ClassVar[bool] = False

    def record(self, episode: Episode) -> SocialNavEpisode:
        """Return the record of an episode: its starts, all goals that the person can reach in time, and the rules.

        The record follows from scene, seed and rules alone, and `episode_from` makes the same episode from it, bit for
        bit.
        """
        robot, human = episode.starts.tolist()
        return SocialNavEpisode(
            robot_start=tuple(robot),
            human_start=tuple(human),
            human_goals=tuple((float(x), float(z)) for x, z in plan_of(episode).goals),
            floor_y=float(episode.free.height_at(episode.starts[ROBOT, :2])),
            max_steps=episode.spec.max_steps,
            seed=episode.seed,
            robot=f"robot/{episode.roster[ROBOT].model}",
            human=f"humanoid/{split_walk(episode.roster[HUMAN].model)[0]}",
            scene_sha256=scene_digest(episode.scene),
            scene_source=dict(episode.scene.source),
            rules=msgspec.to_builtins(rules_dict(episode.spec)),
        )

    def entry(
        self, record: SocialNavEpisode, *, episode_id: str, scene_id: str, scene_dataset_config: str = "default"
    ) -> FileEntry:
        """Return the entry of an episode file, in the format of Habitat's social navigation episodes."""
        return social_nav_episode(
            record, episode_id=episode_id, scene_id=scene_id, scene_dataset_config=scene_dataset_config
        )

    def read(self, entry: FileEntry, *, seed: int) -> SocialNavEpisode | None:
        """Return the record in an entry of a file; None if the entry belongs to another task."""
        return read_social_nav(entry)

    def rules(self, record: SocialNavEpisode) -> SocialNavSpec:
        """Return the rules in a record."""
        return read_rules(record.rules, SocialNavSpec, max_steps=record.max_steps)

    def episode(self, record: SocialNavEpisode, place: EpisodePlace) -> Episode:
        """Return the episode of a record in an opened scene."""
        return episode_from(record, place.scene, spec=place.spec, free=place.free, human=place.human, robot=place.robot)

    # --- recordings ---------------------------------------------------------------------------------------------------
    def restore(self, recording: Recording, scene: SceneAndMap) -> Episode:
        """Return the episode of a recording, from the rules and starts in its info.

        Raises:
            InputError: The recording lacks rules or starts, or its agents are not a robot and a person.
        """
        info, agents = recording.episode.info, recording.agents
        require_info(recording, "spec", "robot_start", "human_start")
        if [a.kind for a in agents] != ["robot", "human"]:
            raise InputError(
                f"Expected a robot and a human, in this order, got: {[a.kind for a in agents]}.", code="H3-TASK-054"
            )
        try:
            stored = msgspec.convert(
                {
                    "robot_start": info["robot_start"],
                    "human_start": info["human_start"],
                    # only the scripted person has goals that decide where they walk
                    "human_goals": info.get("human_goals", ())
                    if info.get("partner", "waypoints") == "waypoints"
                    else (),
                    "seed": recording.episode.seed,
                    "max_steps": info["spec"]["max_steps"],
                    "robot": agents[ROBOT].model,
                    "human": agents[HUMAN].model,
                    "rules": info["spec"],
                },
                SocialNavEpisode,
            )
        except (msgspec.ValidationError, KeyError, TypeError) as fault:
            raise malformed_info(fault) from None
        if not np.isfinite([*stored.robot_start, *stored.human_start, *np.ravel(stored.human_goals)]).all():
            raise InputError("The recording's starts and goals must be finite numbers.", code="H3-TASK-055")
        rules = self.rules(stored)
        home, free = scene(rules.agent_radius_m, rules.agent_height_m)
        return episode_from(stored, home, spec=rules, free=free)

    def instruction(self, episode: Episode) -> str:
        """Return the instruction in words, the same for all episodes."""
        return "follow the person"

    def info(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Return the policies, rules, starts and the person's goals for a recording's info."""
        spec, (robot, human) = episode.spec, episode.starts.tolist()
        info = {
            "policy": policies[ROBOT].name,
            "max_steps": spec.max_steps,
            "spec": rules_dict(spec),
            "robot_start": robot,
            "human_start": human,
        }
        if policies[HUMAN].name != "waypoints":
            info["partner"] = policies[HUMAN].name
        goals = goals_of(episode)
        # before the first step, so that a recording that ends in a crash can be continued
        if goals:
            info["human_goals"] = [list(goal) for goal in goals]
        return info

    def uid(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> str:
        """Return an identifier derived from scene, bodies, seed, policies, rules and, if they are given, goals."""
        digest = scene_attachment(episode.scene)[1]
        robot, human = episode.roster
        goals, partner = goals_of(episode), policies[HUMAN].name
        # without goals of a file, starts and goals follow from the seed
        told = f":{Starts.of(episode.starts)}:{goals}" if goals else ""
        policy = policies[ROBOT].name + ("" if partner == "waypoints" else f":{partner}")
        what = f"social_nav:{digest}:{robot.model}:{human.model}:{episode.seed}:{policy}:{episode.spec}{told}"
        return uid_of(what)

    def check_changes(self, recording: Recording, chosen: Mapping[str, Any]) -> None:
        """Raise an `InputError` if a policy is chosen for a person who follows a script."""
        if chosen.get("human") is not None and "external" not in str(recording.episode.info.get("partner", "")):
            raise InputError(
                "Nobody in recordings of social_nav follows a partner: the person walks by a script. Hint: leave it out.",
                code="H3-TASK-057",
            )

    def final_info(self, episode: Episode, play: WorldRollout, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Return the person's goals, and the least number of steps ``l`` in which an oracle finds the person.

        Both follow from the person's whole plan, regardless of the length of the episode. For a person without a
        script, they follow from the track that the person walked.
        """
        info: dict[str, Any] = {"ended": play.ended}
        if isinstance(policies[HUMAN].policy, WaypointPolicy):
            plan = plan_of(episode)
            info["human_goals"] = [[float(x), float(z)] for x, z in plan.goals]
            return {**info, "oracle_min_steps": _oracle(episode, plan.xz)}
        if play.memory.track:
            info["oracle_min_steps"] = _oracle(episode, np.array(play.memory.track))
        return info


def goals_of(episode: Episode) -> tuple[tuple[float, float], ...]:
    """Return the given points ``(x, z)`` [m] that the person walks to first; all later ones are sampled by the seed."""
    return tuple((float(x), float(z)) for x, z in episode.extra.get("human_goals", ()))


@lru_cache(maxsize=4)
def plan_of(episode: Episode) -> HumanPlan:
    """Return the whole walk of the scripted person, from the start to the time limit of an episode."""
    x, z, heading = episode.starts[HUMAN]
    return human_plan(
        episode.free,
        np.array([x, z]),
        float(heading),
        episode.seed,
        episode.spec.human,
        episode.spec.max_steps,
        goals_of(episode),
    )


def episode_from(
    episode: SocialNavEpisode,
    scene: Scene,
    *,
    spec: SocialNavSpec | None = None,
    free: FreeSpace | None = None,
    human: str | None = None,
    robot: str | None = None,
) -> Episode:
    """Return the episode that a record stores, in its scene.

    ``spec`` and the bodies ``human`` and ``robot`` replace those of the record; ``free`` saves computing the map again.

    Raises:
        SceneError: A start or a goal is off the free floor or on another island, so the scene must differ.
        InputError: There are no such rules or bodies.
    """
    rules: SocialNavSpec = spec or read_rules(episode.rules, SocialNavSpec, max_steps=episode.max_steps)
    free = free or FreeSpace.from_scene(scene, radius_m=rules.agent_radius_m, height_m=rules.agent_height_m)
    points = _on_free_floor(free, episode)
    robot_name = robot or episode.robot.removeprefix("robot/") or ROBOT_BODY
    human_name = with_body(human, episode.human.removeprefix("humanoid/"))
    headings = np.array([[episode.robot_start[2]], [episode.human_start[2]]])
    goals = [[float(x), float(z)] for x, z in points[2:]]
    # the user may name any robot, a file only those that are built in, installed or trusted
    with nullcontext() if robot else names_from_data():
        roster = make_roster(("robot", "human"), robot=robot_name, human=human_name)
    return Episode(
        scene=scene,
        free=free,
        seed=episode.seed,
        spec=rules,
        starts=np.hstack([points[:2], headings]),
        roster=roster,
        extra={"human_goals": goals} if goals else {},
    )


def _on_free_floor(free: FreeSpace, episode: SocialNavEpisode) -> np.ndarray:
    """Return starts and goals [2 + G, 2]; those that rounding has put beside the free floor are moved onto it."""
    points = np.array([episode.robot_start[:2], episode.human_start[:2], *episode.human_goals], np.float64)
    off = ~free.is_navigable(points)
    points[off] = free.snap(points[off], max_distance_m=SNAP_M)
    names = ["robot_start", "human_start", *(f"human_goals[{k}]" for k in range(len(points) - 2))]
    lost = [name for name, point in zip(names, points, strict=True) if np.isnan(point).any()]
    if lost:
        raise SceneError(
            f"{', '.join(lost[:4])}: more than {SNAP_M} m off the free floor of this scene. Expected the scene for which "
            "the episode was made.",
            code="H3-TASK-050",
        )
    if len(set(free.island(points).tolist())) > 1:
        raise SceneError(
            "The starts and goals of the episode are not on one island of this scene's free floor.", code="H3-TASK-051"
        )
    return points


def _oracle(episode: Episode, track: NDArray[np.float64]) -> Any:
    """Return the fewest steps in which a robot could find a person on a track [E, 2]; None: in none of them."""
    # by the limits of the robot itself, which may be slower than the rules allow
    x, z, heading = episode.starts[ROBOT]
    return oracle_min_steps(
        episode.free, np.array([x, z]), float(heading), track, replace(episode.spec, robot=episode.bases[ROBOT])
    )
