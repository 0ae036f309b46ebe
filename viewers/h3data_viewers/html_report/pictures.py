"""Pictures of a report: floor plans with trajectories, and the best and worst episodes with key frames."""

from __future__ import annotations

import os
import re
import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError
from h3data.metrics import Profile
from h3data.metrics.report_layout import Milestone
from h3data.recording import Recording
from h3data.recording.live_input import remark_lines
from h3data.recording.log_lines import SAY, speech
from h3data.render.light.sources import LightMode
from h3data_viewers.html_report.charts import series_class
from h3data_viewers.html_report.data import Run, read_whole
from h3data_viewers.html_report.episode import GRID_S, ReportEpisode, Track
from h3data_viewers.html_report.svg import Svg, linear
from h3data_viewers.html_report.tables import counted
from h3data_viewers.templates import jpeg_data_uri

if TYPE_CHECKING:
    from h3data.replay import Replay
    from h3data.scene import Scene

Posing = Callable[..., "Replay"]
"""Type of a function that makes the `Replay` of a recording, with further arguments by name."""
_PLAN_WIDTH, _PLAN_HEIGHT = 360.0, 400.0
MOST_MESSAGES = 12
"""Largest number of messages on the card of an episode in a report."""
_TRACKS = 40
"""Largest number of trajectories per run that are drawn over a plan."""
_QUALITY = 78
"""Quality of JPEG pictures, which make up most of a page."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Floor plan that several drawings share, with its scale and origin in the world."""

    key: str
    scene: str
    width: float
    height: float
    scale: float
    """Units of the drawing per metre."""
    origin: tuple[float, float]
    """World ``(x, z)`` of the upper left corner."""
    image: str = ""
    """JPEG as a data URI, in pale colours so that lines stand out; empty if no recording has the scene."""

    def points(self, xz: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the coordinates on the plan of world floor points (x, z), shape [K, 2] [m]."""
        return (np.asarray(xz, np.float64) - self.origin) * self.scale

    def picture(self, alt: str, *, caption: str = "") -> Svg:
        """Return a drawing with the plan as its background; the page defines the plan once."""
        svg = Svg(self.width, self.height, alt, css="plan", caption=caption)
        svg.add("use", "", href=f"#{self.key}")
        return svg


@dataclass
class Plans:
    """Cache of floor plans by scene, which are made at first use."""

    made: dict[str, Plan] = field(default_factory=dict)

    def of(self, episode: ReportEpisode, scene: Scene | None = None) -> Plan:
        """Return the plan of the scene of an episode; passing ``scene`` avoids reading it again."""
        name = episode.metrics.scene
        if name not in self.made:
            if scene is None and (file := read_whole(episode).attachments.get("scene.glb")) is not None:
                from h3data.scene import load_scene

                scene = load_scene(file)
            key = f"plan-{len(self.made) + 1}"
            if scene is not None and scene.instances:
                self.made[name] = _drawn(key, scene)
            else:
                self.made[name] = _blank(key, episode)
        return self.made[name]


def _drawn(key: str, scene: Scene) -> Plan:
    from h3data.render.sheets.scene_map import plan_picture

    low, high = scene.bounds
    span = np.maximum(high - low, 1.0)[[0, 2]]
    floor_y = scene.rooms[0].floor_y if scene.rooms else float(low[1])
    # two pixels for each unit of the drawing, so that the plan is sharp on dense screens
    wanted = 2.0 * min(_PLAN_WIDTH / span[0], _PLAN_HEIGHT / span[1])
    image, camera = plan_picture(scene, pixels_per_m=wanted, floor_y=floor_y)
    (x0, y0), (x1, _) = camera.project(np.array([[0.0, floor_y, 0.0], [1.0, floor_y, 0.0]]))[0]
    scale = float(x1 - x0)
    fit = min(_PLAN_WIDTH / image.shape[1], _PLAN_HEIGHT / image.shape[0])
    pale = 0.30 * image + 0.20 * image.mean(-1, keepdims=True) + 0.50 * 255  # lines stand out on it
    return Plan(
        key=key,
        scene=scene.name,
        width=image.shape[1] * fit,
        height=image.shape[0] * fit,
        scale=scale * fit,
        origin=(-float(x0) / scale, -float(y0) / scale),
        image=jpeg_data_uri(pale.astype(np.uint8), quality=_QUALITY),
    )


def _blank(key: str, episode: ReportEpisode) -> Plan:
    """Return the empty floor around the tracks of an episode whose scene was not recorded."""
    points = np.concatenate([t.xz for t in episode.tracks] or [np.zeros((1, 2), np.float32)])
    points = points[np.isfinite(points).all(1)]
    low, high = (points.min(0) - 2.0, points.max(0) + 2.0) if len(points) else (np.full(2, -2.0), np.full(2, 2.0))
    span = np.asarray(high - low, np.float64)
    scale = float(min(_PLAN_WIDTH / span[0], _PLAN_HEIGHT / span[1]))
    return Plan(
        key=key,
        scene=episode.metrics.scene,
        width=span[0] * scale,
        height=span[1] * scale,
        scale=scale,
        origin=(float(low[0]), float(low[1])),
    )


# --- trajectories -----------------------------------------------------------------------------------------------------
def trajectory_charts(runs: Sequence[Run], plans: Plans) -> tuple[list[Svg], str]:
    """Draw floor plans of the scenes with the most episodes, with the paths of agents.

    Robots have the colour of their run, and people are grey.

    The returned text names these scenes, and their share of all scenes if some are omitted.
    """
    counts = Counter(e.metrics.scene for run in runs for e in run.episodes if e.tracks)
    charts = []
    for scene, count in counts.most_common(3):
        here = [[e for e in run.episodes if e.metrics.scene == scene and e.tracks] for run in runs]
        plan = plans.of(next(e for episodes in here for e in episodes))
        # of many episodes, some that are evenly spread: the first ones need not be like the others
        chosen = [
            [episodes[int(k)] for k in np.linspace(0, len(episodes) - 1, min(len(episodes), _TRACKS))]
            for episodes in here
        ]
        drawn = sum(map(len, chosen))
        what = counted(count, "episode") if drawn == count else f"{drawn} of {counted(count, 'episode')}"
        alt = f"Floor plan of {scene} with the trajectories of {count} episodes"
        svg = plan.picture(alt, caption=f"{scene or 'No scene'}: {what}")
        for episodes in chosen:
            for episode in episodes:
                for track in episode.tracks:
                    if track.kind == "human":
                        _draw_track(svg, plan, track, "track person-track")
        for k, episodes in enumerate(chosen):
            for episode in episodes:
                for track in episode.tracks:
                    if track.kind != "human":
                        _draw_track(svg, plan, track, f"track {series_class(k)}")
                        known = track.xz[np.isfinite(track.xz).all(1)]
                        for x, y in plan.points(known[-1:]):
                            svg.circle(x, y, 3, f"end {series_class(k)}")
        _scale_bar(svg, plan)
        charts.append(svg)
    fewer = len(charts) < len(counts)
    return charts, f"The {len(charts)} scenes with most episodes, of {len(counts)}. " if fewer else ""


def _draw_track(svg: Svg, plan: Plan, track: Track, css: str) -> None:
    import shapely

    known = track.xz[np.isfinite(track.xz).all(1)]
    if len(known) < 2:
        return
    # points within 4 cm of a line, which nobody sees, are left out, so that pages stay small
    line = shapely.simplify(shapely.linestrings(known.astype(np.float64)), 0.04)
    svg.path(plan.points(shapely.get_coordinates(line)), css)


def _scale_bar(svg: Svg, plan: Plan) -> None:
    metres = next((m for m in (1, 2, 5, 10, 20) if m * plan.scale >= 40), 50)
    y, length = plan.height - 10, metres * plan.scale
    svg.line(10, y, 10 + length, y, "scale-bar")
    svg.text(14 + length, y + 4, f"{metres:g} m", "on-plan")


# --- best and worst ---------------------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class Highlight:
    """Episode that a report shows with key frames."""

    place: int
    """Index of the episode's run."""
    run: Run
    kind: Literal["worst", "best"]
    episode: ReportEpisode


def ranked_by(profile: Profile) -> tuple[str, ...]:
    """Return the metrics by which episodes are ranked from worst to best, the most important first."""
    return profile.report.ranking or tuple(m.name for m in profile.metrics if m.direction != "neither")[:3]


def highlights(runs: Sequence[Run], most: int) -> list[Highlight]:
    """Return up to ``most`` episodes: the worst and the best of each run, then the second worst, and so on."""
    # of one recording that several partners share, and that is an episode for each, one is shown
    recorded = [{(e.source, e.index): e for e in run.episodes if e.recorded}.values() for run in runs]
    ranked = [
        sorted(episodes, key=lambda e: _score(e, run.profile)) for run, episodes in zip(runs, recorded, strict=True)
    ]
    # in turns, so that few pictures show something of every run
    chosen: list[Highlight] = []
    for depth in range(max(map(len, ranked), default=0)):
        for kind in ("worst", "best"):
            for k, (run, episodes) in enumerate(zip(runs, ranked, strict=True)):
                place = depth if kind == "worst" else len(episodes) - 1 - depth
                fresh = depth < (len(episodes) + (kind == "worst")) // 2
                if fresh and len(chosen) < most:
                    chosen.append(Highlight(place=k, run=run, kind=kind, episode=episodes[place]))
    return sorted(chosen, key=lambda h: (h.place, h.kind == "best"))


def _score(episode: ReportEpisode, profile: Profile) -> tuple[float, ...]:
    values = [episode.metrics.values.get(name, np.nan) for name in ranked_by(profile)]
    lower = {m.name for m in profile.metrics if m.direction == "lower"}
    signs = [-1.0 if name in lower else 1.0 for name in ranked_by(profile)]
    # an episode that never got so far as to define a metric is worse than all that did
    return tuple(-np.inf if np.isnan(v) else s * v for s, v in zip(signs, values, strict=True))


@dataclass
class ReplayFiles:
    """Writer of HTML replays of a report's episodes, in a folder next to the report."""

    folder: Path
    written: list[Path] = field(default_factory=list)

    def write(self, highlight: Highlight, recording: Recording, posed: Posing) -> str:
        """Write the replay of an episode and return its address, relative to the report."""
        from h3data_viewers.html_replay.html_file import write_html

        task = re.sub(r"[^A-Za-z0-9_-]+", "_", recording.episode.task) or "episode"
        path = self.folder / f"{task}_{len(self.written) + 1}_{highlight.kind}.html"
        replay = posed(recording, detail=False)
        write_html(
            replay.recording,
            path,
            replay=replay,
            title=f"{highlight.run.name}, episode {recording.episode.episode_id}",
            overwrite=True,
        )
        self.written.append(path)
        return quote(f"{self.folder.name}/{path.name}")


@dataclass(frozen=True, kw_only=True)
class HighlightCard:
    """Content of an episode's card in the report (macro ``cards`` of page/sections.html)."""

    highlight: Highlight
    colour: str
    """CSS class with the colour of the episode's run."""
    plan: Svg
    sparkline: Svg | None
    """Chart of distance over time; None if the episode is too short."""
    frames: Sequence[tuple[float, str, str]]
    """Key frames as time [s], label and picture (a data URI)."""
    fault: str
    """Reason why there are no key frames; empty if there are some."""
    instruction: str
    messages: list[str]
    """First messages between agents, each with its time, and players' remarks about the episode."""
    replay: str
    """Address of the HTML replay; empty if there is none."""
    path: str
    """Path of the recording, quoted for use in a shell."""


def highlight_card(
    highlight: Highlight,
    plans: Plans,
    posed: Posing,
    light: LightMode = "flat",
    replays: ReplayFiles | None = None,
    folder: Path | None = None,
) -> HighlightCard:
    """Return the card of one episode: a plan with both tracks, key frames, distance over time, and metrics.

    ``posed`` makes the `Replay` of the recording, and ``light`` is the light in its pictures. ``replays`` writes an
    HTML replay of the episode, to which the card links. The path of the recording on the card is relative to
    ``folder``.
    """
    episode, colour, address = highlight.episode, series_class(highlight.place), ""
    rows = key_rows(episode, highlight.run.profile.report.milestones)
    scene, frames, fault, instruction = None, [], "", ""
    messages: list[str] = []
    try:
        recording = read_whole(episode)
        instruction = str(recording.episode.info.get("instruction") or "")
        messages = [*_messages(recording), *remark_lines(recording)]
        replay = posed(recording, light=light)
        scene = replay.scene
        if replays is not None:
            address = replays.write(highlight, recording, posed)
        if replay.drawables:
            pictures = _frames(replay, [row for row, _ in rows])
            frames = [(episode.seconds(row), label, image) for (row, label), image in zip(rows, pictures, strict=True)]
        else:
            fault = "the recording names nothing that could be drawn."
    except H3DataError as error:
        fault = str(error)
    name = episode.name if folder is None else os.path.relpath(episode.name, folder)
    return HighlightCard(
        highlight=highlight,
        colour=colour,
        plan=_paths(episode, plans.of(episode, scene), colour),
        sparkline=_sparkline(episode, colour),
        frames=frames,
        fault=fault,
        instruction=instruction,
        messages=messages,
        replay=address,
        path=shlex.quote(name),
    )


def _paths(episode: ReportEpisode, plan: Plan, colour: str) -> Svg:
    """Return the plan with the paths of an episode, and a line between robot and person where they were nearest."""
    svg = plan.picture(
        f"Floor plan of {episode.metrics.scene}: paths of robot and {'people' if episode.people > 1 else 'person'}"
    )
    tracks = sorted(enumerate(episode.tracks), key=lambda each: each[1].kind)  # the robot's above the person's
    for agent, track in tracks:
        own = {"robot": colour, "human": "person-way"}[track.kind]
        other = track.kind == "human" and episode.people > 1 and agent != episode.metrics.human
        _draw_track(svg, plan, track, "track person-track" if other else f"way {own}")
        known = track.xz[np.isfinite(track.xz).all(1)]
        if len(known):
            (ax, ay), (bx, by) = plan.points(known[[0, -1]])
            svg.circle(ax, ay, 4, f"start {own}", title=f"{track.kind}: start")
            svg.circle(bx, by, 5, f"end {own}", title=f"{track.kind}: end")
    if episode.people > 1 and len(episode.nearest_at):
        (ax, ay), (bx, by) = plan.points(episode.nearest_at)
        gap = float(np.linalg.norm(np.diff(episode.nearest_at, axis=0)))
        svg.line(ax, ay, bx, by, "nearest")
        svg.circle(bx, by, 4, "start person-way", title=f"nearest person: {gap:.2f} m")
    _scale_bar(svg, plan)
    return svg


def _messages(recording: Recording) -> list[str]:
    """Return the first messages of an episode, each with its time."""
    names, said = [agent.name for agent in recording.agents], [e for e in recording.events if e.kind == SAY]
    seconds = recording.episode.dt_ns * 1e-9
    lines = [f"{e.step * seconds:.1f} s: {speech(e, names)}" for e in said[:MOST_MESSAGES]]
    return [*lines, f"and {len(said) - len(lines)} more"] if len(said) > len(lines) else lines


def key_rows(episode: ReportEpisode, milestones: Sequence[Milestone] = ()) -> list[tuple[int, str]]:
    """Return up to five key rows of an episode with captions: start, end, milestones, the encounter."""
    metrics = episode.metrics
    last = metrics.rows - 1
    if last < 0:
        return []
    rows = {0: "start", last: "contact" if metrics.contact_row == last else "end"}
    found, contact = metrics.encounter_row, metrics.contact_row
    if found >= 0:
        rows.setdefault(found, "finds the person")
        rows.setdefault((found + last) // 2, "after the encounter")
    else:
        rows.setdefault(last // 3, "a third of the episode")
        rows.setdefault(2 * last // 3, "two thirds of the episode")
    if 0 <= contact < last:
        rows[contact] = "first contact"
    for milestone in milestones:
        row = metrics.moments.get(milestone.flag)
        if row is not None and row not in (found, contact):
            rows[row] = milestone.label
    # five key frames fill a card
    return sorted(rows.items())[:5]


def _frames(replay, rows: Sequence[int]) -> list[str]:
    """Return pictures from behind the robot, as data URIs."""
    import cv2

    from h3data.replay import camera_track

    track = camera_track(replay, "third_person")
    return [
        jpeg_data_uri(cv2.resize(views[0]["rgb"], (400, 300), interpolation=cv2.INTER_AREA), quality=_QUALITY)
        for _, views in replay.frames([track], rows, outputs=("rgb",), threads=2)
    ]


def _sparkline(episode: ReportEpisode, css: str) -> Svg | None:
    distances = episode.distance_m
    if len(distances) < 2:
        return None
    width, height, high = 360.0, 70.0, max(float(np.nanmax(distances, initial=0.0)), 2.5)
    who = " to the nearest person" if episode.people > 1 else ""
    svg = Svg(width, height + 16, f"Distance{who} over time, from {distances[0]:.1f} m to {distances[-1]:.1f} m")
    x, y = linear(0, (len(distances) - 1) * GRID_S, 28, width - 4), linear(0, high, height - 2, 4)
    svg.rect(28, y(2), width - 32, y(1) - y(2), "zone")
    for value in (0.0, 2.0, *([np.floor(high)] if high > 4 else [])):
        svg.text(22, y(value) + 4, f"{value:g} m", "tick", anchor="end")
    svg.path([(x(k * GRID_S), y(d)) for k, d in enumerate(distances)], f"line {css}")
    found = episode.metrics.encounter_row
    if found >= 0:
        svg.line(x(episode.seconds(found)), 4, x(episode.seconds(found)), height - 2, "mean")
        svg.text(x(episode.seconds(found)) + 4, 14, "found", "tick")
    svg.line(28, height - 2, width - 4, height - 2, "axis")
    svg.text(width - 4, height + 12, f"{episode.seconds(episode.metrics.rows - 1):.0f} s", "tick", anchor="end")
    return svg
