"""From steps to a recording: what social navigation writes down, block by block, and what it says about itself."""

from __future__ import annotations

import importlib.metadata
import io
import uuid
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import ground_pose
from h3data.recording import (
    STEP_NS,
    Agent,
    AssetRef,
    Body,
    Episode,
    Event,
    Recording,
    RecordingHeader,
    SkillSpan,
    state_hash,
)
from h3data.scene import CATEGORIES, Scene, save_scene, scene_digest
from sim_kinematic.policies.social_nav import ROBOT_SKILLS
from sim_kinematic.sensing.sensor import facing

if TYPE_CHECKING:
    from sim_kinematic.tasks.social_nav import SocialNavWorld

HUMAN_SKILLS = ("walk", "turn")
BLOCK = 30
"""Rows that are handed to the sink at once: one second."""


class Sink(Protocol):
    """What receives an episode while it runs; `h3data.recording.RecordingWriter` does."""

    def append(self, rows: dict[str, NDArray[Any]]) -> None: ...

    def event(self, event: Event) -> None: ...

    def skill(self, span: SkillSpan) -> int: ...

    def close(self, *, info: dict[str, Any]) -> object: ...

    def abort(self) -> None: ...


class Step(NamedTuple):
    """What one step leaves behind, plain numbers: the state after it, the command, and what was seen."""

    robot_x: float
    robot_z: float
    robot_heading: float
    robot_contact: bool
    human_x: float
    human_z: float
    human_heading: float
    human_distance: float
    human_blend: float
    human_left_arm: float
    human_right_arm: float
    human_skill: int
    human_goal: int
    human_leg: int
    forward: float
    turn: float
    robot_skill: int
    geodesic: float
    collision: bool


def columns_of(world: SocialNavWorld, clip: int, first: int, steps: list[Step]) -> dict[str, NDArray[Any]]:
    """The columns of consecutive steps, of which the first is number ``first`` of the episode."""
    of = dict(zip(Step._fields, np.array(steps, np.float64).T, strict=True))
    n = len(steps)
    robot_xz = np.stack([of["robot_x"], of["robot_z"]], -1)
    human_xz = np.stack([of["human_x"], of["human_z"]], -1)
    apart = human_xz - robot_xz
    floor = world.free.floor_y
    arms = np.stack([of["human_left_arm"], of["human_right_arm"]], -1).astype(np.float32)
    return {
        "time_ns": np.arange(first + 1, first + n + 1, dtype=np.int64) * STEP_NS,
        "agent_0.base_pose": ground_pose(robot_xz, of["robot_heading"], floor).astype(np.float32),
        "agent_0.joint_pos": np.tile(world.robot.rest.astype(np.float32), (n, 1)),
        "agent_0.grasp_body": np.full(n, -1, np.int32),
        "agent_0.action": np.stack([of["forward"], of["turn"]], -1).astype(np.float32),
        "agent_0.skill": of["robot_skill"].astype(np.int32),
        "agent_1.base_pose": ground_pose(human_xz, of["human_heading"], floor).astype(np.float32),
        "agent_1.motion_id": np.full(n, clip, np.int32),
        "agent_1.motion_phase": motion_phase(world, clip, of["human_distance"]),
        "agent_1.motion_blend": of["human_blend"].astype(np.float32),
        **({"agent_1.motion_arms": arms} if world.spec.human.arms is not None else {}),
        "agent_1.grasp_body": np.full(n, -1, np.int32),
        "agent_1.skill": of["human_skill"].astype(np.int32),
        "sim.human_goal": of["human_goal"].astype(np.int32),
        "sim.human_leg": of["human_leg"].astype(np.int32),
        "metrics.dist_agents": np.hypot(apart[:, 0], apart[:, 1]).astype(np.float32),
        "metrics.geodesic_agents": of["geodesic"].astype(np.float32),
        "metrics.facing": facing(robot_xz, of["robot_heading"], human_xz).astype(np.float32),
        "metrics.collision": of["collision"].astype(np.bool_),
        "metrics.robot_contact": of["robot_contact"].astype(np.bool_),
    }


def motion_phase(world: SocialNavWorld, clip: int, distance: NDArray[np.float64]) -> NDArray[np.float32]:
    """Place in the walking cycle after having walked ``distance`` [...] [m] since setting off."""
    walk = world.human.clips[clip]
    return ((walk.start_phase + distance / walk.stride_m) % 1.0).astype(np.float32)


