"""Fixtures that last for a whole file: import them where one node serves all tests of the file."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.bridge.conftest import Listener
from tests.bridge.scripted_server import ScriptedServer


@pytest.fixture(scope="module")
def server() -> Iterator[ScriptedServer]:
    with ScriptedServer() as scripted:
        yield scripted


@pytest.fixture(scope="module")
def listener(_ros: None) -> Iterator[Listener]:
    opened = Listener()
    yield opened
    opened.close()
