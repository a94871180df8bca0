"""The guard on all SDO writes: the factory calibration is never written."""

from __future__ import annotations

from ethercat_server.errors import ForbiddenWriteError
from ethercat_server.ethercat.datagrams import Steps
from ethercat_server.ethercat.slave.coe import Sdo
from ethercat_server.sensor.objects.dictionary import FACTORY_CALIBRATION


class GuardedSdo:
    """An `Sdo` that never writes the factory calibration. Sensors are written to through it only."""

    def __init__(self, sdo: Sdo) -> None:
        self._sdo = sdo
        self.clock = sdo.clock

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        return (yield from self._sdo.read(index, subindex))

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """See `Sdo`; ForbiddenWriteError for the factory calibration."""
        if index == FACTORY_CALIBRATION:
            raise ForbiddenWriteError(
                "object 0x2000 holds the factory calibration, which is never written: leave it as it is"
            )
        yield from self._sdo.write(index, subindex, data)
