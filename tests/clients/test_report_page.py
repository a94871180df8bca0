"""The page: whole by itself, safe whatever a device says, readable by eye and by ear, drawn by a browser."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from bota_clients.numbers import figure, seconds
from bota_clients.recording.columns import Columns, Floats
from bota_clients.report.checks import Examination
from bota_clients.report.page import PAGE, as_json, render
from bota_clients.report.plots import stretches
from bota_clients.report.series import BINS, GROUPS, Bins
from bota_ethercat.framing import DataFlag
from tests.clients.simulated import sensor, simulate, subject_of, whole
from tests.descriptions import sensor_row
from tests.simulation import more_if_long

MADE = "2026-01-01 00:01 UTC"
LARGEST = 1_500_000
VOID = {"meta", "br", "img"}


class Reader(HTMLParser):
    """Reads a page, and fails where its tags are not in order."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(page)
        self.close()
        assert not self._open
        self.identifiers = [attributes["id"] for _, attributes in self.tags if "id" in attributes]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        assert len(dict(attrs)) == len(attrs), f"{tag} has an attribute twice"
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag, self.getpos()

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] not in {"style", "script"}:
            self.words.append(data)

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def page() -> str:
    """A report on a sensor with a noisy axis, and some samples lost."""
    noisy = sensor(6, "noise force.y 0.6", "skip 0.3", seed=12)
    return render([Examination(noisy)], made=MADE, program="ethercat-report")


def test_it_is_one_file_with_nothing_outside_it(page: str) -> None:
    reader = Reader(page)
    assert page.startswith("<!DOCTYPE html>")
    assert not {"script", "link", "iframe", "object", "form"} & {tag for tag, _ in reader.tags}
    for _, attributes in reader.tags:
        for name, value in attributes.items():
            assert not name.startswith("on")
            if name in {"href", "src", "style"}:
                assert re.match(r"#|data:image/svg\+xml;base64,", str(value)), "loads from elsewhere"
    [policy] = [tag for tag in reader.of("meta") if "http-equiv" in tag]
    assert "default-src 'none'" in str(policy["content"])
    assert "@import" not in page
    assert "url(http" not in page
    assert len(page.encode()) < LARGEST


def test_it_can_be_read_without_seeing_it(page: str) -> None:
    reader = Reader(page)
    assert "`" not in "".join(reader.words), "commands are set as code"
    descriptions = [str(plot["alt"]) for plot in reader.of("img")]
    assert len(descriptions) == 5
    assert all(re.search(r"\d", words) for words in descriptions), "they say what is in the plot"
    for plot in reader.of("img"):
        drawn = base64.b64decode(str(plot["src"]).partition(",")[2]).decode()
        assert len(ElementTree.fromstring(drawn).findall("{*}path")) > 3
        assert not re.search("nan|inf", drawn)
    assert len(reader.of("th")) == len([tag for tag in reader.of("th") if tag.get("scope")])
    assert reader.of("html") == [{"lang": "en"}]
    headings = [tag for tag, _ in reader.tags if re.fullmatch("h[1-6]", tag)]
    assert headings[0] == "h1"
    assert headings.count("h1") == 1


def test_outcomes_are_words_and_not_colors_alone(page: str) -> None:
    words = " ".join(Reader(page).words)
    assert "✗ Trouble" in words
    assert "2 of 12 checks found something: noise of force and torque, lost samples." in words or (
        "2 of 12 checks found something: lost samples, noise of force and torque." in words
    )
    assert "Force y has a noise of 0.6" in words
    assert "above the limit" in words
    assert "interpolated between Bota's own test limits" in words
    assert re.search(r"It matters because: .*Do: ", words)
    for meaning in ("800 Hz; cut-off 209.5 Hz with FIR off", "internal IMU", "±250 °/s"):
        assert meaning in words
    assert "cut-off 209.5 Hz" in page


EVIL = "</title><script>alert(1)</script>\"'&$x^2$<img src=x onerror=y>"


@pytest.fixture(scope="module")
def two() -> tuple[str, str]:
    """A sensor that describes itself with markup, and one that sent nothing: the page, and the JSON."""
    row = {
        **sensor_row(), "name": EVIL, "serial": EVIL, "hardware": EVIL, "firmware": "\u202eevil\x07",
        "settings": {**sensor_row()["settings"], EVIL: 1, "sinc_length": EVIL},
    }  # fmt: skip
    first = subject_of(simulate(1), row, source=EVIL)
    examined = [
        Examination(first),
        Examination(replace(first, info=first.info._replace(sensor=1, serial=9), parts=[])),
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PAGE.globals, "GROUPS", GROUPS[:2])  # the others are drawn alike
        return render(examined, made=MADE, program="p", note=EVIL), as_json(examined)


def test_what_a_device_says_is_text_and_nothing_else(two: tuple[str, str]) -> None:
    page, as_text = two
    reader = Reader(page)
    assert not reader.of("script")
    assert all(str(each["src"]).startswith("data:image/svg+xml;base64,") for each in reader.of("img"))
    assert "<script" not in page
    assert "alert(1)" in "".join(reader.words), "shown as it is"
    assert not {"\u202e", "\x07"} & set(page)
    assert json.loads(as_text)[0]["name"].startswith("</title>")


