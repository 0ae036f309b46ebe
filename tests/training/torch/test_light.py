"""Light on agents and their shadows on a device: those of the CPU."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch")

from h3data.bodies import load_humanoid, load_robot  # noqa: E402
from h3data.errors import InputError  # noqa: E402
from h3data.geometry import IDENTITY_POSE  # noqa: E402
from h3data.render import RenderInstance  # noqa: E402
from h3data.render.sheets.scene_map import render_scene  # noqa: E402
from h3data.replay.shadow_casters import shadow_casters  # noqa: E402
from h3data_homes import HomeSpec, build_home  # noqa: E402
from h3data_light import store  # noqa: E402
from h3data_light.field import LightField  # noqa: E402
from h3data_training.torch import cameras  # noqa: E402
from h3data_training.torch.light import PERSON, ROBOT, AgentLight  # noqa: E402
from sim_kinematic.sensing.camera_sensor import StateRenderer  # noqa: E402


def field(rng: np.random.Generator, shape: tuple[int, int, int]) -> LightField:
    """A field of light with walls and a corner without light."""
    cube = rng.uniform(0, 3, (*shape, 6, 3)).astype(np.float32)
    cube[rng.random(shape) < 0.3] = np.nan
    cube[:2, :2, :2] = 0
    reach = rng.uniform(0.2, 4, shape).astype(np.float32)
    return LightField(rng.uniform(-2, 0, 3), 0.5, cube, reach, rng.uniform(0.5, 2), rng.uniform(0.5, 1, 3))


def moved(frames: NDArray[np.float64], rng: np.random.Generator, worlds: int) -> NDArray[np.float64]:
    """Frames [N, 4, 4] turned and put elsewhere in each world, [W, N, 4, 4]."""
    turn, to = rng.uniform(-3, 3, worlds), rng.uniform(-3, 4, (worlds, 3)) * (1, 0, 1)
    place = np.tile(np.eye(4), (worlds, 1, 1))
    place[:, 0, 0] = place[:, 2, 2] = np.cos(turn)
    place[:, 0, 2], place[:, 2, 0] = np.sin(turn), -np.sin(turn)
    place[:, :3, 3] = to
    return place[:, None] @ frames


def test_agents_are_lit_and_cast_shadows_as_on_the_cpu() -> None:
    robot, human, rng, worlds = load_robot("quad_arm"), load_humanoid("female_0"), np.random.default_rng(4), 12
    links = [link for link in robot.links if link.mesh is not None]
    homes, casters = [], []
    for standing, shape in ((5, (9, 4, 7)), (2, (1, 3, 12))):
        meshes = [*(link.mesh for link in links if link.mesh is not None), human.lod_mesh]
        instances = [RenderInstance(0, np.eye(4))] * standing + [
            RenderInstance(k, np.eye(4)) for k in range(len(meshes))
        ]
        agents = {standing + k: ROBOT for k in range(len(links))} | {standing + len(links): PERSON}
        homes.append(SimpleNamespace(instances=instances, field=field(rng, shape)))
        casters.append(shadow_casters(homes[-1].field, meshes, instances, agents))
    rest = robot.link_matrices(IDENTITY_POSE[None], np.asarray(robot.rest, np.float64)[None])[0]
    parts = moved(rest[[k for k, link in enumerate(robot.links) if link.mesh is not None]], rng, worlds)
    body = human.joint_matrices(IDENTITY_POSE[None], *human.clip_pose(np.zeros(1, int), np.zeros(1), np.ones(1)))[0]
    joints = moved(body, rng, worlds)
    place = rng.integers(0, 2, worlds)
    light = AgentLight(homes, robot, human, device="cpu")  # type: ignore[arg-type]
    tensors = [torch.as_tensor(frames[:, :, :3], dtype=torch.float32) for frames in (parts, joints)]
    rows, tints = light.cast(tensors[0], tensors[1], torch.as_tensor(place))
    ends = human.capsules_world(joints)
    for w, home in enumerate(place):
        first = len(homes[home].instances) - len(links) - 1
        bones = np.column_stack([ends[0][w], ends[1][w], ends[2]])
        want = casters[home].blockers([(first + np.arange(len(links)), parts[w])], {first + len(links): bones})
        # fields differ by the last bits of a float32; what is divided by a length across the light, by more
        np.testing.assert_allclose(rows[w].numpy(), want.rows, rtol=2e-3, atol=2e-5)
        np.testing.assert_allclose(tints[w, : len(want.tints)].numpy(), want.tints, rtol=1e-4, atol=1e-5)
    assert tints.shape[1] == max(len(home.instances) for home in homes)


def test_homes_of_which_only_some_have_light_are_refused() -> None:
    homes: Any = [SimpleNamespace(name="bright"), SimpleNamespace(name="cellar")]
    lit, dark = (cast(Any, SimpleNamespace(baked=baked, light=str(baked))) for baked in (True, False))
    assert cameras.light_of_all(homes, [lit, lit]) == "True"
    assert cameras.light_of_all(homes, [dark, dark]) == "False"
    assert cameras.light_of_all(homes, [None, None]) is None
    with pytest.raises(InputError, match=r"(?s)reaches cellar,.*H3-ENV-057"):
        cameras.light_of_all(homes, [lit, dark])


class Asked(Exception):
    """Raised instead of a bake; holds the key of the light in the cache."""


def test_light_is_baked_once_for_devices_and_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    home, robot, human = build_home(HomeSpec(preset="small", seed=1)), load_robot("quad_arm"), load_humanoid("female_0")

    def ask(*given: Any) -> None:
        raise Asked(store._key(*given[:-1]))

    monkeypatch.setattr("h3data_light.bake.cached", ask)
    drawn = render_scene(home)
    static = range(len(drawn.instances))
    keys = []
    for bake in (
        lambda: StateRenderer(home, [robot, human], light="baked"),
        lambda: next(cameras._stages([home], robot, human, low_detail=True, light="baked")),
        lambda: cameras.lit_home(home, drawn.meshes, drawn.instances, static),  # of the processes that prepare episodes
    ):
        with pytest.raises(Asked) as asked:
            bake()
        keys.append(str(asked.value))
    assert len(set(keys)) == 1
