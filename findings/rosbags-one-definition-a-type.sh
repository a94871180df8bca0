#!/usr/bin/env bash
# rosbags 0.11.9 and MCAP: a file with two definitions of one type is decoded with the last one, for all topics.
#
# One would guess: an MCAP file has a schema for each channel, so each topic is decoded with its own; or the reader
# refuses two definitions of one name.
# What happens: AnyReader keeps one definition for each name. Messages of the other topic are decoded with it, and
# where the fields have the same size, without an error: force and torque are exchanged. Each connection does have its
# own text (`msgdef`), and mcap-ros2-support 0.6.0 decodes by it. A user meets it in a merged recording of two
# computers, or when a message package was changed and built on one of them only.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check rosbags==0.11.9 mcap==1.6.0 mcap-ros2-support==0.6.0
cat >"$folder/check.py" <<'END'
import struct, sys
from importlib.metadata import version
from pathlib import Path

from mcap.writer import Writer
from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader

path = Path(sys.argv[1], "two.mcap")
FORCE, TORQUE = 5.0, 0.25
with path.open("wb") as file:
    writer = Writer(file)
    writer.start(profile="ros2", library="")
    for topic, order in (("/left", ("force", "torque")), ("/right", ("torque", "force"))):
        definition = "".join(f"float64 {name}\n" for name in order).encode()
        schema = writer.register_schema("gripper_msgs/msg/Load", "ros2msg", definition)
        channel = writer.register_channel(topic, "cdr", schema)
        values = {"force": FORCE, "torque": TORQUE}
        data = bytes((0, 1, 0, 0)) + struct.pack("<2d", *(values[name] for name in order))
        writer.add_message(channel, log_time=1, data=data, publish_time=1)
    writer.finish()

by_mcap = {each.channel.topic: each.ros_msg.force for each in read_ros2_messages(str(path))}
with AnyReader([path]) as reader:
    by_rosbags = {
        each.topic: reader.deserialize(data, each.msgtype).force for each, _, data in reader.messages()}
for name, seen in (("mcap-ros2-support", by_mcap), ("rosbags", by_rosbags)):
    print(f"{name} {version(name)}: a force of {FORCE} and a torque of {TORQUE} are read as force", seen)
assert by_mcap == {"/left": FORCE, "/right": FORCE}
assert by_rosbags == {"/left": TORQUE, "/right": FORCE}, "the behavior has changed"
END
"$folder/venv/bin/python" "$folder/check.py" "$folder"
