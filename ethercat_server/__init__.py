"""The privileged side: owns the EtherCAT bus and streams the sensor's process data over TCP."""

__version__: str


def __getattr__(name: str) -> str:
    if name != "__version__":
        raise AttributeError(name)
    # Only when it is asked for: it takes longer than all else of a start, and Ctrl-C must not wait for it.
    from bota_ethercat.program.version import VERSION  # noqa: PLC0415

    return VERSION
