#!/usr/bin/env bash
# rclpy (ros-rclpy 7.1.6, Jazzy, Fast DDS): of two processes with two types on one topic neither is told.
#
# One would guess: the event `incompatible_type` of `SubscriptionEventCallbacks` and `PublisherEventCallbacks`, which is
# accepted without an error, is called when the other side has another type, as `incompatible_qos` is for its QoS.
# What happens: it never is, nothing is logged, and no message comes; `count_publishers` and `count_subscribers` of the
# node count the other all the same, while the endpoints' own counts (`get_publisher_count`, `get_subscription_count`)
# are 0. Who publishes what is in `get_publishers_info_by_topic(topic)[n].topic_type`.
# Where it is met: a driver that takes a robot's orientation as PoseStamped from a topic on which the robot sends Imu.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check 'ros-rclpy[fastrtps]==7.1.6' ros-jazzy-common-interfaces 'numpy<3'
export AMENT_PREFIX_PATH=$folder/venv ROS_LOG_DIR=$folder/log ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
cat >"$folder/check.py" <<'END'
import subprocess
import sys
import time
from importlib.metadata import version

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

TOPIC, events, got = "/orientation", [], []
talks = len(sys.argv) > 1
if not talks:
    print("ros-rclpy", version("ros-rclpy"))
    beside = subprocess.Popen([sys.executable, __file__, "talk"])
rclpy.init()
node, executor = rclpy.create_node("talker" if talks else "listener"), SingleThreadedExecutor()
executor.add_node(node)
called = {f"incompatible_{what}": lambda _, what=what: events.append(what) for what in ("type", "qos")}
if talks:
    told = PublisherEventCallbacks(**called)
    for_type = node.create_publisher(Imu, TOPIC, 10, event_callbacks=told)
    weak = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    for_qos = node.create_publisher(Imu, TOPIC + "/qos", weak, event_callbacks=told)
else:
    told = SubscriptionEventCallbacks(**called)
    heard = node.create_subscription(PoseStamped, TOPIC, got.append, 10, event_callbacks=told)
    node.create_subscription(Imu, TOPIC + "/qos", got.append, 10, event_callbacks=told)
end = time.monotonic() + 6.0
while time.monotonic() < end:
    if talks:
        for_type.publish(Imu())
        for_qos.publish(Imu())
    executor.spin_once(0.05)
    if not talks and beside.poll() is None:
        counted = node.count_publishers(TOPIC)
        sent = [each.topic_type for each in node.get_publishers_info_by_topic(TOPIC)] or ["nothing yet"]
    elif talks:
        counted = node.count_subscribers(TOPIC)
    if counted and "qos" in events and time.monotonic() > end - 3.0:
        break
own = for_type.get_subscription_count() if talks else heard.get_publisher_count()
print(f"{node.get_name()}: the node counts {counted}, the endpoint {own}; events: {sorted(set(events))}; got {len(got)}")
assert (counted, own, set(events), got) == (1, 0, {"qos"}, []), "the behavior has changed"
if not talks:
    print("what is published:", *sent)
    assert sent == ["sensor_msgs/msg/Imu"], "the behavior has changed"
    assert beside.wait(20) == 0, "the behavior of the talker has changed"
END
"$folder/venv/bin/python" "$folder/check.py"
