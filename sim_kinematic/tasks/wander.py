"""Any robots and people who wander about a home from one random point to another, recorded: the least that a mix of agents
can do."""

from __future__ import annotations

import importlib.metadata
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.errors import InputError
from h3data.geometry import ground_pose, wrap_angle
from h3data.recording import STEP_NS, Agent, AssetRef, Episode, Event, Recording, state_hash
from h3data.scene import CATEGORIES, FreeSpace, Scene
from sim_kinematic.agents.waypoint_walker import WaypointHuman
from sim_kinematic.avoidance.robot_base import footprint_of
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.velocity import keep_clear
from sim_kinematic.avoidance.yielding import Seen, avoided, in_the_way, waits
from sim_kinematic.contact.frames import walking_phase
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.motion.spec import STEP_S, SocialNavSpec
from sim_kinematic.motion.state import HumanState, RobotState
from sim_kinematic.tasks.social_nav_log import scene_attachment, scene_bodies
from sim_kinematic.world import AgentWorlds

ARRIVED_M = 0.3
"""A robot is at its way point when it is this near."""
GIVES_UP_STEPS = 30
"""Who has not got on for so long goes elsewhere."""


class Wanderers:
    """Moves everybody in the first of some worlds."""

    def __init__(self, worlds: AgentWorlds, seed: int) -> None:
        self._worlds = worlds
        walker = worlds.spec.human
        self._walkers = [
            WaypointHuman(floor, episode_seed(seed, k), walker) for k, floor in enumerate(worlds.floors)
        ]  # fmt: skip
        self._before = [own.xz[0].copy() for own in worlds.state.agents]
        people = [AVOIDANCE.person] * len(worlds.state.people)
        self._footprints = [*(footprint_of(base) for base in worlds.bases), *people]
        self._stood = [0] * len(worlds.cast)

    def actions(self) -> list[NDArray[np.float64]]:
        """What each agent does next, as `AgentWorlds.step` takes it, [1, 2] each."""
        agents = self._worlds.state.agents
        seen = [
            Seen(
                k, own.xz[0].copy(), (own.xz[0] - was) / STEP_S, False, isinstance(own, RobotState), footprint=footprint
            )
            for k, (own, was, footprint) in enumerate(zip(agents, self._before, self._footprints, strict=True))
        ]  # fmt: skip
        self._before = [own.xz[0].copy() for own in agents]
        result = []
        for k, own in enumerate(agents):
            others = sorted(
                (s for s in seen if s.number != k), key=lambda s: float(np.hypot(*(s.xz - own.xz[0])))
            )  # fmt: skip
            self._stood[k] = self._stood[k] + 1 if np.hypot(*seen[k].velocity) < AVOIDANCE.stands_mps else 0
            if self._stood[k] > GIVES_UP_STEPS:
                self._stood[k], self._walkers[k].leg = 0, 1_000_000  # the next goal
            act = self._drive(k, own, others) if isinstance(own, RobotState) else self._walk(k, own, others)
            result.append(act[None])
        return result

    def _walk(self, k: int, own: HumanState, others: Sequence[Seen]) -> NDArray[np.float64]:
        target = self._walkers[k].target(own.xz[0])
        blocker = in_the_way(own.xz[0], target, others)
        if blocker is None:
            return target
        stands = float(np.hypot(*blocker.velocity)) <= AVOIDANCE.stands_mps
        is_close = float(np.hypot(*(blocker.xz - own.xz[0]))) < AVOIDANCE.apart_m
        return own.xz[0].copy() if stands or is_close or waits(k, blocker) else target

    def _drive(self, k: int, own: RobotState, others: Sequence[Seen]) -> NDArray[np.float64]:
        walker, base = self._walkers[k], self._worlds.bases[k]
        target = walker.target(own.xz[0])
        while np.hypot(*(target - own.xz[0])) < ARRIVED_M:
            walker.leg += 1
            target = walker.target(own.xz[0])
        dx, dz = target - own.xz[0]
        error = float(wrap_angle(np.arctan2(-dz, dx) - own.heading[0]))
        turn = float(np.clip(error / (base.max_turn_rad_s * STEP_S), -1, 1))
        command = max(0.0, float(np.cos(error))) ** 4, turn
        command = keep_clear(
            self._worlds.free, base, own.xz[0].copy(), float(own.heading[0]), command, target, avoided(others)
        )
        return np.array(command, np.float32).astype(np.float64)


