"""Entry points of the programs here, which need Linux and what `pip install .` installs there."""

import sys
from pathlib import PurePath

from bota_ethercat.program import start

# What is missing after `pip install --no-deps .`, and on other systems.
_NEEDED = frozenset({"pysoem", "pyroute2", "fcntl", "grp", "pwd", "resource"})


def run(module: str) -> int:
    """As `start.run`, with a sentence if something is missing."""
    try:
        return start.run(module)
    except ModuleNotFoundError as error:
        if error.name not in _NEEDED:
            raise
        program = PurePath(sys.argv[0]).name
        sys.stderr.write(f"{program}: {error.name} is missing: this needs Linux and 'pip install .' there\n")
        return 1


def server() -> int:
    """`ethercat-server`."""
    return run("ethercat_server.daemon.cli")


def sensor() -> int:
    """`ethercat-sensor`."""
    return run("ethercat_server.tool.cli")


def doctor() -> int:
    """`ethercat-doctor`."""
    return run("ethercat_server.doctor.cli")


def virtual_sensor() -> int:
    """`ethercat-virtual-sensor`."""
    return run("ethercat_server.virtual_sensor.cli")
