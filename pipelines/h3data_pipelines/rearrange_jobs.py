"""Episodes of social rearrangement to simulate: one job each, for datasets and for tables of robots by partners."""

from __future__ import annotations

import json
import traceback
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from h3data.errors import InputError
from h3data.recording import Agent, AssetRef, Body, Episode, Recording
from h3data.scene.scene_sets import SceneSource
from h3data_pipelines.episode_jobs import Changes, set_episodes
from sim_kinematic.rearrange_episode import RearrangeSpec

if TYPE_CHECKING:
    from sim_kinematic.cast import Member
    from sim_kinematic.rearrange_episode import RearrangeWorld


@dataclass(frozen=True, kw_only=True)
class RearrangeJob:
    """One episode: all that a worker needs to know."""

    index: int
    seed: int
    scene: str
    """As the command line names it."""
    source: SceneSource
    policy: str
    partner: str
    human: str | None
    spec: RearrangeSpec
    agents: str | None = None
    """Who is there (`sim_kinematic.cast.cast_of`); None: the robot and the person of the paper."""
    origin: dict[str, Any] | None = None
    """Which episode of which set it is."""

    def to_json(self) -> dict[str, Any]:
        """What decides the episode, as JSON gives it back."""
        fields = json.loads(msgspec.json.encode(replace(self, origin=None)))
        return {name: value for name, value in fields.items() if name != "origin" and (name, value) != ("agents", None)}

    @property
    def cast(self) -> tuple[Member, ...]:
        """The agents that are recorded."""
        return recorded_cast(self.agents, self.policy)

    def world(self) -> RearrangeWorld:
        """Scene, objects, goals, starts and rules, ready to run."""
        from h3data.interop.scene_names import open_free_space, open_scene
        from sim_kinematic.rearrange_episode import PAIR, RearrangeWorld

        free = open_free_space(self.source, self.spec.agent_radius_m, self.spec.agent_height_m)
        return RearrangeWorld.create(
            open_scene(self.source), seed=self.seed, spec=self.spec, free=free, human=self.human or "female_0",
            agents=self.agents or PAIR,
        )  # fmt: skip

    def record(self) -> Recording:
        """Play it. An episode that raises gives a recording without rows whose info says why: the job goes on."""
        from sim_kinematic.rearrange import simulate_rearrange

        try:
            return simulate_rearrange(
                self.world(), policy=self.policy, partner=self.partner, episode_id=f"{self.index:06d}"
            )
        except MemoryError:
            raise
        except Exception as fault:
            return failed_recording(self, fault)


def recorded_cast(agents: str | None, policy: str) -> tuple[Member, ...]:
    """Who is in the recordings of these agents under this policy.

    Raises:
        InputError: there are no such agents, or nobody is left.
    """
    from sim_kinematic.cast import cast_of
    from sim_kinematic.rearrange_episode import PAIR
    from sim_kinematic.rearrange_log import SOLO

    cast = cast_of(PAIR if agents is None else agents)
    people = tuple(member for member in cast if member.kind == "human")
    if policy == SOLO and not people:
        raise InputError(
            "The policy solo leaves robots away, so somebody else must be there. Expected a person in --agents."
        )
    return people if policy == SOLO else cast


def reason_of(fault: Exception) -> str:
    """One line about what went wrong, and where."""
    frame = traceback.extract_tb(fault.__traceback__)[-1]
    return f"{type(fault).__name__}: {fault} ({Path(frame.filename).name}, line {frame.lineno})"


