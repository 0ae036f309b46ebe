"""Pictures of a report: floor plans with trajectories, and the best and worst episodes with key frames."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Literal
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError
from h3data.metrics import Profile
from h3data.metrics.report_layout import Milestone
from h3data.recording import Recording
from h3data.recording.log_lines import SAY, speech
from h3data.render.image_files import jpeg_data_uri
from h3data.render.light.sources import LightMode
from h3data_viewers.html_report.charts import series_class
from h3data_viewers.html_report.data import Run, read_whole
from h3data_viewers.html_report.episode import GRID_S, ReportEpisode, Track
from h3data_viewers.html_report.svg import Svg, linear
from h3data_viewers.html_report.tables import counted, number

if TYPE_CHECKING:
    from h3data.replay import Replay
    from h3data.scene import Scene

Posing = Callable[..., "Replay"]
"""Makes the `Replay` of a recording, with further arguments by name."""
_PLAN_WIDTH, _PLAN_HEIGHT = 360.0, 400.0
MOST_MESSAGES = 12
"""Number of messages that a card of an episode shows."""
_PIXELS = 2.0
"""Pixels of the plan's picture per unit of the drawing."""
_SCENES = 3
_TRACKS = 40
"""At most so many trajectories per run are drawn over a plan."""
_SMOOTH_M = 0.04
_FRAME = (400, 300)
_QUALITY = 78
_BARS_M = (1, 2, 5, 10, 20, 50)
"""Lengths of scale bars [m]."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A floor plan that drawings share, and where the world lies on it."""

    key: str
    scene: str
    width: float
    height: float
    scale: float
    """Units of the drawing per metre."""
    origin: tuple[float, float]
    """World ``(x, z)`` of the upper left corner."""
    image: str = ""
    """JPEG as a data URI; empty: nobody recorded the scene."""

    def points(self, xz: NDArray[np.floating]) -> NDArray[np.float64]:
        """Coordinates on the plan of floor points [K, 2] [m]."""
        return (np.asarray(xz, np.float64) - self.origin) * self.scale

    def symbol(self) -> str:
        """The picture, to be defined once in the page; it is drawn pale, so that lines stand out."""
        if not self.image:
            return f'<rect id="{self.key}" width="{self.width:.1f}" height="{self.height:.1f}" class="floor"/>'
        return f'<image id="{self.key}" width="{self.width:.1f}" height="{self.height:.1f}" href="{self.image}"/>'

    def picture(self, alt: str) -> Svg:
        """A drawing that begins with the plan."""
        svg = Svg(self.width, self.height, alt, css="plan")
        svg.use(self.key)
        return svg


@dataclass
class Plans:
    """Floor plans by scene, made at first use."""

    made: dict[str, Plan] = field(default_factory=dict)

    def of(self, episode: ReportEpisode, scene: Scene | None = None) -> Plan:
        """The plan of the scene of an episode; ``scene`` saves reading it."""
        name = episode.metrics.scene
        if name not in self.made:
            scene = scene if scene is not None else _recorded_scene(episode)
            key = f"plan-{len(self.made) + 1}"
            if scene is not None and scene.instances:
                self.made[name] = _drawn(key, scene)
            else:
                self.made[name] = _blank(key, episode)
        return self.made[name]

    def definitions(self) -> str:
        """All pictures, for the beginning of the page."""
        symbols = "".join(plan.symbol() for plan in self.made.values())
        return f'<svg class="definitions" width="0" height="0" aria-hidden="true"><defs>{symbols}</defs></svg>'


def _recorded_scene(episode: ReportEpisode) -> Scene | None:
    from h3data.scene import load_scene

    file = read_whole(episode).attachments.get("scene.glb")
    return None if file is None else load_scene(file)


def _drawn(key: str, scene: Scene) -> Plan:
    from h3data.render.sheets.scene_map import plan_picture

    low, high = scene.bounds
    span = np.maximum(high - low, 1.0)[[0, 2]]
    floor_y = scene.rooms[0].floor_y if scene.rooms else float(low[1])
    wanted = min(_PLAN_WIDTH / span[0], _PLAN_HEIGHT / span[1]) * _PIXELS
    image, camera = plan_picture(scene, pixels_per_m=wanted, floor_y=floor_y)
    (x0, y0), (x1, _) = camera.project(np.array([[0.0, floor_y, 0.0], [1.0, floor_y, 0.0]]))[0]
    scale = float(x1 - x0)
    fit = min(_PLAN_WIDTH / image.shape[1], _PLAN_HEIGHT / image.shape[0])
    return Plan(
        key=key,
        scene=scene.name,
        width=image.shape[1] * fit,
        height=image.shape[0] * fit,
        scale=scale * fit,
        origin=(-float(x0) / scale, -float(y0) / scale),
        image=jpeg_data_uri(_pale(image), quality=_QUALITY),
    )


