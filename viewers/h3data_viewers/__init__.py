"""Viewers of recordings: Rerun files (`rerun`) and the HTML report (`html_report`)."""

from h3data_viewers.rerun.cameras import CameraFeed, rendered_feed
from h3data_viewers.rerun.rrd_file import ShownRecording, write_comparison_rrd, write_rrd

__all__ = ["CameraFeed", "ShownRecording", "rendered_feed", "write_comparison_rrd", "write_rrd"]
