"""The live view's keys, without a terminal or a server: Textual drives it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from bota_clients.monitor.app import Monitor
from bota_clients.monitor.model import Model
from bota_ethercat.address import Address
from tests.clients import monitor_states as made
from tests.server.running import free_port, wait_until


class Stage:
    """The app with two sensors on it and a clock that the test moves."""

    def __init__(self) -> None:
        self.model = Model(made.ADDRESS)
        names = ("BFT-SENS-ECAT-M8", "BFT-ROKS-ECAT-M8")
        made.connect(self.model, made.description(names), made.OWN_PEER, made.START_S)
        self.now_s = made.fed(self.model, 2)
        # Nothing listens there.
        self.address = Address("localhost", free_port())
        self.app = Monitor(self.model, self.address, clock=lambda: self.now_s)
        self.pilot: Any = None

    def shown(self) -> str:
        self.app.draw()
        views = self.app.query("View")
        return "\n".join(
            "".join(segment.text for segment in view.render_line(y))
            for view in views
            for y in range(view.size.height)
        )

    async def press(self, *keys: str) -> str:
        await self.pilot.press(*keys)
        return self.shown()


def play(scene: Callable[[Stage], Awaitable[None]]) -> Stage:
    stage = Stage()

    async def run() -> None:
        async with stage.app.run_test(size=(80, 24)) as stage.pilot:
            await stage.pilot.pause()
            await scene(stage)

    asyncio.run(run())
    return stage


def test_tare_asks_first_and_only_y_does_it() -> None:
    async def scene(stage: Stage) -> None:
        assert "Tare sensor 0? y: yes, u: undo the last tare, c: clear it, any" in await stage.press("t")
        assert "Not tared" in await stage.press("enter")
        assert "Sensor 1  OP  BFT-ROKS" in await stage.press("n")
        assert "Sensor 0  OP  BFT-SENS" in await stage.press("n")
        assert "Tare sensor 1?" in await stage.press("n", "t")
        await stage.press("y")
        wait_until(lambda: "Sensor 1 was not tared: " in stage.shown(), "a word")
        await stage.press("t", "u")
        wait_until(lambda: "The tare of sensor 1 was not undone: " in stage.shown(), "another")
        await stage.press("t", "C")
        wait_until(lambda: "The offset of sensor 1 was not cleared: " in stage.shown(), "the last")

    play(scene)


def test_what_does_not_fit_is_scrolled_to_and_another_size_is_drawn_anew() -> None:
    async def scene(stage: Stage) -> None:
        assert "Clients" not in stage.shown()
        await stage.press("end")
        await stage.pilot.pause()
        text = stage.shown()
        assert "Clients" in text
        assert "localhost:12001" in text.splitlines()[0]
        assert "quit" in text.splitlines()[-1]
        await stage.pilot.resize_terminal(60, 15)
        await stage.pilot.pause()
        rows = stage.shown().splitlines()
        assert (len(rows), {len(row) for row in rows}) == (15, {60})

    play(scene)


def test_pause_reset_and_help() -> None:
    async def scene(stage: Stage) -> None:
        assert "PAUSED" in await stage.press("p")
        stage.model.add_frames([made.frame(6400, {"force.x": 77.0})], stage.now_s)
        assert "+77.00" not in stage.shown()
        text = await stage.press("p")
        assert "PAUSED" not in text
        assert "+77.00" in text, "it counts on"
        assert "-26.40" in text
        text = await stage.press("0")
        assert "-26.40" not in text
        assert "Peaks and past warnings are reset" in text
        assert "Press any key to return" in await stage.press("question_mark")
        text = await stage.press("t")
        assert "Press any key to return" not in text
        assert "Tare sensor" not in text, "the key is not obeyed"

    play(scene)


def test_a_recording_that_fails_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)

    async def scene(stage: Stage) -> None:
        await stage.press("r")
        wait_until(lambda: "The recording failed: no server at localhost" in stage.shown(), "the reason")
        assert "REC" not in stage.shown()

    play(scene)


@pytest.mark.parametrize("key", ["q", "ctrl+c", "ctrl+q"])
def test_keys_that_end_it(key: str) -> None:
    async def scene(stage: Stage) -> None:
        await stage.pilot.press(key)
        await stage.pilot.pause()
        assert not stage.app.is_running or stage.app._exit

    assert play(scene).app.return_code == 0
