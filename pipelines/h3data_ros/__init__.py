"""ROS 2 without ROS: bags out and in, tracks of people in the files of data sets, and maps of map_server as scenes."""

from h3data.formats import Format

ROSBAG2 = Format(
    name="rosbag2",
    title="a bag of ROS 2",
    write="h3data_ros.bag_export:export_rosbag2",
    write_options=("assets", "people", "stand_ins", "cameras", "storage", "lidar"),
    target="folder",
)
