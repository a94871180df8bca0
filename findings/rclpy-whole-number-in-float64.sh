#!/usr/bin/env bash
# rclpy (ros-rclpy 7.1.6, Jazzy): a whole number in a float64 field is sent as 5e-324.
#
# One would guess: `message.wrench.force.x = 5` either raises or sends 5.0, for Python converts everywhere else.
# What happens: the attribute keeps the int and prints as 5, and the C extension reads the object as if it were a float: a
# subscriber, a bag and every tool get 5e-324, which plots as 0. A list of ints in Float64MultiArray does arrive right,
# so half of a program may look correct. With ROS_PYTHON_CHECK_FIELDS=1 the assignment raises; it is off by default.
# Where it is met: a wrench that is set by hand in a test or a controller, and numpy.float32 values from a policy.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check 'ros-rclpy[fastrtps]==7.1.6' ros-jazzy-common-interfaces 'numpy<3'
export AMENT_PREFIX_PATH=$folder/venv ROS_LOG_DIR=$folder/log
unset ROS_PYTHON_CHECK_FIELDS _ROS_WHEELS_BOOTSTRAP_COMPLETE
cat >"$folder/check.py" <<'END'
from importlib.metadata import version

import numpy as np
from geometry_msgs.msg import Vector3
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Float64MultiArray

def sent(value):
    message = Vector3()
    message.x = value
    return message.x, deserialize_message(serialize_message(message), Vector3).x

print("ros-rclpy", version("ros-rclpy"))
for value in (5.0, 5, np.float32(5)):
    shown, received = sent(value)
    print(f"{type(value).__name__} {value}: the sender shows {shown}, a subscriber gets {received}")
array = Float64MultiArray(data=[1, 2])
assert list(deserialize_message(serialize_message(array), Float64MultiArray).data) == [1.0, 2.0]
print("Float64MultiArray(data=[1, 2]): a subscriber gets [1.0, 2.0]")
assert sent(5.0)[1] == 5.0
assert 0 < sent(5)[1] < 1e-300, "the behavior has changed"
END
"$folder/venv/bin/python" "$folder/check.py"