LAST = 2**63 - 1
HOSTILE: list[Callable[[Columns], dict[str, Any]]] = [
    lambda c: {"force": c.force * 1e38, "torque": c.torque * np.nan, "temperature": c.temperature * np.inf},
    lambda c: {
        "monotonic_ns": np.where(np.arange(len(c)) == 7, LAST, c.monotonic_ns),
        "warnings": c.warnings + 0xFFFFFFFF,
        "force_torque_saturated": c.warnings + 0xFFFF,
        "flags": np.random.default_rng(1).integers(0, 256, len(c)),
    },
    lambda c: {"monotonic_ns": c.monotonic_ns[::-1].copy()},
    lambda c: {"monotonic_ns": c.monotonic_ns * 0, "stamp_ns": c.stamp_ns * 0 + LAST},
    lambda c: {"sequence": c.sequence[::-1].copy(), "flags": c.flags + DataFlag.GAP},
    lambda c: {"temperature": c.temperature * 1e30, "angular_rate": c.force * 0},
]


@pytest.mark.parametrize("spoil", more_if_long(HOSTILE[:3], HOSTILE))
def test_nonsense_is_examined_and_drawn_without_an_error(
    spoil: Callable[[Columns], dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PAGE.globals, "GROUPS", GROUPS[:2])  # the others are drawn alike
    given = subject_of(simulate(3, sinc_length=128), sensor_row(sinc_length=128))
    examination = Examination(replace(given, parts=[replace(whole(given), **spoil(whole(given)))]))
    assert examination.headline != "Good"
    assert all(check.found.endswith(".") for check in examination.checks)
    page = render([examination], made=MADE, program="p")
    Reader(page)
    assert "✓ Good" not in page


def test_two_sensors_stand_on_one_page_also_one_that_sent_nothing(two: tuple[str, str]) -> None:
    reader = Reader(two[0])
    assert [a["href"] for a in reader.of("a")] == ["#sensor-0", "#sensor-1"]
    assert {"sensor-0", "sensor-1"} <= set(reader.identifiers)
    assert "nothing was received" in " ".join(reader.words)
    assert "Not conclusive" in " ".join(reader.words)


def test_many_samples_make_no_larger_a_page() -> None:
    tile, times = whole(sensor(1)), 40
    many = {name: np.concatenate([getattr(tile, name)] * times) for name in Columns.__slots__}
    shift = np.repeat(np.arange(times) * (int(np.ptp(tile.monotonic_ns)) + 1_250_000), len(tile))
    many["monotonic_ns"], many["stamp_ns"] = many["monotonic_ns"] + shift, many["stamp_ns"] + shift
    many["sequence"] = np.arange(len(shift))
    many["force"][12345, 2] = 77.0
    examination = Examination(replace(sensor(0.1), parts=[Columns(**many)]))
    assert examination.series.count > 30_000
    long = render([examination], made=MADE, program="p")
    assert len(long) < LARGEST
    spike = f"z from {figure(float(tile.force[:, 2].min()))} to 77.0"
    assert spike in long, "the spike is in the plot"


def test_a_spike_is_never_averaged_away() -> None:
    time: Floats = np.linspace(0.0, 99.999, 100_000)
    values, flags = np.zeros(100_000), np.zeros((100_000, 1), np.int64)
    values[31_415], values[27_182] = 5.0, np.nan
    flags[[14_280, 14_290, 31_415, 31_417], 0] = 1, 2, 1, 4
    found, bin_of_it = Bins(100.0, 1, 1), int(31.415 / 100 * BINS)
    for part in np.array_split(np.arange(100_000), 7):
        found.add(time[part], values[part, np.newaxis], flags[part])
    assert np.nanmax(found.high) == 5.0
    assert found.high[0, bin_of_it] == 5.0
    assert np.nanmin(found.low) == 0.0
    assert 0 < np.nanmax(found.mean) < 0.1
    assert (found.flags[0, bin_of_it], found.flags.sum()) == (5, 8), "bits of a bin that came in two parts"


def test_stretches_join_neighbours() -> None:
    assert stretches(np.zeros(10, bool), 10.0).shape == (0, 2)
    marked = np.isin(np.arange(10), [0, 1, 5, 9])
    assert stretches(marked, 10.0).tolist() == [[0, 2], [5, 6], [9, 10]]


def test_figures_and_spans_of_time() -> None:
    figures = {
        0: "0", 1234567: "1234567", 0.000123456: "0.000123", 1e-9: "1.00e-09", -3.14159: "-3.14",
        float("nan"): "not a number", float("inf"): "infinite", 3e38: "3.00e+38",
    }  # fmt: skip
    assert list(map(figure, figures)) == list(figures.values())
    spans = {0: "0 s", 2e-6: "2.00 µs", 0.25: "250 ms", 12: "12.0 s", 1200: "20.0 min"}
    assert list(map(seconds, spans)) == list(spans.values())
