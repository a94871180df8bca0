"""Entry points of the programs here."""

from bota_ethercat.program.start import run  # first: from here on Ctrl-C is no traceback

# isort: split
from collections.abc import Callable


def _program(module: str) -> Callable[[], int]:
    return lambda: run(f"bota_clients.{module}")


export = _program("export.cli")
identify = _program("identify.cli")
monitor = _program("monitor.cli")
record = _program("record.cli")
replay = _program("replay.cli")
report = _program("report.cli")
