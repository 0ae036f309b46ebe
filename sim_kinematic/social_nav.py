"""Social navigation, simulated: a robot must find a walking person and follow her at 1-2 m, facing her, without contact
(paper section 4.1 and appendix; spec/habitat.md 1).
"""

from __future__ import annotations

import importlib.metadata
import io
import uuid
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot, load_humanoid, load_robot
from h3data.errors import InputError, SceneError
from h3data.geometry import ground_pose, heading_direction
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
from h3data.scene import CATEGORIES, FreeSpace, Scene, save_scene, scene_digest
from sim_kinematic.contact import RobotHumanContact
from sim_kinematic.oracle import oracle_min_steps
from sim_kinematic.policies import ROBOT_SKILLS, Policy, View, policy_by_name
from sim_kinematic.randomness import generator
from sim_kinematic.spec import SocialNavSpec
from sim_kinematic.state import WorldState
from sim_kinematic.step import drive_robots, least_clearance, walk_humans
from sim_kinematic.waypoint_human import WaypointHuman, human_track

HUMAN_SKILLS = ("walk", "turn")
ROBOT, HUMAN = 0, 1
BLOCK = 30
"""Rows that are handed to the sink at once: one second."""


class Sink(Protocol):
    """What receives an episode while it runs; `h3data.recording.RecordingWriter` does."""

    def append(self, rows: dict[str, NDArray[Any]]) -> None: ...

    def event(self, event: Event) -> None: ...

    def skill(self, span: SkillSpan) -> int: ...

    def close(self, *, info: dict[str, Any]) -> object: ...

    def abort(self) -> None: ...


@dataclass(frozen=True, kw_only=True)
class Starts:
    """Where both begin."""

    robot_xz: NDArray[np.float64]
    robot_heading: float
    human_xz: NDArray[np.float64]
    human_heading: float


@dataclass(frozen=True, kw_only=True, eq=False)
class SocialNavWorld:
    """The unchanging half of an episode: home, map, bodies, rules, seed."""

    scene: Scene
    free: FreeSpace
    seed: int
    spec: SocialNavSpec
    robot: Robot
    human: Humanoid
    starts: Starts
    human_name: str
    robot_name: str

    @classmethod
    def create(
        cls, scene: Scene, *, seed: int, spec: SocialNavSpec | None = None, free: FreeSpace | None = None,
        human: str = "female_0", robot: str = "quad_arm",
    ) -> SocialNavWorld:  # fmt: skip
        """An episode of ``scene`` with starts drawn from ``seed``; ``free`` saves building the map again."""
        spec = spec or SocialNavSpec()
        free = free or FreeSpace.from_scene(scene, radius_m=spec.agent_radius_m, height_m=spec.agent_height_m)
        return cls(
            scene=scene, free=free, seed=seed, spec=spec, robot=load_robot(robot), human=load_humanoid(human),
            starts=draw_starts(free, seed, spec), human_name=human, robot_name=robot,
        )  # fmt: skip


def draw_starts(free: FreeSpace, seed: int, spec: SocialNavSpec) -> Starts:
    """Random start poses at least ``spec.spawn_distance_m`` apart on one island, the robot's base free of obstacles
    (spec/habitat.md 1.2).

    Raises:
        SceneError: the scene has no two such places.
    """
    rng = generator(seed, "spawn")
    offsets = np.asarray(spec.robot.disc_offsets_m)
    farthest = 0.0
    for _ in range(200):
        robot_xz, human_xz = free.sample(rng, 2)
        robot_heading, human_heading = rng.uniform(-np.pi, np.pi, 2)
        apart = float(np.hypot(*(robot_xz - human_xz)))
        farthest = max(farthest, apart)
        if apart < spec.spawn_distance_m:
            continue
        clearance = least_clearance(
            free.sdf, free.origin, free.cell_m, robot_xz[0], robot_xz[1], robot_heading, offsets
        )
        if clearance >= spec.robot.disc_radius_m and np.isfinite(free.geodesic(robot_xz, human_xz)):
            return Starts(
                robot_xz=robot_xz, robot_heading=float(robot_heading), human_xz=human_xz,
                human_heading=float(human_heading),
            )  # fmt: skip
    raise SceneError(
        f"Found no start poses {spec.spawn_distance_m} m apart with a free base in 200 attempts (the farthest pair was "
        f"{farthest:.1f} m apart). Hint: a smaller --spawn-distance, or a larger home."
    )


