"""Viewers of recordings: Rerun files (`rerun`), HTML replays (`html_replay`) and the HTML report (`html_report`).

Everything is imported at first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from h3data.moved import lazy_names

if TYPE_CHECKING:
    from h3data_viewers.html_replay.html_file import write_html
    from h3data_viewers.rerun.cameras import CameraFeed, rendered_feed
    from h3data_viewers.rerun.rrd_file import ViewedRecording, write_comparison_rrd, write_rrd

__all__ = ["CameraFeed", "ViewedRecording", "rendered_feed", "write_comparison_rrd", "write_html", "write_rrd"]

__getattr__ = lazy_names(
    __name__,
    {
        "CameraFeed": ".rerun.cameras",
        "ViewedRecording": ".rerun.rrd_file",
        "rendered_feed": ".rerun.cameras",
        "write_comparison_rrd": ".rerun.rrd_file",
        "write_html": ".html_replay.html_file",
        "write_rrd": ".rerun.rrd_file",
    },
)
