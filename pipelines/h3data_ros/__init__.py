"""Export and import of ROS 2 bags, tracks of people, and map_server maps, without an installation of ROS.

These formats are recognised by `h3data.formats.builtin_formats`.
"""

from dataclasses import replace

from h3data.formats.builtin_formats import BUILT_IN, TABLES

_RECOGNISED = {one.name: one for one in (*BUILT_IN, *TABLES)}

ROSBAG2 = replace(
    _RECOGNISED["rosbag2"],
    suffixes=("metadata.yaml",),
    read="h3data_ros.bag_import:read_rosbag2",
    read_options=("tracks",),
    write="h3data_ros.bag_export:export_rosbag2",
    write_options=("assets", "people", "stand_ins", "cameras", "storage", "lidar"),
    target="folder",
)
TRACKS = replace(_RECOGNISED["tracks"], read="h3data_ros.track_import:read_tracks", read_options=("tracks",))
