"""What stands on the screen, at every size."""

from __future__ import annotations

import json
import random
import re
from dataclasses import replace

import pytest

from bota_clients.monitor.model import Client, Model, Range, State
from bota_clients.monitor.screen import KEYS, Look, bar, render, scale_for, table, trace_of
from bota_clients.monitor.words import json_line
from bota_ethercat.framing import DataMessage
from tests.clients import monitor_states as made
from tests.clients.captures import DOCS, captures

STATES = {"healthy": made.healthy, "troubled": made.troubled, "gone": made.gone}


def plain(state: State, look: Look | None = None, width: int = 80, height: int = 24) -> str:
    return "\n".join(row.plain for row in render(state, look or Look(), width, height))


@pytest.mark.parametrize("name", STATES)
@pytest.mark.parametrize("look", [Look(), Look(help=True), Look(ascii=True), Look(question="x" * 300)])
def test_every_size_is_filled_and_never_exceeded(name: str, look: Look) -> None:
    state = STATES[name]()
    heights = (1, 5, 8, 12, 15, 23, 24, 36, 44, 90)
    for number, width in enumerate((1, 10, 24, 40, 55, 56, 60, 75, 76, 80, 109, 110, 200)):
        step = 2 if look == Look() else 4
        for height in heights[number % step :: step]:
            rows = render(state, look, width, height)
            assert len(rows) == height
            assert max(row.cell_len for row in rows) <= width


@pytest.mark.parametrize(
    ("name", "width", "height", "facts"),
    [
        ("healthy", 80, 24, (
            "localhost:12001", "connected", "BFT-SENS-ECAT-M8", "serial 1234", "firmware 1.3.8", "OP",
            "Fx      -3.64", "Mz     -0.019", "-26.40", "Temperature 34.6 °C", "+9.51 m/s²", "rad/s",
            "800.0 of 800 Hz", "age 0.2", "jitter 3 µs", "2 on the bus", "repeated 0", "locked, -4.2 ppm",
            "Warnings none", "missed deadlines 3", "2: this one 800/s · 127.0.0.1:51234 3200/s, 12 withheld",
        )),
        ("troubled", 80, 24, (
            "Fz!", "Force/torque (ADC) saturated: Fz -> Reduce sensor loading",
            "worth a look  now: Overtemperature -> Power off the sensor and let it cool down",
            "oversampling", "5 on the way here", "not tared: it is not at rest", "1 worth a look",
        )),
        ("troubled", 60, 15, (
            "Fx", "Fy", "Fz!", "Mx", "My", "Mz", "Stream", "saturated: Fz", "Reduce sensor loading", " more",
        )),
        ("gone", 80, 24, (
            "SERVER GONE 1m05s", "gone at 12:00:00: no server answers (Connection refused)",
            "values 1m05s old",
        )),
    ],
)  # fmt: skip
def test_what_is_to_be_known_is_on_the_screen(
    name: str, width: int, height: int, facts: tuple[str, ...]
) -> None:
    text = plain(STATES[name](), width=width, height=height)
    assert [fact for fact in facts if fact not in text] == []


def test_before_the_first_connection() -> None:
    text = plain(State(replace(made.gone().server, since_s=None)))
    assert "connecting" in text
    assert "no sensor known yet" in text


def test_80x24_has_the_state_of_a_sensor_that_is_lost_and_of_its_neighbors() -> None:
    state = made.troubled()
    sensor = replace(state.sensors[0], al_state="LOST", old_s=1800.0, firmware="1.3.8-dirty-R")
    text = plain(replace(state, sensors=(sensor, *state.sensors[1:])))
    assert "  LOST " in text
    assert "values 30m00s old" in text
    assert "serial 123" in text
    assert "firmware" not in text, "it goes first"


def test_every_warning_can_be_reached() -> None:
    state = made.troubled()
    alert = state.sensors[0].alerts[0]
    many = tuple(alert._replace(text=f"warning {n:02}", remedy="a remedy " * 8) for n in range(30))
    state = replace(state, sensors=(replace(state.sensors[0], alerts=many), *state.sensors[1:]))
    assert re.search(r"and \d+ more: press w", plain(state))
    pages = [plain(state, Look(warnings=number)) for number in range(1, 5)]
    for page in pages:
        assert "Warnings of sensor 0" in page
        assert "w: next page" in page
    assert sorted(set(re.findall(r"warning \d\d", "".join(pages)))) == [f"warning {n:02}" for n in range(30)]
    assert pages[3] == pages[0], "round and round"
    assert "none" in plain(made.healthy(), Look(warnings=1))


def test_two_sensors_stand_one_below_the_other_where_there_is_room() -> None:
    assert "ROKS" not in plain(made.troubled())
    tall = plain(made.troubled(), height=48)
    assert tall.index("BFT-SENS-ECAT-M8") < tall.index("BFT-ROKS-ECAT-M8")
    other_first = plain(made.troubled(), Look(selected=1))
    assert "BFT-ROKS-ECAT-M8" in other_first
    assert "0 trouble" in other_first


