"""Initial layout of the Rerun window: 3-D views of homes, with cameras, distances, lanes and log next to or below them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import rerun.blueprint as rrb


@dataclass(frozen=True, kw_only=True, eq=False)
class LoggedRecording:
    """Entity paths of one recording in a Rerun file."""

    label: str
    """Root of the recording's entities; empty if the file holds no other recording."""
    name: str
    """Title of the recording's 3-D view."""
    world: str
    """Absolute entity path of the recording's home, which is the prefix of all paths below it."""
    focus: NDArray[np.floating]
    """Box [2, 3] that the 3-D view initially shows [m]."""
    hidden: Sequence[str]
    """Entity paths that are hidden initially, such as ceilings."""
    cameras: Sequence[str]
    plotted: Sequence[str]
    lanes: Sequence[str]
    latency: Sequence[str]
    """Entity paths of the round trips of people who played live [ms]."""
    log: str
    """Entity path of the event log; empty if there is none."""
    inputs: str
    """Entity path of people's raw input; empty if none was recorded."""


THIRD_PERSON = "third_person"
"""Name of the camera whose pictures have their own row above all others."""
LARGE_SHARE, LANE_SHARE = 3.0, 0.34
"""Heights of the row of `THIRD_PERSON` and of a lane, relative to that of the distances."""


def camera_name(entity: str) -> str:
    """Return the name of a camera from the path of its entity."""
    return entity.rsplit("/", 1)[-1]


def layout(recordings: Sequence[LoggedRecording], *, timeline: str) -> rrb.Blueprint:
    """Arrange views of the logged recordings, which share plots, lanes and log; rows without content are omitted.

    A single home is on the left of the other views, and several homes are side by side above them. Third-person
    pictures are the largest. The window opens paused at the first step.
    """
    import rerun.blueprint as rrb

    rows: list[rrb.View | rrb.Container] = []
    shares: list[float] = []
    pictures = [(recording, entity) for recording in recordings for entity in recording.cameras]
    large = [picture for picture in pictures if camera_name(picture[1]) == THIRD_PERSON]
    small = [picture for picture in pictures if picture not in large]
    homes = [_home_view(recording, wide=not large or len(recordings) > 1) for recording in recordings]
    # more than three pictures take two rows
    for group, share in ((large, LARGE_SHARE), (small, 1.3 if len(small) <= 3 else 2.0)):
        views = [
            rrb.Spatial2DView(origin=entity, name=f"{recording.label} {camera_name(entity)}".lstrip())
            for recording, entity in group
        ]
        if views:
            rows.append(views[0] if len(views) == 1 else rrb.Grid(*views, grid_columns=min(len(views), 3)))
            shares.append(share)
    plotted = [entity for recording in recordings for entity in recording.plotted]
    if plotted:
        rows.append(
            rrb.TimeSeriesView(
                origin="/",
                contents=plotted,
                name="Distances [m]",
                plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
            )
        )
        shares.append(1.0)
    lanes = [entity for recording in recordings for entity in recording.lanes]
    if lanes:
        rows.append(rrb.StateTimelineView(origin="/", contents=lanes, name="Actions"))
        # the head of the view, and a row for each lane
        shares.append(0.35 + LANE_SHARE * len(lanes))
    latency = [entity for recording in recordings for entity in recording.latency]
    if latency:
        rows.append(rrb.TimeSeriesView(origin="/", contents=latency, name="Round trip [ms]"))
        shares.append(0.5)
    for name, roots in (("Events", [r.log for r in recordings]), ("Input", [r.inputs for r in recordings])):
        if any(roots):
            rows.append(rrb.TextLogView(origin="/", contents=[f"{root}/**" for root in roots if root], name=name))
            shares.append(0.7)
    # Paused: viewers that are sent a file over the network follow the newest data, and would show the last step.
    time = rrb.TimePanel(state="collapsed", timeline=timeline, play_state="paused")
    if not rows:
        root = homes[0] if len(homes) == 1 else rrb.Horizontal(*homes)
    elif len(homes) == 1:
        root = rrb.Horizontal(
            homes[0], rrb.Vertical(*rows, row_shares=shares), column_shares=[1, 1] if large else [3, 2]
        )
    else:
        root = rrb.Vertical(rrb.Horizontal(*homes), rrb.Horizontal(*rows), row_shares=[3, 2])
    return rrb.Blueprint(root, time, collapse_panels=True)


def _home_view(recording: LoggedRecording, *, wide: bool) -> rrb.View:
    import rerun.blueprint as rrb

    # from above and slightly from +Z, so far away that the box fits; a wide view is wider than high, the others about square
    lo, hi = recording.focus
    target = np.array([(lo[0] + hi[0]) / 2, lo[1], (lo[2] + hi[2]) / 2])
    distance = max((1.0 if wide else 1.25) * (hi[0] - lo[0]), 1.25 * (hi[2] - lo[2]), 3.0)
    eye = target + distance * np.array([0.0, 1.0, 0.42])
    return rrb.Spatial3DView(
        origin=recording.world,
        name=recording.name,
        overrides={entity: rrb.EntityBehavior(visible=False) for entity in recording.hidden},
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0, 1, 0)),
        line_grid=False,
    )
