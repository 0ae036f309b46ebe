"""Windows on a recording."""

from h3data_viewers.rerun.rerun_cameras import CameraFeed, drawn_feed
from h3data_viewers.rerun.rerun_view import Shown, write_comparison_rrd, write_rrd

__all__ = ["CameraFeed", "Shown", "drawn_feed", "write_comparison_rrd", "write_rrd"]
