"""What stands on the screen, at every width."""

from __future__ import annotations

import json
import random
import re
from dataclasses import replace

import pytest

from bota_clients.monitor.model import Model, State
from bota_clients.monitor.screen import ViewOptions, render, table
from bota_clients.monitor.words import json_line
from bota_ethercat.framing import DataMessage
from tests.clients import monitor_states as made
from tests.clients.pictures import AGAIN, DOCS, captures
from tests.golden_vectors import odd_messages

STATES = {"healthy": made.healthy, "troubled": made.troubled, "gone": made.gone}


def plain(state: State, look: ViewOptions | None = None, width: int = 80) -> str:
    return "\n".join(row.plain for part in render(state, look or ViewOptions(), width) for row in part)


@pytest.mark.parametrize("name", STATES)
@pytest.mark.parametrize("look", [ViewOptions(), ViewOptions(help=True), ViewOptions(question="x" * 300)])
def test_no_row_is_wider_than_the_screen(name: str, look: ViewOptions) -> None:
    for width in (1, 10, 24, 40, 55, 56, 60, 80, 200):
        screen = render(STATES[name](), look, width)
        assert max(row.cell_len for part in screen for row in part) <= width
        assert (len(screen.head), len(screen.foot) <= 4) == (1, True)


def test_what_the_picture_of_troubles_has_no_room_for_is_on_the_screen() -> None:
    for width in (60, 80):
        text = plain(made.troubled(), width=width)
        assert "5 on the way here" in text
        assert "oversampling" in text
        assert "not tared: it is not at rest" in text


def test_before_the_first_connection() -> None:
    text = plain(State(replace(made.gone().server, since_s=None)))
    assert "connecting" in text
    assert "no sensor known yet" in text


def test_of_an_imu_that_is_off_no_delay_is_shown_and_an_unknown_one_is_not_known() -> None:
    state = made.healthy()
    info = state.sensors[0].info
    info = info._replace(settings={**info.settings, "imu_active": 0, "chop": True})
    text = plain(replace(state, sensors=(replace(state.sensors[0], info=info),)))
    assert "Delay    force, torque not known\n" in text


def test_a_lost_sensor_is_told_in_80_columns() -> None:
    state = made.troubled()
    info = state.sensors[0].info._replace(firmware="1.3.8-dirty-R")
    sensor = replace(state.sensors[0], al_state="LOST", old_s=1800.0, info=info)
    text = plain(replace(state, sensors=(sensor, *state.sensors[1:])))
    assert "values 30m00s old  Sensor 0  LOST  BFT-SENS-ECAT-M8  serial 1234" in text


def test_the_selected_sensor_comes_first() -> None:
    first, other = (plain(made.troubled(), ViewOptions(selected=number)) for number in (0, 1))
    assert first.index("BFT-SENS-ECAT-M8") < first.index("BFT-ROKS-ECAT-M8")
    assert other.index("BFT-ROKS-ECAT-M8") < other.index("BFT-SENS-ECAT-M8")
    assert "0 trouble  1 worth a look" in first.splitlines()[0]


def test_no_fact_is_told_by_color_alone() -> None:
    """Where color marks something bad, a word or a sign does too."""
    rows = [row for part in render(made.troubled(), ViewOptions(), 80) for row in part]
    spans = [(row.plain[s.start : s.end].strip(), str(s.style)) for row in rows for s in row.spans]
    assert {text for text, style in spans if "#d55e00" in style} == {"Fz!", "trouble", "worth a look"}


@pytest.mark.parametrize("name", ["monitor.svg", "monitor-warnings.svg", "monitor-gone.svg"])
def test_captures_are_in_step(name: str) -> None:
    assert _texts((DOCS / name).read_text()) == _texts(captures()[name]), AGAIN


def _texts(svg: str) -> list[str]:
    """The texts and the style of each, whatever else this version of Rich draws around them."""
    styles = dict(re.findall(r"\.monitor-(r\d+) \{ ([^}]*) \}", svg))
    found = re.findall(r'<text class="monitor-(r\d+)"[^>]*>([^<]*)</text>', svg)
    assert len(found) > 50
    return [f"{text} {styles[name]}" for name, text in found]


def test_whatever_a_server_says_and_a_sensor_sends_is_shown() -> None:
    noise = random.Random(1)
    model = Model(made.ADDRESS)
    made.connect(model, made.description(), made.OWN_PEER, made.START_S)
    for message in odd_messages():
        made.happen(model, message, made.START_S)
        model.add_status(message, made.START_S)
    for k in range(120):
        data = noise.randbytes(77)
        sequence, stamp_ns, monotonic_ns = (noise.getrandbits(64) for _ in range(3))
        odd = DataMessage(sequence, stamp_ns, monotonic_ns, 0, noise.getrandbits(3), 0xFFFF, data)
        model.add_frames([odd], made.now(k))
        state = model.state(made.now(k))
        render(state, ViewOptions(), 80)
        assert table(state)[-1].startswith(("Trouble: ", "Worth a look: ", "Good: "))
        json.loads(json_line(state, 0.0))
