"""What social rearrangement writes down, step by step, and what it says about itself."""

from __future__ import annotations

import importlib.metadata
import uuid
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.recording import (
    STEP_NS,
    Agent,
    AssetRef,
    Episode,
    Event,
    Recording,
    RecordingHeader,
    SkillSpan,
    state_hash,
)
from h3data.scene import CATEGORIES
from sim_kinematic.agents.roster import kinds_of
from sim_kinematic.agents.skills import SKILLS
from sim_kinematic.policies.rearrange import POPULATIONS, ZSC
from sim_kinematic.tasks.social_nav_log import BLOCK, Sink, scene_attachment, scene_bodies

if TYPE_CHECKING:
    from sim_kinematic.tasks.rearrange.episode import RearrangeWorld

TASK, SOLO = "rearrange", "solo"
DTYPES: dict[str, type] = {
    "base_pose": np.float32, "joint_pos": np.float32, "root_pose": np.float32, "joint_quat": np.float32,
    "grasp_body": np.int32, "action": np.float32, "skill": np.int32, "skill_target": np.int32, "object_pose": np.float32,
    "metrics.at_goal": np.bool_, "metrics.dist_agents": np.float32, "metrics.collision": np.bool_,
    "metrics.robot_contact": np.bool_, "metrics.reward": np.float32,
}  # fmt: skip
"""Of the columns of a step; those of agents without ``agent_<i>.``."""

Row = dict[str, Any]


@dataclass
class RearrangeLog:
    """The episode as it grows: rows become blocks of columns, handed on to a sink together with events and skills."""

    sink: Sink | None
    rows: list[Row] = field(default_factory=list)
    blocks: list[dict[str, NDArray[Any]]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    skills: list[SkillSpan] = field(default_factory=list)

    def add(self, row: Row) -> None:
        self.rows.append(row)
        if len(self.rows) == BLOCK:
            self._close_block()

    def event(self, event: Event) -> None:
        self.events.append(event)
        if self.sink is not None:
            self.sink.event(event)

    def skill(self, span: SkillSpan) -> None:
        self.skills.append(span)
        if self.sink is not None:
            self.sink.skill(span)

    def _close_block(self) -> None:
        if not self.rows:
            return
        first = sum(len(b["time_ns"]) for b in self.blocks)
        count = len(self.rows)
        block: dict[str, NDArray[Any]] = {"time_ns": np.arange(first + 1, first + count + 1, dtype=np.int64) * STEP_NS}
        for name in self.rows[0]:
            dtype = DTYPES[name.partition(".")[2] if name.startswith("agent_") else name]
            block[name] = np.array([row[name] for row in self.rows]).astype(dtype)
        last_hash = int(self.blocks[-1]["state_hash"][-1]) if self.blocks else 0
        block["state_hash"] = state_hash(block, previous=last_hash)
        if self.sink is not None:
            self.sink.append(block)
        self.blocks.append(block)
        self.rows = []

    def columns(self) -> dict[str, NDArray[Any]]:
        """All rows so far."""
        self._close_block()
        return {name: np.concatenate([b[name] for b in self.blocks]) for name in self.blocks[0]}


def describe(
    world: RearrangeWorld, *, episode_id: str, policies: Sequence[str], plans: Sequence[str]
) -> RecordingHeader:
    """What is known before the first step: who and what is there, what is to go where, under which rules.

    ``policies`` and ``plans`` are names, one for each agent. A person alone has the policy `SOLO` beside her.
    """
    kinds = kinds_of(world.cast)
    robots = kinds.count("robot")
    policy = SOLO if kinds == ("human",) else ",".join(policies[:robots])
    partner, plan = ",".join(policies[robots:]), ",".join(filter(None, plans))
    scene, spec = world.scene, world.spec
    file, digest = scene_attachment(scene)
    moving = {target.name: k for k, target in enumerate(world.targets)}
    bodies = tuple(
        replace(b, pose=world.targets[moving[b.name]].start.astype(np.float32), moving=moving[b.name])
        if b.name in moving
        else b
        for b in scene_bodies(scene)
    )
    agents = tuple(
        Agent(
            name=member.name, kind="robot", model=f"robot/{member.model}", semantic_id=200,
            joint_names=tuple(member.body.joint_names), action_names=("forward", "turn_left"), skill_names=SKILLS,
        )
        if isinstance(member.body, Robot)
        else Agent(
            name=member.name, kind="human", model=f"humanoid/{member.model}", semantic_id=100, skill_names=SKILLS[:5],
        )
        for member in world.cast
    )  # fmt: skip
    rules = asdict(spec)
    if not np.isfinite(spec.arm_rad_s):
        rules["arm_rad_s"] = None
    info = {
        "policy": policy,
        "partner": partner,
        "partner_plan": plan,
        "population": "zsc-pop" if partner in ZSC else "train-pop" if partner in POPULATIONS else "",
        "max_steps": spec.max_steps,
        "spec": rules,
        **_starts(world),
        "goal_objects": body_indices(world),
        "goals": [
            {
                "object": t.name,
                "start": t.start.tolist(),
                "position": t.goal.tolist(),
                "from": t.source,
                "to": t.destination,
            }
            for t in world.targets
        ],
        "scene_source": dict(scene.source),
        "scene_sha256": digest,
        "categories": list(CATEGORIES),
    }
    what = f"h3data:{TASK}:{digest}:{world.robot_name}:{world.human_name}:{world.seed}:{policy}:{partner}:{spec}"
    if kinds not in (("robot", "human"), ("human",)):
        what += ":" + ",".join(member.model for member in world.cast)
    episode = Episode(
        uid=str(uuid.uuid5(uuid.NAMESPACE_URL, what)), episode_id=episode_id, task=TASK, scene=scene.name,
        seed=world.seed, created_by=f"h3data {importlib.metadata.version('h3data')}", info=info,
    )  # fmt: skip
    return RecordingHeader(
        episode=episode, assets=tuple(AssetRef(name=name, uri=f"scene:{name}") for name in scene.assets), bodies=bodies,
        agents=agents, attachments={"scene.glb": file},
    )  # fmt: skip


def _starts(world: RearrangeWorld) -> dict[str, list[Any]]:
    """Where everybody begins, ``(x, z, heading)``: of robot and person as drawn, else of each agent."""
    if kinds_of(world.cast) in (("robot", "human"), ("human",)):
        drawn = world.starts
        return {
            "robot_start": [*map(float, drawn.robot_xz), drawn.robot_heading],
            "human_start": [*map(float, drawn.human_xz), drawn.human_heading],
        }
    return {"starts": world.places.tolist()}


def body_indices(world: RearrangeWorld) -> list[int]:
    """Index in the recording's bodies of each object of the task."""
    names = [i.name for i in world.scene.instances]
    return [names.index(target.name) for target in world.targets]


def finished(header: RecordingHeader, log: RearrangeLog, info: dict[str, Any]) -> Recording:
    """The whole recording, with what is known only at the end."""
    episode = replace(header.episode, info={**header.episode.info, **info})
    return Recording(
        episode=episode, assets=header.assets, bodies=header.bodies, agents=header.agents, columns=log.columns(),
        skills=tuple(log.skills), events=tuple(log.events), attachments=header.attachments,
    )  # fmt: skip
