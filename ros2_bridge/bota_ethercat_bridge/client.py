# SPDX-License-Identifier: Apache-2.0
"""The program `ros2 run bridge client`, on PATH as `bridge-client`: arguments, signals, exit codes.

Exit codes: 0 ended as asked (SIGINT, SIGTERM, SIGHUP, supervisor), 1 could not start or failed, 2 wrong
arguments or parameters, 3 ended as the supervisor asked, but the server refused to shut down. While ROS
starts and the node is built the signals have their default action, so that nothing of ROS can hold it up.
"""

from __future__ import annotations

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C is never a traceback, whatever is being imported

import contextlib  # noqa: E402
import sys  # noqa: E402
from collections.abc import Sequence  # noqa: E402
from importlib import import_module  # noqa: E402
from typing import Any  # noqa: E402

from bota_ethercat_bridge.process import StopSignals, environment_problem, refuse  # noqa: E402

USAGE = """\
examples:
  ros2 run bridge client                                         # of the server on this computer
  ros2 run bridge client --ros-args -p server_host:=robot        # of another computer's
  ros2 run bridge client --ros-args --params-file client.yaml    # with the parameters in a file

usage: ros2 run bridge client [--ros-args -p NAME:=VALUE ... --params-file FILE ...]
       bridge-client          [--ros-args ...]

Publishes the force/torque sensor that ethercat-server serves. Parameters, topics and their
defaults: share/bota_ethercat_bridge/config/client.yaml.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    _open_streams()
    signals = StopSignals()
    own = list(sys.argv[1:] if arguments is None else arguments)
    if own and own[0] in {"-h", "--help"}:
        sys.stdout.write(USAGE)
        return 0
    if problem := environment_problem():
        return refuse(problem, 1)
    run = _load("node", "run")
    if run is None:
        return 1
    code: int = run(own, signals) if signals.begin() else 0
    return code


def check_subscription() -> int:
    """The program `bridge-check-subscription`, in the module of that name."""
    _open_streams()
    if problem := environment_problem():
        return refuse(problem, 1)
    measure = _load("check_subscription", "main")
    return 1 if measure is None else int(measure())


def _open_streams() -> None:
    with contextlib.suppress(ImportError):  # which `_load` tells
        import_module("bota_ethercat.program.start").open_streams()


def _load(module: str, function: str) -> Any:
    """A function of a module that needs ROS; None, after the reason is said, where that is missing."""
    try:
        return getattr(import_module(f"bota_ethercat_bridge.{module}"), function)
    except ImportError as error:
        missing = (error.name or "").partition(".")[0]
        remedy = "source ROS 2, or pip install the extra 'ros'"
        if missing == "bota_ethercat":
            remedy = "build the package bota_ethercat_protocol too"
        refuse(f"{missing} cannot be loaded ({error}): {remedy}", 1)
    return None


if __name__ == "__main__":
    sys.exit(main())
