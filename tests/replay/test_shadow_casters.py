"""Recordings in baked light: agents and things cast soft shadows where they are, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from h3data.geometry import pose_to_matrix
from h3data.recording import Recording
from h3data.render.shade.blockers_simd import ALONG, GROUP, RADIUS, START
from h3data.replay import Replay, camera_track
from h3data.replay.shadow_casters import capsule_of_box, moved
from h3data.replay.stage import Stage
from h3data_homes import HomeSpec, build_home
from sim_kinematic.motion.spec import SocialNavSpec, WalkerSpec
from tests.simulated import simulate_social_nav, social_nav_episode

STEP = 40


@pytest.fixture(scope="module")
def recording() -> Recording:
    spec = SocialNavSpec(max_steps=60, spawn_distance_m=3.0, human=WalkerSpec(speed_mps=1.0))
    return simulate_social_nav(social_nav_episode(build_home(HomeSpec(seed=2)), seed=2, spec=spec))


@pytest.fixture(scope="module")
def baked(recording: Recording) -> Replay:
    return Replay(recording, light="baked")


def test_agents_darken_the_floor_around_them_and_change_nothing_else(baked: Replay) -> None:
    stage = Stage(baked)
    renderer = stage.renderer()
    camera = camera_track(baked, "third_person").at(STEP)
    outputs = ("rgb", "depth", "instance")
    (lit,) = stage.render(renderer, STEP, [camera], outputs=outputs)
    renderer.set_blockers(None)
    plain = renderer.render(camera, outputs=outputs)
    for name in ("depth", "instance"):
        np.testing.assert_array_equal(lit[name], plain[name])
    still = np.array([d.agent < 0 and not d.moving for d in baked.drawables])
    fixed = (plain["instance"] >= 0) & still[plain["instance"]]
    change = lit["rgb"].astype(int) - plain["rgb"]
    assert (change[fixed] <= 0).all()
    dark = fixed & (change.sum(-1) < -12)
    assert 0.002 < dark.mean() < 0.4
    # what is darkened lies near an agent
    start, directions = camera.rays()
    points = (start + directions * plain["depth"][..., None])[dark] @ camera.pose[:3, :3].T + camera.pose[:3, 3]
    agents = [baked.recording.agent_column(k, "base_pose")[STEP, :3] for k in range(2)]
    apart = np.min([np.linalg.norm((points - a)[:, [0, 2]], axis=1) for a in agents], axis=0)
    assert np.percentile(apart, 95) < 2.0


def test_only_colours_wait_for_what_casts_shadows(baked: Replay, monkeypatch: pytest.MonkeyPatch) -> None:
    stage, asked = Stage(baked), []
    assert stage._casters is not None
    cast = type(stage._casters).blockers
    monkeypatch.setattr(type(stage._casters), "blockers", lambda self, *poses: asked.append(1) or cast(self, *poses))
    renderer, camera = stage.renderer(), camera_track(baked, "robot_arm").at(STEP)
    (depth,) = stage.render(renderer, STEP, [camera], outputs=("depth",))
    assert not asked
    (both,) = stage.render(renderer, STEP, [camera], outputs=("rgb", "depth"))
    assert len(asked) == 1
    np.testing.assert_array_equal(depth["depth"], both["depth"])


def test_there_is_a_capsule_for_every_part_that_moves(baked: Replay) -> None:
    stage = Stage(baked)
    renderer = stage.renderer()
    seen = []
    original = renderer.set_blockers
    renderer.set_blockers = lambda blockers, **k: (seen.append(blockers), original(blockers, **k))  # type: ignore[assignment]
    stage.render(renderer, STEP, [camera_track(baked, "top_down").at(STEP)], outputs=("rgb",))
    (blockers,) = seen
    for agent, name in ((0, "robot"), (1, "human")):
        rows = blockers.rows[blockers.rows[:, GROUP] == agent]
        assert len(rows) >= 8, name
        place = baked.recording.agent_column(agent, "base_pose")[STEP, :3]
        apart = np.linalg.norm(rows[:, [START, START + 2]] - place[[0, 2]], axis=1)
        assert apart.max() < 1.3
        low = np.minimum(rows[:, START + 1], rows[:, START + 1] + rows[:, ALONG + 1]) - rows[:, RADIUS]
        assert abs(low.min()) < 0.06  # it stands on the floor


def test_threads_draw_the_same_in_baked_light(baked: Replay) -> None:
    track = [camera_track(baked, "third_person").resized(160, 120)]
    one = list(baked.frames(track, range(0, 60, 9), outputs=("rgb",)))
    two = list(baked.frames(track, range(0, 60, 9), outputs=("rgb",), threads=3))
    for (_, (a,)), (_, (b,)) in zip(one, two, strict=True):
        np.testing.assert_array_equal(a["rgb"], b["rgb"])


def test_a_home_without_light_is_rendered_flat(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    from h3data.render.light.sources import LightSources

    monkeypatch.setenv("H3DATA_CACHE", "off")
    monkeypatch.setattr("h3data.replay.stage.sources_of", lambda _: LightSources())
    monkeypatch.setattr("h3data_light.bake._indirect", lambda *_: None)
    dark, flat = Replay(recording, light="baked"), Replay(recording)
    camera = camera_track(flat, "third_person").resized(160, 120).at(STEP)
    pictures = [
        stage.render(stage.renderer(), STEP, [camera], outputs=("rgb",))[0]["rgb"]
        for stage in (Stage(dark), Stage(flat))
    ]
    np.testing.assert_array_equal(*pictures)


def test_capsules_move_with_their_bodies() -> None:
    local = np.array([capsule_of_box((-0.1, -0.5, -0.1), (0.1, 0.5, 0.1)), np.full(7, np.nan)])
    pose = pose_to_matrix(np.array([1.0, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]))  # y to -x
    pose[:3, :3] *= 2
    out = moved(local, np.stack([pose, pose]))
    np.testing.assert_allclose((out[0, :3] + out[0, 3:6]) / 2, [1, 2, 3])
    np.testing.assert_allclose(out[0, 6], 2 * local[0, 6])
    np.testing.assert_allclose(
        np.abs(out[0, 3:6] - out[0, :3]), 2 * np.array([local[0, 4] - local[0, 1], 0, 0]), atol=1e-9
    )
    assert np.isnan(out[1]).any()


def test_absent_things_cast_nothing(recording: Recording) -> None:
    columns = dict(recording.columns)
    columns["agent_1.base_pose"] = np.full_like(columns["agent_1.base_pose"], np.nan)
    gone = Replay(replace(recording, columns=columns), light="baked")
    stage = Stage(gone)
    camera = camera_track(gone, "top_down").at(STEP)
    (picture,) = stage.render(stage.renderer(), STEP, [camera], outputs=("rgb", "instance"))
    assert picture["rgb"].any()
