"""The first arrangement of the Rerun window: homes in 3-D; cameras, distances, lanes and log beside or below."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import rerun.blueprint as rrb


@dataclass(frozen=True, kw_only=True, eq=False)
class Side:
    """What was logged of one recording."""

    label: str
    """Root of its entities; empty if it is shown alone."""
    name: str
    """Title of its home."""
    world: str
    """Path of its home; the paths below are absolute, too."""
    focus: NDArray[np.floating]
    """Box [2, 3] that the 3-D view shows first [m]."""
    hidden: Sequence[str]
    """What is switched off: ceilings."""
    cameras: Sequence[str]
    plotted: Sequence[str]
    lanes: Sequence[str]
    log: str
    """Root of the log; empty without one."""
    inputs: str
    """Root of people's raw input; empty without any."""


def layout(sides: Sequence[Side], *, timeline: str) -> rrb.Blueprint:
    """A blueprint for what was logged; rows without content are left out, and all sides share plots, lanes and log.

    One home stands on the left; several stand side by side above the rest.
    """
    import rerun.blueprint as rrb

    homes = [_home(side) for side in sides]
    rows: list[rrb.View | rrb.Container] = []
    shares: list[float] = []
    cameras = [(entity, side) for side in sides for entity in side.cameras]
    if cameras:
        views = [
            rrb.Spatial2DView(origin=entity, name=f"{side.label} {entity.rsplit('/', 1)[-1]}".lstrip())
            for entity, side in cameras
        ]
        rows.append(views[0] if len(views) == 1 else rrb.Grid(*views, grid_columns=min(len(views), 3)))
        shares.append(1.3 if len(views) <= 3 else 2.0)
    plotted = [entity for side in sides for entity in side.plotted]
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
    lanes = [entity for side in sides for entity in side.lanes]
    if lanes:
        rows.append(rrb.StateTimelineView(origin="/", contents=lanes, name="Actions"))
        shares.append(0.35 + 0.22 * len(lanes))
    for name, roots in (("Events", [side.log for side in sides]), ("Input", [side.inputs for side in sides])):
        if any(roots):
            rows.append(rrb.TextLogView(origin="/", contents=[f"{root}/**" for root in roots if root], name=name))
            shares.append(0.7)
    time = rrb.TimePanel(state="collapsed", timeline=timeline)
    if not rows:
        root = homes[0] if len(homes) == 1 else rrb.Horizontal(*homes)
    elif len(homes) == 1:
        root = rrb.Horizontal(homes[0], rrb.Vertical(*rows, row_shares=shares), column_shares=[3, 2])
    else:
        root = rrb.Vertical(rrb.Horizontal(*homes), rrb.Horizontal(*rows), row_shares=[3, 2])
    return rrb.Blueprint(root, time, collapse_panels=True)


def _home(side: Side) -> rrb.View:
    import rerun.blueprint as rrb

    eye, target = bird_view(side.focus)
    return rrb.Spatial3DView(
        origin=side.world,
        name=side.name,
        overrides={entity: rrb.EntityBehavior(visible=False) for entity in side.hidden},
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0, 1, 0)),
        line_grid=False,
    )


def bird_view(focus: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Eye and target [3] of a view from above and the side (+Z) that shows the box ``focus`` [2, 3]."""
    lo, hi = focus
    target = np.array([(lo[0] + hi[0]) / 2, lo[1], (lo[2] + hi[2]) / 2])
    reach = max(hi[0] - lo[0], 1.25 * (hi[2] - lo[2]), 3.0)  # depth needs more room: the window is wide
    return target + reach * np.array([0.0, 1.0, 0.42]), target
