"""Entry points of the programs here, which need Linux and what `pip install .` installs there."""

from bota_ethercat.program import start  # first: from here on Ctrl-C is no traceback

# isort: split
import sys
from collections.abc import Callable
from pathlib import PurePath

# What is missing after `pip install --no-deps`, and on other systems.
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


def _program(module: str) -> Callable[[], int]:
    return lambda: run(f"ethercat_server.{module}.cli")


server = _program("daemon")
sensor = _program("tool")
doctor = _program("doctor")
virtual_sensor = _program("virtual_sensor")