@dataclass
class EpisodeLog:
    """The episode as it grows: steps become blocks of columns, handed on to a sink together with the events."""

    world: SocialNavWorld
    clip: int
    """The clip that the person plays."""
    sink: Sink | None
    steps: list[Step] = field(default_factory=list)
    blocks: list[dict[str, NDArray[Any]]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    def add(self, step: Step) -> None:
        self.steps.append(step)
        if len(self.steps) == BLOCK:
            self._close_block()

    def event(self, event: Event) -> None:
        self.events.append(event)
        if self.sink is not None:
            self.sink.event(event)

    def _close_block(self) -> None:
        if not self.steps:
            return
        first = sum(len(b["time_ns"]) for b in self.blocks)
        block = columns_of(self.world, self.clip, first, self.steps)
        last_hash = int(self.blocks[-1]["state_hash"][-1]) if self.blocks else 0
        block["state_hash"] = state_hash(block, previous=last_hash)
        if self.sink is not None:
            self.sink.append(block)
        self.blocks.append(block)
        self.steps = []

    def columns(self) -> dict[str, NDArray[Any]]:
        """All rows so far."""
        self._close_block()
        return {name: np.concatenate([b[name] for b in self.blocks]) for name in self.blocks[0]}


def describe(world: SocialNavWorld, *, episode_id: str, policy: str) -> RecordingHeader:
    """What is known before the first step: who and what is there, under which rules."""
    scene, spec, starts = world.scene, world.spec, world.starts
    file, digest = scene_attachment(scene)
    agents = (
        Agent(
            name="robot", kind="robot", model=f"robot/{world.robot_name}", semantic_id=200,
            joint_names=tuple(world.robot.joint_names), action_names=("forward", "turn_left"), skill_names=ROBOT_SKILLS,
        ),
        Agent(
            name="human", kind="human", model=f"humanoid/{world.human_name}", semantic_id=100,
            motion_names=tuple(c.name for c in world.human.clips), skill_names=HUMAN_SKILLS,
        ),
    )  # fmt: skip
    bodies_of = f"{world.robot_name}:{world.human_name}"
    info = {
        "policy": policy,
        "max_steps": spec.max_steps,
        "spec": asdict(spec),
        "robot_start": [*map(float, starts.robot_xz), starts.robot_heading],
        "human_start": [*map(float, starts.human_xz), starts.human_heading],
        "scene_source": dict(scene.source),
        "scene_sha256": digest,
        "categories": list(CATEGORIES),
    }
    if world.goals:  # known before the first step: what a crash leaves can be continued
        info["human_goals"] = [list(goal) for goal in world.goals]
    told = f":{starts}:{world.goals}" if world.goals else ""  # else they follow from the seed
    what = f"h3data:social_nav:{digest}:{bodies_of}:{world.seed}:{policy}:{spec}{told}"
    episode = Episode(
        uid=str(uuid.uuid5(uuid.NAMESPACE_URL, what)),
        episode_id=episode_id, task="social_nav", scene=scene.name, seed=world.seed,
        created_by=f"h3data {importlib.metadata.version('h3data')}", info=info,
    )  # fmt: skip
    return RecordingHeader(
        episode=episode,
        assets=tuple(AssetRef(name=name, uri=f"scene:{name}") for name in scene.assets),
        bodies=scene_bodies(scene),
        agents=agents,
        attachments={"scene.glb": file},
    )


@lru_cache(maxsize=4)
def scene_attachment(scene: Scene) -> tuple[bytes, str]:
    """The scene file and its digest: the same for all episodes in this home."""
    buffer = io.BytesIO()
    save_scene(scene, buffer)
    return buffer.getvalue(), scene_digest(scene)


def scene_bodies(scene: Scene) -> tuple[Body, ...]:
    """Everything in a home as bodies that never move."""
    return tuple(
        Body(
            name=i.name, asset=i.asset, pose=i.pose.astype(np.float32), scale=i.scale.astype(np.float32),
            semantic_id=i.semantic_id, layer=i.layer,
        )
        for i in scene.instances
    )  # fmt: skip


def skill_spans(columns: dict[str, NDArray[Any]], agents: tuple[Agent, ...]) -> tuple[SkillSpan, ...]:
    """The runs of equal codes in each agent's ``skill`` column, as spans."""
    spans = []
    for index, agent in enumerate(agents):
        codes = columns.get(f"agent_{index}.skill")
        if codes is None or not len(codes):
            continue
        starts = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
        ends = np.append(starts[1:], len(codes)) - 1
        spans += [
            SkillSpan(agent=index, name=agent.skill_names[codes[a]], start_step=int(a), end_step=int(b))
            for a, b in zip(starts, ends, strict=True)
            if codes[a] >= 0
        ]
    return tuple(spans)


def finished(
    header: RecordingHeader, columns: dict[str, NDArray[Any]], info: dict[str, Any], events: list[Event]
) -> Recording:
    """The whole recording, with what is known only at the end."""
    episode = replace(header.episode, info={**header.episode.info, **info})
    return Recording(
        episode=episode, assets=header.assets, bodies=header.bodies, agents=header.agents, columns=columns,
        skills=skill_spans(columns, header.agents), events=tuple(events), attachments=header.attachments,
    )  # fmt: skip