def test_ascii_shows_the_same_in_ascii() -> None:
    text = plain(made.troubled(), Look(ascii=True))
    assert text.isascii()
    assert "34.6 degC" in text
    assert "#####" in text


def test_help_names_every_key() -> None:
    text = plain(made.healthy(), Look(help=True))
    assert "…" not in text
    for key, name, what in KEYS:
        assert f"  {key}  {name.ljust(8)}{what}" in text


def test_no_fact_is_told_by_color_alone() -> None:
    """Where color marks something bad, a word or a sign does too."""
    rows = render(made.troubled(), Look(), 80, 24)
    spans = [(row.plain[s.start : s.end].strip(), str(s.style)) for row in rows for s in row.spans]
    assert {text for text, style in spans if "#d55e00" in style} == {"Fz!", "trouble", "worth a look"}


@pytest.mark.parametrize("name", ["monitor.svg", "monitor-warnings.svg", "monitor-gone.svg"])
def test_captures_are_in_step(name: str) -> None:
    """If this fails, look at the new ones: `python -m tests.clients.captures`."""
    assert _texts((DOCS / name).read_text()) == _texts(captures()[name])


def _texts(svg: str) -> list[str]:
    """The texts and the style of each, whatever else this version of Rich draws around them."""
    styles = dict(re.findall(r"\.monitor-(r\d+) \{ ([^}]*) \}", svg))
    found = re.findall(r'<text class="monitor-(r\d+)"[^>]*>([^<]*)</text>', svg)
    assert len(found) > 50
    return [f"{text} {styles[name]}" for name, text in found]


@pytest.mark.parametrize(
    ("reach", "scale"), [(0.0, 5.0), (5.0, 5.0), (5.1, 10.0), (10.1, 20.0), (25.0, 30.0), (412.0, 500.0)]
)
def test_the_scale_is_a_round_number_that_shows_everything(reach: float, scale: float) -> None:
    assert scale_for([Range(-reach, 0.0)], 5.0) == scale


def test_whatever_a_sensor_sends_is_shown() -> None:
    noise = random.Random(1)
    model = Model(made.ADDRESS)
    model.connected(made.description(), made.OWN_PEER, made.START_S)
    for k in range(120):
        data = noise.randbytes(77)
        sequence, stamp_ns, monotonic_ns = (noise.getrandbits(64) for _ in range(3))
        odd = DataMessage(sequence, stamp_ns, monotonic_ns, 0, noise.getrandbits(3), 0xFFFF, data)
        model.take([odd], made.now(k))
        state = model.state(made.now(k))
        render(state, Look(ascii=bool(k % 2)), 80, 24)
        assert table(state)[-1].startswith(("Trouble: ", "Worth a look: ", "Good: "))
        json.loads(json_line(state, 0.0))


def test_clients_that_do_not_fit_are_counted() -> None:
    crowd = tuple(Client(f"127.0.0.1:{40000 + n}", n == 0, 800.0, 10, 0) for n in range(30))
    text = plain(replace(made.healthy(), clients=crowd))
    (row,) = (line for line in text.splitlines() if line.startswith("Clients"))
    shown = row.count("800/s")
    assert shown >= 2
    assert row.endswith(f"and {30 - shown} more")


@pytest.mark.parametrize(
    ("value", "peak", "drawn"),
    [
        (0.0, None, "─────┼─────"),
        (5.0, None, "─────┼██▌──"),
        (-5.0, None, "──▐██┼─────"),
        (10.0, None, "─────┼█████"),
        (99.0, None, "─────┼█████"),
        (float("nan"), None, "─────┼─────"),
        (2.0, Range(-6.0, 10.0), "──├──┼█───┤"),
    ],
)
def test_a_bar_grows_from_zero_stays_in_its_width_and_marks_its_peaks(
    value: float, peak: Range | None, drawn: str
) -> None:
    assert bar(value, peak, 10.0, 11).plain == drawn


@pytest.mark.parametrize(
    ("past", "width", "drawn"),
    [
        ([Range(0, 0), Range(5, 5), Range(10, 10), None], 4, "▁▄▇ "),
        ([Range(-8.1, -7.9), Range(-8.1, -7.9), Range(-26.0, -8.0), Range(-8.1, -7.9)], 4, "▇▇▁▇"),
        ([Range(1, 2), None, Range(3, 4)], 5, "  ▁ ▇"),
        ([Range(0.0, 0.001), Range(0.001, 0.002)], 2, "▄▄"),
        ([], 2, "  "),
    ],
    ids=["rising", "a touch", "nothing came", "noise is not magnified", "nothing"],
)
def test_a_trace(past: list[Range | None], width: int, drawn: str) -> None:
    assert trace_of(past, 10.0, width) == drawn