@dataclass
class _Log:
    """The episode as it grows: blocks of rows and events, handed on to a sink."""

    sink: Sink | None
    rows: list[dict[str, Any]] = field(default_factory=list)
    blocks: list[dict[str, NDArray[Any]]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    last_hash: int = 0

    def add(self, row: dict[str, Any]) -> None:
        self.rows.append(row)
        if len(self.rows) == BLOCK:
            self._close_block()

    def event(self, event: Event) -> None:
        self.events.append(event)
        if self.sink is not None:
            self.sink.event(event)

    def _close_block(self) -> None:
        if not self.rows:
            return
        block = {name: np.stack([row[name] for row in self.rows]) for name in self.rows[0]}
        hashes = state_hash(block, previous=self.last_hash)
        self.last_hash = int(hashes[-1])
        block["state_hash"] = hashes
        if self.sink is not None:
            self.sink.append(block)
        self.blocks.append(block)
        self.rows = []

    def columns(self) -> dict[str, NDArray[Any]]:
        self._close_block()
        return {name: np.concatenate([b[name] for b in self.blocks]) for name in self.blocks[0]}


def simulate_social_nav(
    world: SocialNavWorld,
    *,
    policy: str | Policy = "heuristic_expert",
    episode_id: str = "0",
    sink: Callable[[RecordingHeader], Sink] | None = None,
    progress: Callable[[int], object] | None = None,
) -> Recording:
    """Run one episode to its end and return its recording.

    ``sink`` is called once, with what is known before the first step, and returns what receives rows and events while they
    come, such as a `RecordingWriter`; it is closed at the end, aborted on an error. ``progress`` is called with 1 after
    every step.
    """
    act = policy_by_name(policy) if isinstance(policy, str) else policy
    header = describe(world, episode_id=episode_id, policy=policy if isinstance(policy, str) else act.__name__)
    log = _Log(sink(header) if sink is not None else None)
    try:
        ended = _run(world, act, header, log, progress or (lambda _: None))
        columns = log.columns()
        info = {"ended": ended, "oracle_min_steps": _oracle(world)}
        recording = _finished(header, columns, info, log.events)
        if log.sink is not None:
            for span in recording.skills:
                log.sink.skill(span)
            log.sink.close(info=info)
    except BaseException:
        if log.sink is not None:
            log.sink.abort()
        raise
    return recording


def _run(
    world: SocialNavWorld, act: Policy, header: RecordingHeader, log: _Log, progress: Callable[[int], object]
) -> str:
    """Step to the end of the episode; returns what ended it."""
    spec, free = world.spec, world.free
    state = WorldState.zeros(1)
    state.robot_xz[0], state.robot_heading[0] = world.starts.robot_xz, world.starts.robot_heading
    state.human_xz[0], state.human_heading[0] = world.starts.human_xz, world.starts.human_heading
    human = WaypointHuman(free, world.seed, spec.human)
    contact = RobotHumanContact(world.robot, world.human)
    clip = world.human.clip_for_speed(spec.human.speed_mps)
    person = header.agents[HUMAN].name
    met = False
    geodesic = float(free.geodesic(state.robot_xz[0], state.human_xz[0]))
    for step in range(spec.max_steps):
        view = View(
            free, state.robot_xz[0].copy(), float(state.robot_heading[0]), state.human_xz[0].copy(), geodesic, met
        )
        command = act(view, spec.robot)
        goal, walked = human.goal, float(state.human_distance[0])
        walk_humans(state, human.target(state.human_xz[0])[None], spec.human)
        drive_robots(state, free, np.array([[command.forward, command.turn]]), spec.robot)
        geodesic = float(free.geodesic(state.robot_xz[0], state.human_xz[0]))
        facing = _facing(state)
        row = _row(world, state, clip, step)
        collision = contact.touching(row["agent_0.base_pose"], row["agent_0.joint_pos"], *_human_pose(world, row))
        log.add(
            row
            | {
                "agent_0.action": np.array([command.forward, command.turn], np.float32),
                "agent_0.skill": np.int32(ROBOT_SKILLS.index(command.skill)),
                "agent_1.skill": np.int32(HUMAN_SKILLS.index("walk" if state.human_distance[0] > walked else "turn")),
                "sim.human_goal": np.int32(human.goal),
                "sim.human_leg": np.int32(human.leg),
                "metrics.dist_agents": np.float32(np.hypot(*(state.human_xz[0] - state.robot_xz[0]))),
                "metrics.geodesic_agents": np.float32(geodesic),
                "metrics.facing": np.float32(facing),
                "metrics.collision": np.bool_(collision),
                "metrics.robot_contact": np.bool_(state.robot_contact[0]),
            }
        )
        progress(1)
        if human.goal != goal:
            x, z = human.goals[-1]
            log.event(Event(step=step, agent=HUMAN, kind="new_goal", detail=f"({x:.2f}, {z:.2f})"))
        if not met and spec.near_m <= geodesic <= spec.far_m and facing > spec.facing_dot:
            met = True
            log.event(Event(step=step, agent=ROBOT, kind="found", target=person))
        if collision:
            log.event(Event(step=step, agent=ROBOT, kind="collision", target=person))
            if spec.end_on_collision:
                return "collision"
    return "max_steps"


def _oracle(world: SocialNavWorld) -> int | None:
    """The oracle's minimum steps ``l``, from the person's whole track whether or not the episode lasted that long."""
    starts, spec = world.starts, world.spec
    track = human_track(world.free, starts.human_xz, starts.human_heading, world.seed, spec.human, spec.max_steps)
    return oracle_min_steps(world.free, starts.robot_xz, starts.robot_heading, track, spec)


def _facing(state: WorldState) -> float:
    """Cosine between the robot's forward axis and the direction to the person."""
    to_human = state.human_xz[0] - state.robot_xz[0]
    distance = float(np.hypot(*to_human))
    return float(heading_direction(state.robot_heading[0]) @ to_human / distance) if distance > 0 else 1.0


def _row(world: SocialNavWorld, state: WorldState, clip: int, step: int) -> dict[str, Any]:
    floor = world.free.floor_y
    stride = world.human.clips[clip].stride_m
    return {
        "time_ns": np.int64((step + 1) * STEP_NS),
        "agent_0.base_pose": ground_pose(state.robot_xz[0], state.robot_heading[0], floor).astype(np.float32),
        "agent_0.joint_pos": world.robot.rest.astype(np.float32),
        "agent_0.grasp_body": np.int32(-1),
        "agent_1.base_pose": ground_pose(state.human_xz[0], state.human_heading[0], floor).astype(np.float32),
        "agent_1.motion_id": np.int32(clip),
        "agent_1.motion_phase": np.float32((state.human_distance[0] / stride) % 1.0),
        "agent_1.motion_blend": np.float32(state.human_blend[0]),
        "agent_1.grasp_body": np.int32(-1),
    }


def _human_pose(world: SocialNavWorld, row: dict[str, Any]) -> tuple[NDArray[Any], Callable[[], NDArray[Any]]]:
    """Her base pose [7], and her joints' world matrices [55, 4, 4] for when they are needed."""
    base = row["agent_1.base_pose"]

    def joints() -> NDArray[Any]:
        quats, pelvis = world.human.clip_pose(
            row["agent_1.motion_id"][None], row["agent_1.motion_phase"][None], row["agent_1.motion_blend"][None]
        )
        return world.human.joint_matrices(base[None], quats, pelvis)[0]

    return base, joints


# --- the recording ------------------------------------------------------------------------------------------------------
def describe(world: SocialNavWorld, *, episode_id: str, policy: str) -> RecordingHeader:
    """What is known before the first step: who and what is there, under which rules."""
    scene, spec, starts = world.scene, world.spec, world.starts
    buffer = io.BytesIO()
    save_scene(scene, buffer)
    bodies = tuple(
        Body(
            name=i.name, asset=i.asset, pose=i.pose.astype(np.float32), scale=i.scale.astype(np.float32),
            semantic_id=i.semantic_id, layer=i.layer,
        )
        for i in scene.instances
    )  # fmt: skip
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
    digest = scene_digest(scene)
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
    episode = Episode(
        uid=str(uuid.uuid5(uuid.NAMESPACE_URL, f"h3data:social_nav:{digest}:{world.seed}:{policy}:{spec}")),
        episode_id=episode_id, task="social_nav", scene=scene.name, seed=world.seed,
        created_by=f"h3data {importlib.metadata.version('h3data')}", info=info,
    )  # fmt: skip
    return RecordingHeader(
        episode=episode,
        assets=tuple(AssetRef(name=name, uri=f"scene:{name}") for name in scene.assets),
        bodies=bodies,
        agents=agents,
        attachments={"scene.glb": buffer.getvalue()},
    )


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


def _finished(
    header: RecordingHeader, columns: dict[str, NDArray[Any]], info: dict[str, Any], events: list[Event]
) -> Recording:
    episode = replace(header.episode, info={**header.episode.info, **info})
    return Recording(
        episode=episode, assets=header.assets, bodies=header.bodies, agents=header.agents, columns=columns,
        skills=skill_spans(columns, header.agents), events=tuple(events), attachments=header.attachments,
    )  # fmt: skip


def require_task(task: str) -> None:
    """Refuse a task that does not exist."""
    if task != "social_nav":
        raise InputError(f"Unknown task {task!r}. Expected: social_nav.")
