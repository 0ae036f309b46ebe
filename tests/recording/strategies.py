"""Random recordings for the tests of the stores: odd dtypes, NaN and infinities, unicode names, nothing at all."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from h3data.recording import Agent, AssetRef, Body, Episode, Event, InputEvent, Recording, SkillSpan
from h3data.recording.schema import DTYPES

TEXT = st.text(max_size=6)
STEPS = st.integers(-1, 50)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats(allow_nan=True) | TEXT,
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(TEXT, inner, max_size=2),
    max_leaves=4,
)
EXTRA_NAMES = [
    "metrics.größe",
    "metrics.grosse",
    "metrics.dist_agents",
    "metrics.dist.agents",
    "metrics.Dist_Agents",
    "sim.rng",
    "sim.step",
    "state_hash",
    "agent_0.action",
    "agent_1.action",
    "agent_1.joint_quat",
    "步",
]
SHAPES = [(), (), (1,), (3,), (2, 3), (0,), (0, 7)]


def random_bits(rng: np.random.Generator, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """Any bit pattern a dtype can have: NaN with payloads, infinities, denormals, extremes."""
    if dtype == "bool":
        return rng.integers(0, 2, shape).astype(bool)
    size = np.dtype(dtype).itemsize
    return np.frombuffer(rng.bytes(int(np.prod(shape)) * size), dtype).reshape(shape).copy()


@st.composite
def recordings(draw: st.DrawFn, *, max_steps: int = 40) -> Recording:
    """Any recording that keeps the rules of `Recording`."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    steps = draw(st.integers(0, max_steps))
    moving, agents = draw(st.integers(0, 3)), draw(st.integers(0, 2))
    columns: dict[str, np.ndarray] = {
        "time_ns": (np.cumsum(rng.integers(1, 10**9, steps)) + draw(st.integers(-(10**12), 10**12))).astype(np.int64)
    }
    if moving or draw(st.booleans()):
        columns["object_pose"] = random_bits(rng, "float32", (steps, moving, 7))
    for i in range(agents):
        columns[f"agent_{i}.base_pose"] = random_bits(rng, "float32", (steps, 7))
    for name in draw(st.lists(st.sampled_from(EXTRA_NAMES), unique=True, max_size=6)):
        dtype = draw(st.sampled_from(sorted(DTYPES)))
        columns[name] = random_bits(rng, dtype, (steps, *draw(st.sampled_from(SHAPES))))
    assets = tuple(
        AssetRef(
            name=f"a{i}",
            uri=draw(TEXT),
            up=(0.0, 0.0, 1.0),
            units_m=draw(st.floats(1e-6, 10)),
            color=draw(st.none() | st.tuples(*[st.integers(0, 255)] * 3)),
        )
        for i in range(draw(st.integers(1, 3)))
    )
    bodies = tuple(
        Body(
            name=draw(TEXT),
            asset=draw(st.sampled_from(assets)).name,
            pose=random_bits(rng, "float32", (7,)),
            scale=random_bits(rng, "float32", (3,)),
            semantic_id=draw(st.integers(-1, 2**40)),
            moving=i if i < moving else -1,
            layer=draw(TEXT),
            agent=draw(st.integers(-1, 1)),
        )
        for i in range(moving + draw(st.integers(0, 2)))
    )
    return Recording(
        episode=Episode(
            uid=draw(TEXT),
            episode_id=draw(TEXT),
            task=draw(TEXT),
            scene=draw(TEXT),
            seed=draw(st.integers(-(2**63), 2**63 - 1)),
            created_by=draw(TEXT),
            info=draw(st.dictionaries(TEXT, JSON, max_size=3)),
        ),
        assets=assets,
        bodies=bodies,
        agents=tuple(
            Agent(
                name=draw(TEXT),
                kind=draw(st.sampled_from(["robot", "human"])),
                model=draw(TEXT),
                joint_names=tuple(draw(st.lists(TEXT, max_size=3))),
                skill_names=("wait", "往"),
            )
            for _ in range(agents)
        ),
        columns=columns,
        skills=tuple(
            SkillSpan(
                agent=draw(st.integers(-1, 1)),
                name=draw(TEXT),
                start_step=draw(STEPS),
                end_step=draw(STEPS),
                outcome=draw(st.sampled_from(["done", "failed", "aborted", "running"])),
                reason=draw(TEXT),
            )
            for _ in range(draw(st.integers(0, 3)))
        ),
        events=tuple(
            Event(step=draw(STEPS), agent=-1, kind=draw(TEXT), target=draw(TEXT), detail=draw(TEXT))
            for _ in range(draw(st.integers(0, 3)))
        ),
        inputs=tuple(
            InputEvent(time_ns=draw(st.integers(-(2**63), 2**63 - 1)), kind=draw(TEXT), user=i, payload=draw(TEXT))
            for i in range(draw(st.integers(0, 3)))
        ),
        attachments=draw(st.dictionaries(TEXT, st.binary(max_size=20), max_size=2)),
    )


def simple_recording(*, steps: int = 60, bodies: int = 2, seed: int = 0, name: str = "") -> Recording:
    """A small, plain episode: a robot, a human, a few things that lie about."""
    rng = np.random.default_rng(seed)

    def walk(width: int) -> np.ndarray:
        return np.cumsum(rng.normal(0, 0.02, (steps, width)), 0).astype(np.float32)

    return Recording(
        episode=Episode(uid=f"uid-{seed}", episode_id=name or f"e{seed}", task="social_nav", scene="home", seed=seed),
        assets=(AssetRef(name="box", uri="primitive:box"),),
        bodies=tuple(Body(name=f"box {i}", asset="box", pose=np.ones(7, np.float32), moving=i) for i in range(bodies)),
        agents=(Agent(name="robot", kind="robot", model="robot/quad_arm"), Agent(name="human", kind="human")),
        columns={
            "time_ns": np.arange(steps, dtype=np.int64) * 33_333_333,
            "object_pose": walk(bodies * 7).reshape(steps, bodies, 7),
            "agent_0.base_pose": walk(7),
            "agent_0.action": walk(2),
            "agent_1.base_pose": walk(7),
            "metrics.collision": np.zeros(steps, bool),
            "metrics.dist_agents": walk(1)[:, 0],
        },
        skills=(SkillSpan(agent=0, name="follow", start_step=0, end_step=max(steps - 1, 0)),),
        events=(Event(step=3, agent=0, kind="collision", target="human"),),
        attachments={"scene.glb": b"glTF" * 50},
    )
