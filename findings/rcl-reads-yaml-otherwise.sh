#!/usr/bin/env bash
# rcl (ros-rclpy 7.1.6, Jazzy) and PyYAML 6.0.3: a parameter file is read as something else than what was written.
#
# One would guess: both read YAML, so a parameter file that Python's yaml writes (a launch file, a calibration program)
# gives the node the same values; and whole numbers beside others in a list are numbers like them.
# What happens: rcl has rules of its own. PyYAML writes the strings y, 1e3 and 12E5 (an axis, a serial number) without
# quotes, and reads them as strings again; rcl reads true, 1000.0 and 1200000.0. The other way round, 12:30 is 750 to
# PyYAML and a string to rcl, 1e-3 a string to PyYAML and a number to rcl. For a list like [0, 0, 0.05] rcl refuses the
# whole file, before there is a node. A user meets it with names, serial numbers, mounting poses and small values of
# inertia. Quotes around every string, and digits on both sides of a point in every number (0.000010), suit both.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check 'ros-rclpy[fastrtps]==7.1.6' \
    ros-jazzy-common-interfaces pyyaml==6.0.3
export AMENT_PREFIX_PATH=$folder/venv ROS_LOG_DIR=$folder/log ROS_AUTOMATIC_DISCOVERY_RANGE=OFF
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
cat >"$folder/check.py" <<'END'
import sys
from importlib.metadata import version
from pathlib import Path

import rclpy
import yaml
from rclpy.context import Context
from rclpy.node import Node

def of_rcl(text):
    """The parameter `x` of a node, with a parameter file that has `x: text`."""
    path = Path(sys.argv[1], "parameters.yaml")
    path.write_text(f"/**:\n  ros__parameters:\n    x: {text}\n")
    context = Context()
    try:
        rclpy.init(args=["--ros-args", "--params-file", str(path)], context=context)
    except Exception as error:
        return "refused: " + ("Sequence should be of same type" if "of same type" in str(error) else str(error))
    node = Node("check", context=context, automatically_declare_parameters_from_overrides=True)
    value = node.get_parameter("x").value
    node.destroy_node()
    rclpy.shutdown(context=context)
    return value

print("ros-rclpy", version("ros-rclpy"), "PyYAML", version("pyyaml"))
seen = {}
for value in ("y", "1e3", "12E5", "off", [0, 0, 0.05]):
    text = yaml.safe_dump({"x": value}, default_flow_style=True).strip("{}\n").removeprefix("x: ")
    assert yaml.safe_load(text) == value
    seen[text] = of_rcl(text)
    print(f"PyYAML writes {value!r} as {text}, rcl reads {seen[text]!r}")
for text in ("12:30", "1e-3"):
    seen[text] = of_rcl(text)
    print(f"{text} is {yaml.safe_load(text)!r} to PyYAML, {seen[text]!r} to rcl")
assert yaml.safe_load("[12:30, 1e-3]") == [750, "1e-3"]
assert seen == {
    "y": True, "1e3": 1000.0, "12E5": 1200000.0, "'off'": "off",
    "[0, 0, 0.05]": "refused: Sequence should be of same type", "12:30": "12:30", "1e-3": 0.001,
}, "the behavior has changed"
END
"$folder/venv/bin/python" "$folder/check.py" "$folder" 2>"$folder/errors" || { cat "$folder/errors"; exit 1; }
