"""Entry points of the programs here."""

from protocol.program.start import run


def export() -> int:
    """`ethercat-export`."""
    return run("clients.export.cli")


def identify() -> int:
    """`ethercat-identify`."""
    return run("clients.identify.cli")


def monitor() -> int:
    """`ethercat-monitor`."""
    return run("clients.monitor.cli")


def record() -> int:
    """`ethercat-record`."""
    return run("clients.record.cli")


def replay() -> int:
    """`ethercat-replay`."""
    return run("clients.replay.cli")


def report() -> int:
    """`ethercat-report`."""
    return run("clients.report.cli")
