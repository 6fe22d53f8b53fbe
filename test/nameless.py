"""A ROS node whose name is not UTF-8. No client library makes one, but nothing keeps a stranger from being one.

Which node an endpoint belongs to stands on the DDS topic ``ros_discovery_info``, where every participant tells what it
holds. Here an ordinary node says so under a name of its own choosing, through rmw's C interface, since rclpy
puts a slash before every topic. ``python nameless.py TOPIC TYPE`` opens a publisher, which stays silent, prints
"ready", and ends when its stdin is closed. With Fast DDS only.
"""

from __future__ import annotations

import ctypes
import select
import sys
from collections.abc import Callable

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.type_support import check_for_type_support
from rmw_dds_common.msg import Gid, NodeEntitiesInfo, ParticipantEntitiesInfo
from sensor_msgs.msg import JointState

KINDS = {kind.__name__: kind for kind in (JointState, PoseStamped)}

NAME = b"mill\xff\x1b[31m"
"""Neither UTF-8 nor good for a terminal."""

PARTICIPANT = (0, 0, 1, 0xC1)
"""Entity id of every participant (OMG DDS-RTPS 9.3.1.2); the first twelve bytes of a GUID are its participant's."""

KEEP_LAST = RELIABLE = TRANSIENT_LOCAL = 1


class Time(ctypes.Structure):
    """``rmw_time_t``; zero: by default."""

    _fields_ = [("sec", ctypes.c_uint64), ("nsec", ctypes.c_uint64)]


class Qos(ctypes.Structure):
    """``rmw_qos_profile_t``."""

    _fields_ = [
        ("history", ctypes.c_int),
        ("depth", ctypes.c_size_t),
        ("reliability", ctypes.c_int),
        ("durability", ctypes.c_int),
        ("deadline", Time),
        ("lifespan", Time),
        ("liveliness", ctypes.c_int),
        ("liveliness_lease_duration", Time),
        ("avoid_ros_namespace_conventions", ctypes.c_bool),
    ]


class PublisherOptions(ctypes.Structure):
    """``rmw_publisher_options_t``."""

    _fields_ = [("payload", ctypes.c_void_p), ("unique_network_flow", ctypes.c_int)]


class Serialized(ctypes.Structure):
    """``rmw_serialized_message_t``."""

    _fields_ = [
        ("buffer", ctypes.c_char_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", ctypes.c_void_p * 5),
    ]


def entities(gid: list[int], name: bytes) -> bytes:
    """Return the message that a publisher belongs to a node of this name, serialised."""
    mark = "?" * len(name)
    node = NodeEntitiesInfo(node_namespace="/", node_name=mark, writer_gid_seq=[Gid(data=gid)])
    message = ParticipantEntitiesInfo(gid=Gid(data=[*gid[:12], *PARTICIPANT]), node_entities_info_seq=[node])
    return serialize_message(message).replace(mark.encode(), name)


def teller(node: Node, data: bytes) -> Callable[[], None]:
    """Return what publishes a serialised message on ``ros_discovery_info``."""
    rcl, rmw = ctypes.CDLL("librcl.so"), ctypes.CDLL("librmw_fastrtps_cpp.so")
    rcl.rcl_node_get_rmw_handle.restype = rmw.rmw_create_publisher.restype = ctypes.c_void_p
    capsule_pointer = ctypes.pythonapi.PyCapsule_GetPointer
    capsule_pointer.restype, capsule_pointer.argtypes = ctypes.c_void_p, (ctypes.py_object, ctypes.c_char_p)
    check_for_type_support(ParticipantEntitiesInfo)
    support = ctypes.c_void_p(capsule_pointer(ParticipantEntitiesInfo._TYPE_SUPPORT, None))
    handle = ctypes.c_void_p(rcl.rcl_node_get_rmw_handle(ctypes.c_void_p(node.handle.pointer)))
    qos, options = Qos(KEEP_LAST, 1, RELIABLE, TRANSIENT_LOCAL), PublisherOptions()
    qos.avoid_ros_namespace_conventions = True
    topic = b"ros_discovery_info"
    publisher = rmw.rmw_create_publisher(handle, support, topic, ctypes.byref(qos), ctypes.byref(options))
    serialized = Serialized(data, len(data), len(data))

    def tell() -> None:
        code = rmw.rmw_publish_serialized_message(ctypes.c_void_p(publisher), ctypes.byref(serialized), None)
        if code != 0:
            raise RuntimeError(f"rmw_publish_serialized_message returned {code}")

    return tell


def main() -> None:
    """Publish as a node without a readable name until stdin is closed."""
    topic, kind = sys.argv[1:]
    rclpy.init(args=[])
    node = rclpy.create_node("nameless")
    node.create_publisher(KINDS[kind], topic, 10)
    gids = [i.endpoint_gid for i in node.get_publishers_info_by_topic(topic) if i.node_name == "nameless"]
    tell = teller(node, entities(list(gids[0]), NAME))
    tell()
    print("ready", flush=True)
    # rmw itself has told of a node with a good name. Which of the two a listener hears last is chance, so this one goes
    # on.
    while not select.select([sys.stdin], [], [], 0.1)[0]:
        tell()


if __name__ == "__main__":
    main()
