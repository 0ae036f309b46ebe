"""The first arrangement of the Rerun window: 3-D on the left; cameras, distances, lanes and log on the right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import rerun.blueprint as rrb


def layout(
    *,
    focus: NDArray[np.floating],
    hidden: Sequence[str],
    cameras: Sequence[str],
    plotted: Sequence[str],
    lanes: Sequence[str],
    has_log: bool,
) -> rrb.Blueprint:
    """A blueprint for what was logged; rows without content are left out.

    ``focus`` is the box [2, 3] that the 3-D view shows first; ``hidden`` entities are switched off (ceilings).
    """
    import rerun.blueprint as rrb

    eye, target = bird_view(focus)
    world = rrb.Spatial3DView(
        origin="/world",
        name="Home",
        overrides={entity: rrb.EntityBehavior(visible=False) for entity in hidden},
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0, 1, 0)),
        line_grid=False,
    )
    rows: list[rrb.View | rrb.Container] = []
    shares: list[float] = []
    if cameras:
        views = [rrb.Spatial2DView(origin=entity, name=entity.rsplit("/", 1)[-1]) for entity in cameras]
        rows.append(views[0] if len(views) == 1 else rrb.Grid(*views, grid_columns=min(len(views), 3)))
        shares.append(1.3 if len(views) <= 3 else 2.0)
    if plotted:
        rows.append(rrb.TimeSeriesView(origin="/metrics", contents=list(plotted), name="Distances [m]"))
        shares.append(1.0)
    if lanes:
        rows.append(rrb.StateTimelineView(origin="/actions", contents=list(lanes), name="Actions"))
        shares.append(0.35 + 0.22 * len(lanes))
    if has_log:
        rows.append(rrb.TextLogView(origin="/log", name="Events"))
        shares.append(0.7)
    root = rrb.Horizontal(world, rrb.Vertical(*rows, row_shares=shares), column_shares=[3, 2]) if rows else world
    return rrb.Blueprint(root, rrb.TimePanel(state="collapsed", timeline="step"), collapse_panels=True)


def bird_view(focus: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Eye and target [3] of a view from above and the side (+Z) that shows the box ``focus`` [2, 3]."""
    lo, hi = focus
    target = np.array([(lo[0] + hi[0]) / 2, lo[1], (lo[2] + hi[2]) / 2])
    reach = max(hi[0] - lo[0], hi[2] - lo[2], 3.0)
    return target + reach * np.array([0.0, 1.0, 0.42]), target
