"""Simulated buses; and a home of the tests, for the tool keeps its last tares in the user's."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.simulation import SINC_LENGTH, SimulatedBus, simulated_bus

TWO = ("--pdo", "77", "--serial", "10,20", "--sinc", SINC_LENGTH, "--noise", "none")


@pytest.fixture
def single() -> Iterator[SimulatedBus]:
    with simulated_bus("--noise", "none") as bus:
        yield bus


@pytest.fixture
def chain() -> Iterator[SimulatedBus]:
    """Two sensors of the same model, with 77 bytes of process data."""
    with simulated_bus("--sensors", "2", *TWO) as bus:
        yield bus


@pytest.fixture
def models() -> Iterator[SimulatedBus]:
    """Two of different models."""
    with simulated_bus("--model", "BFT-SENS-ECAT-M8,BFT-ROKS-ECAT-M8", *TWO) as bus:
        yield bus


@pytest.fixture(autouse=True)
def state(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where it keeps them instead, one for all tests: what a test needs it makes."""
    found = tmp_path_factory.getbasetemp() / "state"
    monkeypatch.setenv("XDG_STATE_HOME", str(found))
    return found