def _blank(key: str, episode: ReportEpisode) -> Plan:
    """Empty floor around the tracks of an episode whose scene was not recorded."""
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
def trajectory_figures(runs: Sequence[Run], plans: Plans) -> tuple[list[str], str]:
    """Floor plans of the scenes with the most episodes, with the paths of robots (in the run's colour) and people (grey).

    The text that is returned says which scenes these are and how many there are, if not all are shown.
    """
    counts = Counter(e.metrics.scene for run in runs for e in run.episodes if e.tracks)
    figures = []
    for scene, count in counts.most_common(_SCENES):
        here = [[e for e in run.episodes if e.metrics.scene == scene and e.tracks] for run in runs]
        plan = plans.of(next(e for episodes in here for e in episodes))
        svg = plan.picture(f"Floor plan of {scene} with the trajectories of {count} episodes")
        chosen = [_spread(episodes) for episodes in here]
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
        drawn = sum(map(len, chosen))
        what = counted(count, "episode") if drawn == count else f"{drawn} of {counted(count, 'episode')}"
        figures.append(
            f"<figure><figcaption>{escape(scene or 'No scene')}: {what}</figcaption>{svg.to_html()}</figure>"
        )
    return figures, f"The {len(figures)} scenes with most episodes, of {len(counts)}." if len(figures) < len(
        counts
    ) else ""


def _spread(episodes: Sequence[ReportEpisode]) -> list[ReportEpisode]:
    if len(episodes) <= _TRACKS:
        return list(episodes)
    return [episodes[int(k)] for k in np.linspace(0, len(episodes) - 1, _TRACKS)]


def _draw_track(svg: Svg, plan: Plan, track: Track, css: str) -> None:
    import shapely

    known = track.xz[np.isfinite(track.xz).all(1)]
    if len(known) < 2:
        return
    line = shapely.simplify(shapely.linestrings(known.astype(np.float64)), _SMOOTH_M)
    svg.path(plan.points(shapely.get_coordinates(line)), css)


def _scale_bar(svg: Svg, plan: Plan) -> None:
    metres = next((m for m in _BARS_M if m * plan.scale >= 40), _BARS_M[-1])
    y, length = plan.height - 10, metres * plan.scale
    svg.line(10, y, 10 + length, y, "scale-bar")
    svg.text(14 + length, y + 4, f"{metres:g} m", "on-plan")


# --- best and worst ---------------------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class Highlight:
    """Episode that is shown with key frames."""

    place: int
    """Number of the episode's run."""
    run: Run
    kind: Literal["worst", "best"]
    episode: ReportEpisode


def ranked_by(profile: Profile) -> tuple[str, ...]:
    """Metrics that say which episode is better, the most important first."""
    return profile.report.ranking or tuple(m.name for m in profile.metrics if m.direction != "neither")[:3]


def highlights(runs: Sequence[Run], most: int) -> list[Highlight]:
    """Return up to ``most`` episodes: the worst and the best of each run, then the second worst, and so on."""
    ranked = [sorted(_recorded(run), key=lambda e: _score(e, run.profile)) for run in runs]
    chosen: list[Highlight] = []
    for depth in range(max(map(len, ranked), default=0)):
        for kind in ("worst", "best"):
            for k, (run, episodes) in enumerate(zip(runs, ranked, strict=True)):
                place = depth if kind == "worst" else len(episodes) - 1 - depth
                fresh = depth < (len(episodes) + (kind == "worst")) // 2
                if fresh and len(chosen) < most:
                    chosen.append(Highlight(place=k, run=run, kind=kind, episode=episodes[place]))
    return sorted(chosen, key=lambda h: (h.place, h.kind == "best"))


def _recorded(run: Run) -> list[ReportEpisode]:
    """Returns the episodes that have a recording, each recording once."""
    return list({(e.source, e.index): e for e in run.episodes if e.recorded}.values())


def _score(episode: ReportEpisode, profile: Profile) -> tuple[float, ...]:
    values = [episode.metrics.values.get(name, np.nan) for name in ranked_by(profile)]
    lower = {m.name for m in profile.metrics if m.direction == "lower"}
    signs = [-1.0 if name in lower else 1.0 for name in ranked_by(profile)]
    return tuple(-np.inf if np.isnan(v) else s * v for s, v in zip(signs, values, strict=True))


@dataclass
class ReplayFiles:
    """HTML replays of the episodes of a report, in a folder beside it."""

    folder: Path
    written: list[Path] = field(default_factory=list)

    def link(self, highlight: Highlight, recording: Recording, posed: Posing) -> str:
        """Writes the replay of an episode and returns a link to it, relative to the report."""
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
        return f'<a href="{escape(quote(f"{self.folder.name}/{path.name}"))}">Play this episode</a>'


