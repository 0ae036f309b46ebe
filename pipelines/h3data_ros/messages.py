"""Types of ROS 2 messages and their quality-of-service profiles, without ROS (needs ``h3data[ros]``)."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from h3data.errors import MissingExtraError

if TYPE_CHECKING:
    from rosbags.interfaces import Qos
    from rosbags.typesys.store import Typestore

DEFINITIONS = {
    "people_msgs/msg/Person": """string name
geometry_msgs/Point position
geometry_msgs/Point velocity
float64 reliability
string[] tagnames
string[] tags
""",
    "people_msgs/msg/People": """std_msgs/Header header
people_msgs/Person[] people
""",
    "hri_msgs/msg/IdsList": """std_msgs/Header header
string[] ids
""",
    "spencer_tracking_msgs/msg/TrackedPerson": """uint64 track_id
bool is_occluded
bool is_matched
uint64 detection_id
builtin_interfaces/Duration age
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist
""",
    "spencer_tracking_msgs/msg/TrackedPersons": """std_msgs/Header header
spencer_tracking_msgs/TrackedPerson[] tracks
""",
}
"""Definitions of messages about people, which ROS does not include, by type."""


def require_rosbags() -> None:
    """Raise a `MissingExtraError` if the extra ``ros`` is not installed."""
    try:
        import rosbags.rosbag2  # noqa: F401
    except ImportError:
        raise MissingExtraError(
            'Bags of ROS 2 need rosbags. Hint: pip install "h3data[ros]"', code="H3-ROS-001"
        ) from None


@cache
def message_types() -> Typestore:
    """Return the types of ROS 2 Humble, whose wire formats Jazzy shares, and `DEFINITIONS`."""
    require_rosbags()
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    for name, text in DEFINITIONS.items():
        types |= get_types_from_msg(text, name)
    store.register(types)
    return store


def delivery(*, latched: bool = False, best_effort: bool = False) -> Qos:
    """Return a quality-of-service profile; ``latched`` messages are stored for late subscribers (transient local)."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    forever = QosTime(9223372036, 854775807)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=QosReliability.BEST_EFFORT if best_effort else QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )
