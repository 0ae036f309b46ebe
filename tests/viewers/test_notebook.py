"""Recordings, episodes and tables of metrics in notebooks."""

from __future__ import annotations

import importlib.util
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import h3data
from h3data.errors import InputError, MissingExtraError
from h3data.replay.sight import Sight
from h3data_viewers import notebook
from h3data_viewers.rerun.rrd_file import ViewedRecording, recorded_stream
from sim_kinematic.motion.spec import SocialNavSpec
from tests.simulated import simulate_social_nav, social_nav_episode

LONG_SCENE = "home_small_20200_area_m2_100.5_bedrooms_2_clutter_1.5"


@pytest.fixture(scope="module")
def recording() -> Any:
    return simulate_social_nav(social_nav_episode(h3data.open("small:3"), seed=3, spec=SocialNavSpec(max_steps=12)))


def test_a_recording_is_pictures_facts_and_metrics(recording: Any) -> None:
    html = recording._repr_html_()
    assert len(re.findall(r'<img src="data:image/jpeg;base64,[\w+/=]{1000,}"', html)) == notebook.STRIP
    for text in ("social_nav", "12 steps", "rollout_expert", "Finding success"):
        assert text in html


def test_pictures_of_a_strip_search_no_smooth_path(recording: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    looked = []
    around = Sight.around
    monkeypatch.setattr(Sight, "around", lambda *given: looked.append(1) or around(*given))
    recording._repr_html_()
    assert 0 < len(looked) <= 4 * notebook.STRIP  # 6 in 12 steps with a smooth path, 160 in a long recording


def test_text_of_a_recording_is_escaped(recording: Any) -> None:
    hostile = replace(recording, episode=replace(recording.episode, episode_id="<script>alert(1)</script>"))
    assert "<script>" not in hostile._repr_html_()


def test_without_pictures_or_metrics_it_says_why(recording: Any) -> None:
    bare = replace(
        recording, attachments={}, assets=(), bodies=(), agents=(), columns={"time_ns": recording.columns["time_ns"]}
    )
    html = bare._repr_html_()
    assert "No pictures" in html
    assert "No metrics" in html
    empty = replace(recording, columns={name: column[:0] for name, column in recording.columns.items()})
    assert "has no steps" in empty._repr_html_()


def test_datasets_and_metrics_are_tables(recording: Any, tmp_path: Path) -> None:
    from h3data.recording import DatasetWriter

    with DatasetWriter(tmp_path / "ds") as out:
        for k in range(12):
            episode = replace(recording.episode, uid=f"{k}", episode_id=f"{k}", scene=LONG_SCENE)
            out.add(replace(recording, episode=episode))
    html = h3data.open(tmp_path / "ds")._repr_html_()
    assert html.count("<tr>") == 1 + notebook.LISTED
    assert "12 episodes (12 social_nav), 144 steps" in html
    assert "and 2 more" in html
    assert html.count(f'title="{LONG_SCENE}"') == notebook.LISTED
    assert f">{LONG_SCENE[:10]}…{LONG_SCENE[-10:]}<" in html
    assert f">{LONG_SCENE}<" not in html
    assert "Finding success" in h3data.measure([recording])._repr_html_()


def test_the_metrics_of_an_episode_are_a_table(recording: Any) -> None:
    measured = h3data.measure(recording)
    head, *rows = str(measured).splitlines()
    assert head.split() == ["metric", "value", "unit", "what"]
    assert rows[0].split()[0] == "S"
    assert "Finding success" in rows[0]
    assert "undefined" in str(measured)
    assert "Notes" in rows
    assert all(note in str(measured) for note in measured.notes.values())
    assert all(note in measured._repr_html_() for note in measured.notes.values())
    assert measured._repr_html_().count("<tr>") == 1 + len(measured.values)
    assert len(repr(measured)) < 200


def test_show_gives_a_video(recording: Any, tmp_path: Path) -> None:
    import av

    shown = recording.show("video", camera="top_down", width=160)
    assert "data:video/mp4;base64," in shown._repr_html_()
    with av.open(str(shown.save(tmp_path / "seen.mp4"))) as container:
        frames = list(container.decode(video=0))
    assert len(frames) == 12
    assert frames[0].width == 160


def test_show_refuses_what_it_cannot_do(recording: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="H3-VIEW-013"):
        recording.show("paper")
    found = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: found(name) if name.startswith("h3data") else None)
    with pytest.raises(MissingExtraError, match="H3-VIEW-014"):
        recording.show("rerun")


def test_rerun_streams_hold_the_recording(recording: Any, tmp_path: Path) -> None:
    stream = recorded_stream([ViewedRecording(recording=recording)])
    stream.save(tmp_path / "shown.rrd")  # flushes what was logged before
    stream.disconnect()
    assert b"agents" in (tmp_path / "shown.rrd").read_bytes()
