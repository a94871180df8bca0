#!/usr/bin/env bash
# rclpy (ros-rclpy 7.1.6, Jazzy): EventsExecutor runs no node that has a guard condition, and says so at the first spin.
#
# One would guess: the executor of rclpy.experimental takes any node, for it has every method of the others, and
# services, timers, subscriptions and tasks run in it as they do there.
# What happens: `create_guard_condition` and `add_node` succeed; the first `spin_once` raises RuntimeError (Guard
# conditions not supported), and none of the node's callbacks has run. `create_task` from another thread, which other
# executors carry out by a guard condition of their own, does work.
# Where it is met: a node that wakes its executor from a thread of a driver by a guard condition, and is moved to
# EventsExecutor for its lower CPU time: `create_task` is the way that both have.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check 'ros-rclpy[fastrtps]==7.1.6' ros-jazzy-common-interfaces 'numpy<3'
export AMENT_PREFIX_PATH=$folder/venv ROS_LOG_DIR=$folder/log ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
cat >"$folder/check.py" <<'END'
import threading
import time
from importlib.metadata import version

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental import EventsExecutor

print("ros-rclpy", version("ros-rclpy"))
rclpy.init()


def spun(make, guarded):
    """What had its turn within 1 s: the timer, a task from another thread, the guard condition; or the error."""
    node, seen = rclpy.create_node("checked"), set()
    executor = make()
    executor.add_node(node)
    node.create_timer(0.05, lambda: seen.add("timer"))
    if guarded:
        guard = node.create_guard_condition(lambda: seen.add("guard"))
        threading.Timer(0.2, guard.trigger).start()
    threading.Timer(0.2, executor.create_task, [lambda: seen.add("task")]).start()
    end = time.monotonic() + 1.0
    try:
        while time.monotonic() < end:
            executor.spin_once(0.05)
    except RuntimeError as error:
        return str(error), seen
    return "", seen


for make in (SingleThreadedExecutor, EventsExecutor):
    for guarded in (False, True):
        error, seen = spun(make, guarded)
        print(f"{make.__name__}, {'with' if guarded else 'without'} a guard condition: {error or sorted(seen)}")
        wanted = {"timer", "task"} | ({"guard"} if guarded else set())
        if make is EventsExecutor and guarded:
            assert ("not supported" in error, seen) == (True, set()), "the behavior has changed"
        else:
            assert seen == wanted, "the behavior has changed"
END
"$folder/venv/bin/python" "$folder/check.py"
