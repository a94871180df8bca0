"""While the sensor's own offset is being written, for whomever, no compensated sample has part of it."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import pytest

from bota_clients.recording.columns import columns
from bota_ethercat.client import Client
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.stream.timeline import InForce
from bota_ft_compensation.bias import BiasRamp
from bota_ft_compensation.imu import ImuSource
from bota_ft_compensation.quantities import NO_WRENCH, ZERO, Wrench
from bota_ft_compensation.stream import CompensatedStream, Plan
from ethercat_server.simulation.server import MemoryChannel
from tests.simulation import AT_REST, Bench

TARE: Final = {"samples": 50, "target": [9.0, 8.0, -7.0, 0.3, 0.2, 0.1]}
WRITE: Final = {"index": 0x8000, "subindex": 2, "type": "f32", "value": 5.0}
BIAS: Final = Wrench((1.0, -2.0, 3.0), (0.1, 0.2, -0.3))


@pytest.mark.parametrize(
    ("keys", "command", "most", "settings", "bias"),
    [
        (TARE, "", 14, {}, None),
        (TARE, "", 14, {}, BIAS),
        (TARE, "", 14, {"sinc_length": 512, "fir": True}, BIAS),
        (TARE, "on-write 0x8000 2 abort 0x8000 3 0x06010000", 20, {}, BIAS),  # it is undone
        (TARE, "on-write 0x8000 3 power cycle 0.2", 14, {}, BIAS),
        (WRITE, "", 9, {}, BIAS),
        (WRITE | {"value": 0.0}, "", 9, {}, None),  # nothing changes
        (WRITE, "abort 0x8000 2 0x06010000", 9, {}, BIAS),
    ],
)
def test_no_compensated_sample_has_part_of_it(
    keys: dict[str, Any], command: str, most: int, settings: dict[str, Any], bias: Wrench | None
) -> None:
    bench, stream, found = Bench(AT_REST, settings=settings), CompensatedStream(), list[np.ndarray]()
    stream.plan = Plan(ImuSource(ZERO), ramp=BiasRamp(bias or NO_WRENCH))
    with Client(1, channel=MemoryChannel(bench)) as client:
        client.connect()
        if command:
            bench.command(command)
        bench.asking.send("sdo_write" if "index" in keys else "tare", **keys)
        left = 50  # samples, once it is answered
        while left > 0:
            bench.asking.receive()
            left -= bool(bench.asking.replies)
            frames = list[DataMessage]()
            for item in [*client.poll_all(0.05), None]:
                if isinstance(item, DataMessage):
                    frames.append(item)
                    continue
                if frames:
                    found += [*stream.compensate(columns(frames, ImuUnits.G_DPS))[0]]
                    frames = []
                if isinstance(item, InForce):
                    stream.configure(item)
                    stream.follow_offset()
                    if bias and not stream.own_offset.has_bias:
                        stream.own_offset.begin(bias, stream.offset)
    wrench = np.array(found)
    is_known = np.isfinite(wrench).all(axis=1)
    off = np.abs(wrench[is_known, np.newaxis] - wrench[[0, -1]]).max(axis=2).min(axis=1)
    assert 0 < np.count_nonzero(~is_known) <= most
    assert is_known[-1]
    assert off.max() < 1e-4
