"""The page of `ethercat-monitor --web` in Chromium: real time is the browser's, the samples are made.

A page loaded costs half a second of CPU, so most are in the long run.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bota_clients.monitor.web.hub import MOST_BEHIND
from tests.clients import monitor_states as made
from tests.clients.devtools import Page, browser, needs_chromium
from tests.clients.monitor_states import frame, moving
from tests.clients.web_pages import Web
from tests.server.running import wait_until

pytestmark = needs_chromium

PAPER = "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).reduce((a, b) => a + Number(b), 0)"
SPIKE = 501
COUNT = 800


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """One browser for all tests here: its start is what costs."""
    with browser(tmp_path_factory.mktemp("browser")) as page:
        yield page


@pytest.fixture
def web() -> Iterator[Web]:
    web = Web()
    with web.serving():
        yield web


@pytest.fixture
def page(chromium: Page, web: Web) -> Iterator[Page]:
    """It shows the sensor; nothing was sent yet."""
    chromium.size(1280, 900)
    chromium.open(f"{web.origin}/#token={web.hub.token}")
    wait_for_text(chromium, "#identity", "BFT-SENS-ECAT-M8")
    yield chromium
    chromium.open("about:blank")  # else the page goes on trying to reconnect, and complains in the next test


def wait_for_text(page: Page, selector: str, text: str) -> None:
    page.wait_for(f"document.querySelector('{selector}')?.innerText.includes({text!r})")


def feed(web: Web, count: int = COUNT) -> None:
    """A second with a peak of a single sample, in batches as they come."""
    for first in range(0, count, 80):
        web.feed(
            *(
                frame(k, {**moving(k), "force.z": -412.0} if k == SPIKE else None)
                for k in range(first, first + 80)
            )
        )


def shown(page: Page) -> list[float]:
    """The readings of the axes."""
    texts = page.value("[...document.querySelectorAll('output[data-axis]')].map(each => each.innerText)")
    return [float(text.replace("\u2212", "-")) for text in texts]


def trace(page: Page, name: str) -> list[list[float | None]]:
    """Times and three traces as the plot has them."""
    return list(page.value(f"document.querySelector('#{name}').plot.data.map(each => [...each])"))


def test_what_is_shown_is_what_was_sent(page: Page, web: Web) -> None:
    feed(web)
    web.now_s += 0.2  # the last 10 ms of the traces are over once nothing more comes
    page.wait_for("document.querySelector('#force').plot.data[0].at(-1) > 1000.998")
    last = moving(COUNT - 1)
    wait_for_text(page, "[data-axis=Fx]", f"{last['force.x']:+.2f}")
    values = shown(page)
    assert values[:3] == [pytest.approx(last[f"force.{axis}"], abs=0.006) for axis in "xyz"]
    assert values[3:6] == [pytest.approx(last[f"torque.{axis}"], abs=0.0006) for axis in "xyz"]
    assert values[8] == pytest.approx(0.97 * 9.80665, abs=0.006)
    times, *force = trace(page, "force")
    numbers = [value for value in times if value is not None]
    assert numbers == sorted(numbers)
    assert numbers[-1] - numbers[0] == pytest.approx(1.0, abs=0.02)
    assert force[2].count(-412.0) == 1, "the peak of a single sample"
    for axis, column in zip("xyz", force, strict=True):
        sent = [moving(k)[f"force.{axis}"] for k in range(COUNT) if k != SPIKE]
        kept = [value for value in column if value not in {None, -412.0}]
        assert min(kept) == pytest.approx(min(sent), abs=1e-4)
        assert max(kept) == pytest.approx(max(sent), abs=1e-4)
    wait_for_text(page, "#force", "\u2212412.00 \u2026")
    assert "none" in page.text("#warnings")
    assert page.complaints == []
    page.size(360, 800, dark=True)
    page.wait_for(f"{PAPER} < 100")
    fits(page, 360)


def test_silence_and_a_lost_server_are_said_and_it_comes_back(page: Page, web: Web) -> None:
    feed(web, 160)
    page.wait_for("!document.body.classList.contains('stale')")
    web.now_s += 3.0
    web.model.take_status(made.status(), web.now_s)
    wait_for_text(page, "#trouble", "No new sample for 3 s: these values are old")
    assert page.value("document.body.classList.contains('stale')")
    web.model.gone("no server answers (Connection refused)", web.now_s)
    wait_for_text(page, "#trouble", "no server answers (Connection refused); reconnecting")
    assert page.value("document.body.classList.contains('stale')")
    assert page.value("document.querySelector('#tare').disabled") is True
    assert "SERVER GONE" in page.text("#link")
    web.model.connected(made.description(), made.OWN_PEER, web.now_s)
    web.feed(*(frame(k) for k in range(800, 960)))
    page.wait_for("document.querySelector('#trouble').hidden && !document.body.classList.contains('stale')")
    times, force, *_ = trace(page, "force")
    hole = [k for k, value in enumerate(force) if value is None]
    assert len(hole) == 1, "no line over what did not come"
    assert times[hole[0] + 1] - times[hole[0] - 1] > 0.7  # type: ignore[operator]


def test_what_a_slow_page_missed_is_told_from_what_was_lost(page: Page, web: Web) -> None:
    feed(web, 160)
    page.wait_for("document.querySelector('#force').plot.data[0].length > 30")
    lagging = next(iter(web.hub._pages))
    lagging.unseen.extend([1 << 30] * MOST_BEHIND)
    web.feed(*(frame(k) for k in range(160, 400)))
    wait_until(lambda: lagging.missed, "points that are not sent")
    lagging.unseen.clear()
    web.feed(*(frame(k) for k in range(400, 560)))
    page.wait_for("document.querySelector('#force').plot.skipped?.length > 0")
    web.feed(*(frame(k) for k in range(720, 880)))
    page.wait_for("document.querySelector('#force').plot.data[1].filter(each => each === null).length == 2")
    ((start, end),) = page.value("document.querySelector('#force').plot.skipped")
    assert 0.25 < end - start < 0.35


@pytest.mark.long
def test_a_lost_monitor_is_said_and_comes_back(chromium: Page) -> None:
    web = Web()
    with web.serving():
        chromium.open(f"{web.origin}/#token={web.hub.token}")
        wait_for_text(chromium, "#identity", "BFT-SENS-ECAT-M8")
        feed(web, 160)
        chromium.wait_for("!document.querySelector('#tare').disabled")
        assert chromium.value("location.hash") == "", "the token does not stay in the address"
    wait_for_text(chromium, "#trouble", "Connection lost: ethercat-monitor does not answer")
    assert chromium.value("document.body.classList.contains('stale')")
    assert chromium.value("document.querySelector('#tare').disabled") is True
    with web.serving():
        chromium.wait_for("document.querySelector('#trouble').hidden")
        chromium.wait_for("!document.querySelector('#tare').disabled")
        web.feed(*(frame(k) for k in range(800, 960)))
        chromium.wait_for("document.querySelector('#force').plot.data[0].at(-1) > 1001")


@pytest.mark.long
def test_a_page_with_the_token_tares_after_a_question(page: Page, web: Web) -> None:
    feed(web, 80)
    page.wait_for("!document.querySelector('#tare').disabled")
    page.click("#tare")
    assert "Tare sensor 0? Its reading becomes zero." in page.text("#ask")
    page.click("#ask [value=no]")
    page.click("#tare")
    assert web.tared == []
    page.click("#ask [value=tare]")
    wait_for_text(page, "#message", "Sensor 0 was tared")
    page.click("#tare")
    page.click("#ask [value=undo]")
    page.wait_for("!document.querySelector('#ask').open")
    wait_until(lambda: web.tared == [(0, "tare"), (0, "undo")], "the undoing")


@pytest.mark.long
@pytest.mark.parametrize("token", ["", "#token=of-another-run"])
def test_a_page_without_the_token_only_shows(chromium: Page, web: Web, token: str) -> None:
    chromium.open("about:blank")
    chromium.open(web.origin + "/" + token)
    wait_for_text(chromium, "#identity", "BFT-SENS-ECAT-M8")
    feed(web, 160)
    chromium.wait_for("!document.body.classList.contains('stale')")
    assert chromium.value("document.querySelector('#tare').disabled") is True
    if token:
        wait_for_text(chromium, "#message", "not that of this run")


@pytest.mark.long
def test_warnings_have_their_remedies_and_hostile_text_is_text(page: Page, web: Web) -> None:
    evil = "<img src=x onerror=alert(1)>"
    web.model.connected(made.description((evil, "two")), made.OWN_PEER, web.now_s)
    web.feed(frame(0, {"warnings": 0b10001, "force_torque_saturated": 4}))
    wait_for_text(page, "#warnings", "Reduce sensor loading")
    assert "Force/torque (ADC) saturated: Fz" in page.text("#warnings")
    wait_for_text(page, "#identity", evil)
    assert page.value("document.images.length") == 0
    page.click("#sensors button:nth-child(2)")
    wait_for_text(page, "#identity", "Sensor 1")
    wait_for_text(page, "#settings", "cut-off 209.5 Hz with FIR off")
    assert page.complaints == []


def fits(page: Page, width: int) -> None:
    assert page.value("document.documentElement.scrollWidth") == width
    boxes = "[...document.querySelectorAll('.reading, .card, button')]"
    assert page.value(f"{boxes}.filter(e => e.scrollWidth > e.clientWidth + 1).length") == 0
    assert page.value("Math.max(...[...document.querySelectorAll('button')].map(e => e.offsetHeight))") < 50
