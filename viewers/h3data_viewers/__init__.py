"""Windows on a recording."""

from h3data_viewers.rerun_cameras import CameraFeed
from h3data_viewers.rerun_view import write_rrd

__all__ = ["CameraFeed", "write_rrd"]