def failed_recording(job: RearrangeJob, fault: Exception) -> Recording:
    """The place of an episode that raised, in its dataset: no rows, the error in ``info["failed"]``."""
    from h3data.bodies import Robot
    from sim_kinematic.rearrange_log import DTYPES, TASK

    objects = job.spec.objects
    shapes = {
        "base_pose": (7,), "root_pose": (7,), "joint_quat": (54, 4),
        "action": (2,), "metrics.at_goal": (objects,),
        "object_pose": (objects, 7),
    }  # fmt: skip
    robot = ("base_pose", "joint_pos", "action", "grasp_body", "skill", "skill_target")
    person = ("base_pose", "root_pose", "joint_quat", "grasp_body", "skill", "skill_target")
    cast = job.cast
    agents = [robot if member.kind == "robot" else person for member in cast]
    robots = [member.body for member in cast if isinstance(member.body, Robot)]
    shapes |= {f"agent_{i}.joint_pos": (len(body.rest),) for i, body in enumerate(robots)}
    names = [f"agent_{i}.{name}" for i, of in enumerate(agents) for name in of]
    names += ["object_pose", "metrics.at_goal", "metrics.reward"]
    names += ["metrics.dist_agents", "metrics.collision"] if len(cast) > 1 else []
    names += ["metrics.robot_contact"] if robots else []
    columns: dict[str, np.ndarray] = {"time_ns": np.zeros(0, np.int64), "state_hash": np.zeros(0, np.uint64)}
    for name in names:
        key = name.partition(".")[2] if name.startswith("agent_") else name
        columns[name] = np.zeros((0, *shapes.get(name, shapes.get(key, ()))), DTYPES[key])
    info = {
        "failed": reason_of(fault), "policy": job.policy, "partner": job.partner, "max_steps": job.spec.max_steps,
        "solo_steps": None, "goal_objects": [],
    }  # fmt: skip
    nowhere = np.full(7, np.nan, np.float32)
    bodies = tuple(Body(name=f"object_{k}", asset="unknown", pose=nowhere, moving=k) for k in range(objects))
    return Recording(
        episode=Episode(
            uid=str(uuid.uuid5(uuid.NAMESPACE_URL, f"h3data:failed:{json.dumps(job.to_json())}")),
            episode_id=f"{job.index:06d}", task=TASK, scene=job.scene, seed=job.seed, info=info,
        ),
        agents=tuple(Agent(name=member.name, kind=member.kind) for member in cast),
        assets=(AssetRef(name="unknown", uri="primitive:none"),), bodies=bodies, columns=columns,
    )  # fmt: skip


def rules(
    *, human_speed: float | None = None, max_steps: int | None = None, spawn_distance: float | None = None
) -> RearrangeSpec:
    """The rules with what the user asks for; None leaves the paper's."""
    spec = RearrangeSpec()
    if human_speed is not None:
        spec = replace(spec, human=replace(spec.human, speed_mps=human_speed))
    if max_steps is not None:
        spec = replace(spec, max_steps=max_steps)
    return spec if spawn_distance is None else replace(spec, spawn_distance_m=spawn_distance)


def rearrange_jobs(
    scenes: str, *, episodes: int | None, seed: int, policy: str, partner: str, human: str | None, spec: RearrangeSpec,
    agents: str | None = None, homes: int = 4, assets: Sequence[str | Path] = (), allow_missing: bool = False,
) -> list[RearrangeJob]:  # fmt: skip
    """Episodes in the scenes that ``scenes`` means: all of a set by default, else 10.

    Raises:
        InputError: no such scenes, agents, policy or partner; the message lists what there is.
    """
    from h3data.interop.scene_names import named_scenes
    from h3data.scene.scene_sets import find_scene_set
    from sim_kinematic.cast import kinds_of
    from sim_kinematic.learned import stamped
    from sim_kinematic.randomness import episode_seed
    from sim_kinematic.rearrange import minds_of

    policy, partner = (",".join(map(stamped, names.split(","))) for names in (policy, partner))
    minds_of(kinds_of(recorded_cast(agents, policy)), policy, partner, seed=seed, objects=spec.objects)
    bodies = Changes(policy=policy, human=human)

    def job(index: int, drawn: int, scene: str, source: SceneSource, origin: dict[str, Any] | None) -> RearrangeJob:
        return RearrangeJob(
            index=index, seed=drawn, scene=scene, source=source, policy=policy, partner=partner,
            human=bodies.body(drawn), spec=spec, agents=agents, origin=origin,
        )  # fmt: skip

    label, _, which = scenes.partition("#")
    found = find_scene_set(label)
    if found is None:
        named = named_scenes(scenes, homes=homes, assets=assets, allow_missing=allow_missing)
        places = [named[i % len(named)] for i in range(10 if episodes is None else episodes)]
        return [job(i, episode_seed(seed, i), place.name, place.source, None) for i, place in enumerate(places)]
    if "#" in scenes:
        found = replace(found, scenes=(found.entry(which),))
    return [job(*episode) for episode in set_episodes(found, episodes=episodes, seed=seed)]
