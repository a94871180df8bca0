"""Entry points of the programs here."""

from protocol.program.start import run


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
