"""A start that is given up at any moment: the sensors go to INIT, the other devices are as they were."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest

from ethercat_server.acquisition.start_up import bring_up
from ethercat_server.errors import SetUpError
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.simulation.backend import MemoryBackend
from tests.simulated_links import chain, registers
from tests.simulation import Asked, more_if_long


def interrupting(at: int, then: Callable[..., None] = lambda *_: None) -> Callable[..., None]:
    """Ctrl-C at the call number `at`; the other calls do what `then` does."""
    count = 0

    def call(*arguments: float) -> None:
        nonlocal count
        count += 1
        if count == at:
            raise KeyboardInterrupt
        then(*arguments)

    return call


def states(backend: MemoryBackend) -> list[str]:
    backend.clock.sleep(0.1)
    backend.sensors.idle(backend.clock.now_ns)
    return [slave.life.al.state.name for slave in backend.sensors.slaves if slave.life is not None]


def owners(backend: MemoryBackend) -> list[int]:
    """Who may access the SII of each."""
    return [image[reg.SII_OWNER] for image in registers(backend)]


@pytest.mark.parametrize("at", more_if_long((1, 2, 9, 40), range(1, 60)))
def test_the_eeprom_is_given_back_before_the_bus_is_closed(at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between two steps of its reading, Ctrl-C in the tool is an exception."""
    backend = chain("DRIVE:PREOP,BOTA")
    before = owners(backend)
    bus = Bus(backend)
    monkeypatch.setattr(backend.clock, "sleep", interrupting(at, backend.clock.sleep))
    with pytest.raises(KeyboardInterrupt) as raised:
        bring_up(bus, Asked(), lambda: None)
    bus.close()
    assert owners(backend) == before, raised.value


def test_a_long_eeprom_can_be_given_up() -> None:
    """One of zeros has no end mark: 16 KB are read, 9 s."""
    backend = chain("BOTA,DRIVE")
    esc = backend.sensors.slaves[1].life.esc  # type: ignore[union-attr]
    esc.sii.image = bytes(0x5000)
    seen = [backend.clock.now_ns]
    bring_up(Bus(backend), Asked(), lambda: seen.append(backend.clock.now_ns))
    assert max(after - before for before, after in itertools.pairwise(seen)) < 0.15e9


@pytest.mark.parametrize("at", range(1, 8))
def test_given_up_in_the_second_attempt(at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    backend = chain("DRIVE:PREOP,BOTA,BOTA")
    bus = Bus(backend)
    check = interrupting(at)
    attempts: list[None] = []

    def fail(_: CheckInterrupt) -> None:
        attempts.append(None)
        raise SetUpError("a frame was lost")

    monkeypatch.setattr(bus, "enter_op", fail)
    with pytest.raises(KeyboardInterrupt):
        bring_up(bus, Asked(), lambda: check() if attempts else None)
    bus.close()
    assert states(backend) == ["PREOP", "INIT", "INIT"]