def highlight_card(
    highlight: Highlight,
    plans: Plans,
    posed: Posing,
    light: LightMode = "flat",
    replays: ReplayFiles | None = None,
    folder: Path | None = None,
) -> str:
    """Plan with both tracks, key frames, distance over time and the metrics of one episode.

    ``posed`` makes the `Replay` of a recording, to be seen in ``light``;
    ``replays`` takes an HTML replay of the episode, which the card links; the recording is named from ``folder``.
    """
    episode, link = highlight.episode, ""
    tag = highlight.kind if len(highlight.run.episodes) > 1 else "only one"
    rows = key_rows(episode, highlight.run.profile.report.milestones)
    scene, frames, missing, told, said = None, [], "", "", ""
    try:
        recording = read_whole(episode)
        told = str(recording.episode.info.get("instruction") or "")
        said = _messages(recording)
        replay = posed(recording, light=light)
        scene = replay.scene
        if replays is not None:
            link = replays.link(highlight, recording, posed) + ". "
        if replay.drawables:
            frames = _frames(replay, [row for row, _ in rows])
        else:
            missing = "<p class=missing>No key frames: the recording names nothing that could be drawn.</p>"
    except H3DataError as fault:
        missing = f"<p class=missing>No key frames: {escape(str(fault))}</p>"
    plan = plans.of(episode, scene)
    svg = plan.picture(
        f"Floor plan of {episode.metrics.scene}: paths of robot and {'people' if episode.people > 1 else 'person'}"
    )
    ways = sorted(enumerate(episode.tracks), key=lambda way: way[1].kind)  # the robot's above the person's
    for agent, track in ways:
        own = series_class(highlight.place) if track.kind == "robot" else "person-way"
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
    pictures = "".join(
        f'<figure><img src="{image}" width="{_FRAME[0]}" height="{_FRAME[1]}" loading="lazy" alt="{escape(label)} at '
        f'{episode.seconds(row):.1f} s, from behind the robot"><figcaption>{episode.seconds(row):.1f} s: {escape(label)}'
        f"</figcaption></figure>"
        for (row, label), image in zip(rows, frames, strict=False)
    )
    name = episode.name if folder is None else os.path.relpath(episode.name, folder)
    values = "".join(
        f"<li><b>{escape(name)}</b> {number(value)}</li>" for name, value in episode.metrics.values.items()
    )
    return (
        f'<article class="card"><h3><span class="tag {highlight.kind}">{tag}</span> '
        f'<span class="chip {series_class(highlight.place)}"></span>{escape(highlight.run.name)}: episode '
        f"{escape(episode.metrics.episode_id)}</h3><p class=quiet>{escape(episode.metrics.scene)}, "
        f"{episode.metrics.rows} steps, {episode.seconds(episode.metrics.rows - 1):.1f} s</p>"
        f"{f'<p>{escape(told)}</p>' if told else ''}{said}"
        f'<ul class="values">{values}</ul><div class="card-body"><div class="card-plan">{svg.to_html()}'
        f"{_sparkline(episode, series_class(highlight.place))}</div>"
        f'<div class="frames">{pictures}{missing}</div></div>'
        f"<p class=quiet>{link}Look: <code>h3data view {escape(_quoted(name))}</code></p></article>"
    )


def _messages(recording: Recording) -> str:
    """The first messages of an episode as a list; empty if nobody says anything."""
    names, said = [agent.name for agent in recording.agents], [e for e in recording.events if e.kind == SAY]
    seconds = recording.episode.dt_ns * 1e-9
    lines = [f"<li>{e.step * seconds:.1f} s: {escape(speech(e, names))}</li>" for e in said[:MOST_MESSAGES]]
    more = f"<li>and {len(said) - len(lines)} more</li>" if len(said) > len(lines) else ""
    return f"<ul class=quiet>{''.join(lines)}{more}</ul>" if said else ""


def key_rows(episode: ReportEpisode, milestones: Sequence[Milestone] = ()) -> list[tuple[int, str]]:
    """Return up to five rows that tell the story, with what happens there: start, end, milestones, the encounter."""
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
    return sorted(rows.items())[:5]


def _frames(replay, rows: Sequence[int]) -> list[str]:
    """From behind the robot, as data URIs."""
    import cv2

    from h3data.replay import camera_track

    track = camera_track(replay, "third_person")
    return [
        jpeg_data_uri(cv2.resize(views[0]["rgb"], _FRAME, interpolation=cv2.INTER_AREA), quality=_QUALITY)
        for _, views in replay.frames([track], rows, outputs=("rgb",), threads=2)
    ]


def _sparkline(episode: ReportEpisode, css: str) -> str:
    distances = episode.distance_m
    if len(distances) < 2:
        return ""
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
    return svg.to_html()


# --- small things -----------------------------------------------------------------------------------------------------
def _pale(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    grey = image.mean(-1, keepdims=True)
    return (0.30 * image + 0.20 * grey + 0.50 * 255).astype(np.uint8)


def _quoted(path: str) -> str:
    import shlex

    return shlex.quote(path)