def simulate_wander(
    scene: Scene, agents: str | Sequence[str] = ("robot", "human"), *, seed: int = 0, steps: int = 300,
    spec: SocialNavSpec | None = None, free: FreeSpace | None = None, episode_id: str = "0",
) -> Recording:  # fmt: skip
    """Everybody wanders about for so many steps. The same seed gives the same recording, bit for bit.

    Columns are those of every task (docs/format.md); ``metrics.collision`` says whether anybody touches anybody, an event
    ``collision`` who whom.

    Raises:
        InputError: there are no such agents, or not at least one step.
        SceneError: there is no room for them.
    """
    if steps < 1:
        raise InputError(f"Expected at least 1 step, got {steps}.")
    worlds = AgentWorlds(scene, agents, spec=spec, free=free)
    worlds.reset(seed)
    places = [[*own.xz[0].tolist(), float(own.heading[0])] for own in worlds.state.agents]
    columns, events = wander(worlds, seed, steps)
    file, digest = scene_attachment(scene)
    models = ",".join(member.model for member in worlds.cast)
    episode = Episode(
        uid=str(uuid.uuid5(uuid.NAMESPACE_URL, f"h3data:wander:{digest}:{models}:{seed}:{steps}:{worlds.spec}")),
        episode_id=episode_id, task="wander", scene=scene.name, seed=seed,
        created_by=f"h3data {importlib.metadata.version('h3data')}",
        info={
            "max_steps": steps, "spec": asdict(worlds.spec), "starts": places,
            "scene_source": dict(scene.source), "scene_sha256": digest, "categories": list(CATEGORIES),
        },
    )  # fmt: skip
    return Recording(
        episode=episode, assets=tuple(AssetRef(name=name, uri=f"scene:{name}") for name in scene.assets),
        bodies=scene_bodies(scene),
        agents=tuple(_agent(worlds, k) for k in range(len(worlds.cast))), columns=columns, events=tuple(events),
        attachments={"scene.glb": file},
    )  # fmt: skip


def wander(
    worlds: AgentWorlds, seed: int, steps: int, commands: Mapping[int, NDArray[np.floating]] | None = None
) -> tuple[dict[str, NDArray[Any]], list[Event]]:
    """Columns and events of so many steps from where everybody is.

    ``commands`` [T, 2], by number of a robot, take the place of what it would do in its first T steps.
    """
    minds, rows, events = Wanderers(worlds, seed), [], list[Event]()
    before = np.zeros(len(worlds.pairs), np.bool_)
    for step in range(steps):
        actions = minds.actions()
        for k, told in (commands or {}).items():
            if step < len(told):
                actions[k] = told[step : step + 1].astype(np.float64)
        touching = worlds.step(actions)[0]
        for p in np.flatnonzero(touching & ~before):
            a, b = worlds.pairs[p]
            events.append(Event(step=step, agent=a, kind="collision", target=worlds.cast[b].name))
        before = touching.copy()
        rows.append(_row(worlds, actions))
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    columns = {"time_ns": np.arange(1, steps + 1, dtype=np.int64) * STEP_NS, **columns}
    columns["state_hash"] = state_hash(columns)
    return columns, events


def _agent(worlds: AgentWorlds, number: int) -> Agent:
    member = worlds.cast[number]
    if isinstance(member.body, Robot):
        return Agent(
            name=member.name, kind="robot", model=f"robot/{member.model}", semantic_id=200,
            joint_names=tuple(member.body.joint_names), action_names=("forward", "turn_left"),
        )  # fmt: skip
    return Agent(
        name=member.name, kind="human", model=f"humanoid/{member.model}", semantic_id=100,
        motion_names=tuple(clip.name for clip in member.body.clips),
    )  # fmt: skip


def _row(worlds: AgentWorlds, actions: Sequence[NDArray[np.float64]]) -> dict[str, Any]:
    """The columns of one step."""
    row: dict[str, Any] = {}
    floor_y, state = worlds.free.floor_y, worlds.state
    for k, (member, own) in enumerate(zip(worlds.cast, state.agents, strict=True)):
        at = f"agent_{k}."
        row[at + "base_pose"] = ground_pose(own.xz[0], own.heading[0], floor_y).astype(np.float32)
        if isinstance(own, RobotState):
            row[at + "joint_pos"] = own.joints[0].astype(np.float32)
            row[at + "action"] = actions[k][0].astype(np.float32)
        elif not isinstance(member.body, Robot):
            clip = member.body.clip_for_speed(worlds.spec.human.speed_mps)
            row[at + "motion_id"] = np.int32(clip)
            row[at + "motion_phase"] = walking_phase(member.body, clip, own)[0].astype(np.float32)
            row[at + "motion_blend"] = own.blend[0].astype(np.float32)
            if worlds.spec.human.arms is not None:
                row[at + "motion_arms"] = own.arms[0].astype(np.float32)
        row[at + "grasp_body"] = np.int32(-1)
    if worlds.pairs:
        gaps = [np.hypot(*(state.agents[a].xz[0] - state.agents[b].xz[0])) for a, b in worlds.pairs]
        row["metrics.dist_agents"] = np.float32(min(gaps))
        row["metrics.collision"] = np.bool_(worlds.touching[0].any())
    if state.robots:
        row["metrics.robot_contact"] = np.bool_(any(own.contact[0] for own in state.robots))
    return row
