"""Entry points of the programs here."""

from bota_ethercat.program.start import run


def export() -> int:
    """`ethercat-export`."""
    return run("bota_clients.export.cli")


def identify() -> int:
    """`ethercat-identify`."""
    return run("bota_clients.identify.cli")


def monitor() -> int:
    """`ethercat-monitor`."""
    return run("bota_clients.monitor.cli")


def record() -> int:
    """`ethercat-record`."""
    return run("bota_clients.record.cli")


def replay() -> int:
    """`ethercat-replay`."""
    return run("bota_clients.replay.cli")


def report() -> int:
    """`ethercat-report`."""
    return run("bota_clients.report.cli")
