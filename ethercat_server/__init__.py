"""The privileged side: owns the EtherCAT bus and streams the sensor's process data over TCP."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("bota-ethercat-bridge")
except PackageNotFoundError:  # run from a checkout that was never installed
    __version__ = "0+unknown"
