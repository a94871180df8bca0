"""What a page of `ethercat-monitor --web` is sent, and who may see and tare: without sockets or time."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from bota_clients.monitor.cli import parse
from bota_clients.monitor.web.pages import CHANNELS, STEP_NS, Page, WebModel, state_text
from bota_clients.monitor.web.server import HEADERS, STREAM, read_page, respond
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import STANDARD_GRAVITY, ImuUnits
from tests.clients import monitor_states as made
from tests.clients.monitor_states import START_S, frame, moving
from tests.clients.web_pages import Web

NODE = shutil.which("node")
PAGE_FILES = read_page()
FX, FZ, AZ, WX = (CHANNELS.index(n) for n in ("force.x", "force.z", "acceleration.z", "angular_rate.x"))


def batch(feed: WebModel, frames: list[DataMessage]) -> dict[str, Any]:
    """The message with the points of these."""
    feed.add_frames(frames, START_S)
    [found] = feed.batches(silent=True)
    assert {len(column) for column in found["columns"]} == {len(found["times"])}
    assert len(found["columns"]) == len(found["newest"]) == len(CHANNELS)
    return found


def times(*batches: dict[str, Any]) -> list[float]:
    return [each["start"] + after for each in batches for after in each["times"]]


@pytest.fixture
def feed() -> WebModel:
    return WebModel(made.ADDRESS)


def near(value: float | list[float]) -> Any:
    """To six decimals."""
    return pytest.approx(value, abs=1e-6)


def test_no_peak_of_a_single_sample_is_lost(feed: WebModel) -> None:
    frames = [frame(k, {**moving(k), **({"force.z": -412.0} if k == 333 else {})}) for k in range(800)]
    found = batch(feed, frames)
    assert len(times(found)) < 210, "two points in ten milliseconds"
    assert times(found) == sorted(times(found))
    spikes = [t for t, z in zip(times(found), found["columns"][FZ], strict=True) if z == -412.0]
    assert len(spikes) == 1
    assert abs(spikes[0] - frames[333].monotonic_ns * 1e-9) < 2 * STEP_NS * 1e-9
    for channel, name in ((FX, "force.x"), (FZ, "force.z")):
        sent = [moving(k)[name] for k in range(800) if k != 333]
        kept = [value for value in found["columns"][channel] if value not in {None, -412.0}]
        assert [min(kept), max(kept)] == near([min(sent), max(sent)])
    assert found["newest"][FX] == near(moving(799)["force.x"])


def test_extremes_come_high_first_where_a_channel_falls(feed: WebModel) -> None:
    start = frame(0).monotonic_ns // STEP_NS * STEP_NS + STEP_NS
    values = [(7.0, 5.0), (9.0, 5.0), (-9.0, 7.0), (1.0, 6.0)]
    found = batch(
        feed,
        [frame(k, {"force.x": x, "force.z": z})._replace(monotonic_ns=start + k * 10**6)
         for k, (x, z) in enumerate(values)],
    )  # fmt: skip
    assert found["columns"][FX] == [9.0, -9.0]
    assert found["columns"][FZ] == [5.0, 7.0]


def test_only_new_samples_are_points_and_old_ones_never(feed: WebModel) -> None:
    high = {"force.x": 99.0}
    other = [frame(k, high, flags=flag) for k, flag in enumerate(DataFlag.__members__.values(), start=100)]
    new = [f for f in other if f.flags == DataFlag.GAP]
    assert batch(feed, [frame(200), *other])["newest"][FX] == near(moving(200)["force.x"]), "out of order"
    feed.connected(made.description(), made.OWN_PEER, START_S)
    assert batch(feed, [*other, *other])["columns"][FX] == [99.0] * len(new)


def test_what_is_not_a_number_is_none_and_hides_no_other(feed: WebModel) -> None:
    bad = {"force.x": math.nan, "force.z": math.inf}
    found = batch(feed, [frame(1, bad), frame(2, {"force.z": 3.0}), frame(3, bad)])
    assert set(found["columns"][FZ]) == {3.0}
    found = batch(feed, [frame(k, bad) for k in range(100, 103)])
    assert set(found["columns"][FX]) == {None}
    assert batch(feed, [frame(200, bad)])["columns"][FX] != [0.0]


@pytest.mark.parametrize(
    ("units", "g", "dps"), [(ImuUnits.G_DPS, STANDARD_GRAVITY, math.pi / 180), (ImuUnits.SI, 1, 1)]
)
def test_the_imu_is_in_si_units(units: ImuUnits, g: float, dps: float) -> None:
    feed = WebModel(made.ADDRESS, units)
    found = batch(feed, [frame(0, {"acceleration.z": 2.0, "angular_rate.x": 90.0})])
    assert [found["newest"][AZ], *found["columns"][AZ], found["newest"][WX]] == near([2 * g, 2 * g, 90 * dps])


def test_a_slow_sensor_has_a_point_for_each_sample_at_its_time(feed: WebModel) -> None:
    frames = [frame(k)._replace(monotonic_ns=10**12 + k * 20_000_000) for k in range(20)]
    found = batch(feed, frames)
    assert times(found) == pytest.approx([f.monotonic_ns * 1e-9 for f in frames], abs=1e-6)
    assert found["columns"][FX] == near([moving(k)["force.x"] for k in range(20)])


# Who gets what.


class Harness(Web):
    """A page with a model of two sensors."""

    def __init__(self) -> None:
        super().__init__("one", "two")
        self.page = self.join()

    def join(self) -> Page:
        page = self.pages.join()
        assert page is not None
        return page

    def points(self, page: Page) -> list[dict[str, Any]]:
        return list(map(json.loads, self.pages.points(page)))

    def handle(self, page: Page, **message: Any) -> dict[str, Any] | None:
        """The answer to a message of a page."""
        answer = self.pages.handle(page, json.dumps(message))
        return dict(json.loads(answer)) if answer else None

    def message(self) -> str:
        said = self.model.state(START_S).message
        return said.text if said else ""


@pytest.fixture
def web() -> Harness:
    return Harness()


def test_each_page_gets_the_points_of_the_sensor_that_it_shows(web: Harness) -> None:
    other = web.join()
    web.handle(other, sensor=1)
    web.model.add_frames([frame(k, sensor=s) for k in range(40) for s in (0, 1)], START_S + 0.05)
    web.pages.collect(START_S + 1)
    for page, position in ((web.page, 0), (other, 1)):
        assert [each["points"] for each in web.points(page)] == [position]
        assert web.points(page) == [], "once"


def test_a_page_that_comes_later_gets_the_last_minute_and_a_slow_one_begins_anew(web: Harness) -> None:
    def pass_by(first_s: int, last_s: int) -> None:
        for second in range(first_s, last_s):
            moment = 10**12 + second * 10**9
            frames = [frame(second, sensor=s)._replace(monotonic_ns=moment) for s in (0, 1)]
            web.model.add_frames(frames, START_S)
            web.pages.collect(START_S + second)

    pass_by(0, 100)
    later = web.join()
    assert times(*web.points(later)) == pytest.approx(range(1039, 1100))
    pass_by(100, 102)
    assert times(*web.points(later)) == pytest.approx(range(1100, 1102)), "it catches up"
    pass_by(102, 106)
    anew, newest = web.points(later)
    assert anew == {"anew": True}
    assert times(newest) == pytest.approx([1105])
    web.handle(later, sensor=5)
    assert web.points(later) == []
    made.connect(web.model, made.description(("one", "two")), made.OWN_PEER, START_S)
    pass_by(-500, -490)  # a restarted machine
    web.handle(later, sensor=1)
    assert times(*web.points(later)) == pytest.approx(range(500, 510))


@pytest.mark.parametrize(
    "text", ["", "[]", "{", '{"do":"shutdown"}', '{"do":5}', '{"do":[]}', b"\xff", "\ud800", "[" * 900]
)
def test_a_message_that_no_page_sends_ends_the_connection(web: Harness, text: str | bytes) -> None:
    assert web.pages.handle(web.page, text) is None
    assert web.page.end == "Not a message of this page"


# Who may.


@pytest.mark.parametrize("action", ["tare", "clear", "reset", "record"])
def test_without_the_token_which_no_one_guesses_nothing_is_done(web: Harness, action: str) -> None:
    token = web.pages.token
    assert re.fullmatch(r"[\w-]{32,}", token)
    assert Harness().pages.token != token, "each run has its own"
    for wrong in ("", "wrong", token[:-1], token + "A", None, 5, ["x"], "\ud800é"):
        reply = web.handle(web.page, token=wrong, do=action)
        assert reply is not None
        assert reply["control"] is False
        assert "token" in reply["refused"]
    reply = web.handle(web.page, do=action)
    assert reply == {
        "control": False,
        "refused": "Only a page opened by the link that ethercat-monitor printed may do this",
    }
    assert (web.tared, web.message(), web.recorder.running) == ([], "", False)


def test_with_the_token_the_sensor_is_tared_once_at_a_time(web: Harness) -> None:
    assert web.handle(web.page, token=web.pages.token) == {"control": True, "refused": None}
    refused = web.handle(web.join(), do="tare")
    assert refused is not None, "the token of one page is no other's"
    assert not refused["control"]
    web.handle(web.page, do="tare", sensor=1)
    assert web.tared == [(1, "tare")]
    assert web.message().endswith("Sensor 1 was tared")
    web.handle(web.page, do="tare")
    assert "A tare is running already" in web.message()
    web.taring_now = False
    web.handle(web.page, do="undo")
    assert web.tared[1:] == [(1, "undo")]


def test_with_the_token_peaks_are_reset(web: Harness) -> None:
    web.model.add_frames([frame(0, {"force.x": 77.0})], START_S)
    web.model.add_frames([frame(1, {"force.x": 1.0})], START_S)
    assert web.model.state(START_S).sensors[0].peaks is not None
    web.handle(web.page, token=web.pages.token, do="reset")
    assert web.model.state(START_S).sensors[0].peaks is None


def asked(path: str, *origins: str, host: str | None = "localhost:12080") -> Response | None:
    """The answer to a request of this path, Host and Origin; None: the stream may be opened."""
    headers = Headers([("Host", host)] if host is not None else [])
    for origin in origins:
        headers["Origin"] = origin
    return respond(PAGE_FILES, Request(path, headers))


def test_only_names_of_this_machine_are_answered() -> None:
    others = (
        "evil.example:12080", "localhost.evil.example", "127.0.0.1.evil.example", "localhost@evil.example",
        "192.168.1.5:12080", "0.0.0.0:12080", "", "[::1", None,
    )  # fmt: skip
    right = dict.fromkeys(("localhost:12080", "LocalHost", "127.0.0.1:1", "[::1]:12080"), 200)
    for host, status in (right | dict.fromkeys(others, 403)).items():
        found = asked("/", host=host)
        assert (host, found and found.status_code) == (host, status)


def test_the_stream_is_for_the_page_alone() -> None:
    others = (
        "http://localhost:3000", "https://localhost:12080", "http://127.0.0.1:12080", "http://evil.example",
        "http://localhost:12080.evil.example", "null", "",
    )  # fmt: skip
    for origins in ([], ["http://localhost:12080", "http://evil.example"], *([other] for other in others)):
        assert asked(STREAM, *origins) is not None, origins
    for origin in ("http://localhost:12080", "http://LOCALHOST:12080"):
        assert asked(STREAM, origin) is None
    rebound = asked(STREAM, "http://evil.example:12080", host="evil.example:12080")
    assert rebound is not None, "Host and Origin agree, and both are the attacker's"


# The page's files.


def test_the_page_is_whole_small_and_keeps_its_own_policy() -> None:
    assert sum(len(body) for body, _ in PAGE_FILES.values()) < 200_000
    html = PAGE_FILES["/"][0].decode()
    used = set(re.findall(r'(?:src|href)="([^"]+)"', html))
    modules = {
        f"/{name}"
        for path, (body, _) in PAGE_FILES.items()
        if path.endswith(".js")
        for name in re.findall(r'from "\./(\w+\.js)"', body.decode())
    }
    assert used | modules | {"/"} == set(PAGE_FILES), "each file is used, and each used file is there"
    assert not re.search(r"<style|\sstyle=|\son\w+=|<script>", html)
    assert "unsafe" not in HEADERS["Content-Security-Policy"]
    assert "//" not in re.sub(r"http://www\.w3\.org/2000/svg|ws://\$|^\s*//.*$| //.*$", "", "".join(
        body.decode() for path, (body, _) in PAGE_FILES.items() if "/uplot/" not in path
    ), flags=re.MULTILINE), "nothing from elsewhere"  # fmt: skip


def test_every_answer_has_the_headers_and_nothing_else_is_served() -> None:
    known = ("/", "/app.js", "/uplot/uPlot.iife.min.js", "/?x=1")
    for path in (*known, "/nothing", "/../server.py", "/page/app.js", "//"):
        found = asked(path)
        assert found is not None
        assert {name: found.headers[name] for name in HEADERS} == HEADERS
        assert found.headers["Content-Length"] == str(len(found.body))
        assert found.status_code == (200 if path in known else 404), path


# What it says.


def test_a_page_says_what_the_monitor_says() -> None:
    found = json.loads(state_text(made.troubled()))["state"]
    sensor, state = found["sensors"][0], made.troubled().sensors[0]
    assert [each["verdict"] for each in found["sensors"]] == ["trouble", "look"]
    assert [(a["severity"], a["text"], a["remedy"], a["present"]) for a in sensor["alerts"]] == [
        (a.level.key, a.text, a.remedy, a.ago_s is None) for a in state.alerts
    ]
    assert (sensor["saturated"], sensor["units"]) == (["Fz"], ["N", "Nm"])
    assert any("5 on the way here" in row for row in found["table"])
    assert found["message"] == {"text": "12:00:00 Sensor 0 is not tared: it is not at rest", "bad": True}
    gone = json.loads(state_text(made.gone()))["state"]
    assert gone["trouble"] == "gone: no server answers (Connection refused); reconnecting"
    assert gone["sensors"][0]["old"] == "1m05s"


@pytest.mark.skipif(NODE is None, reason="no Node here: apt install nodejs")
def test_the_page_shows_what_it_is_sent_as_text_and_tares(web: Harness, tmp_path: Path) -> None:
    evil = "<img src=x onerror=alert(1)>"
    made.connect(web.model, made.description((evil, "two")), made.OWN_PEER, START_S)
    web.model.add_frames(
        [frame(k, {**moving(k), "warnings": 16 * (k == 30)}) for k in range(400)], made.now(400)
    )
    web.pages.collect(made.now(401) + 1)
    control = web.pages.handle(web.page, json.dumps({"token": web.pages.token}))
    messages = [control, web.pages.state(made.now(401)), *web.pages.points(web.page)]
    for path, (body, _) in PAGE_FILES.items():
        if path.endswith(".js") and "/uplot/" not in path:
            (tmp_path / path[1:]).write_bytes(body)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    command = [str(NODE), str(Path(__file__).with_name("page_in_node.mjs")), str(tmp_path / "app.js")]
    ran = subprocess.run(
        command, input="\n".join(map(str, messages)), capture_output=True, text=True, check=True
    )
    shown = json.loads(ran.stdout)
    assert shown["identity"] == f"Sensor 0  OP  {evil}  serial 1234  firmware 1.3.8"
    assert "Reduce sensor loading" in shown["warnings"]
    assert f"{moving(399)['force.x']:+.2f}" in shown["traces"]
    assert "Sensor 1  OP  two" in shown["table"]
    assert (shown["trouble"], shown["message"]) == ("", "")
    assert [shown[name] for name in shown if name.startswith("plot")] == ["101"] * 4, (
        "two in ten milliseconds"
    )
    assert shown["sent"][0] == "address /", "the token does not stay in it"
    assert shown["record"] == "Record"
    assert shown["sent"][-2:] == ['{"do":"record"}', '{"do":"tare","sensor":0}']


@pytest.mark.parametrize(
    ("argv", "found"),
    [([], "None"), (["--web"], "localhost:12080"), (["--web", "8000"], "localhost:8000"),
     (["--web", "[::1]:8000"], "[::1]:8000"), (["--server", "host:5", "--web"], "localhost:12080"),
     (["--web", "0.0.0.0:8000"], "'0.0.0.0:8000': the page is for this machine only: give a port, and "
      "reach it from elsewhere over ssh -L"),
     (["--web", "70000"], "'70000': 70000 is no port"), (["--web", "--once"], "cannot be combined"),
     (["--web", "--json"], "cannot be combined")],
)  # fmt: skip
def test_the_port_is_one_of_this_machine(
    argv: list[str], found: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if " " not in found:
        assert str(parse(argv).web) == found
        return
    with pytest.raises(SystemExit) as ended:
        parse(argv)
    assert ended.value.code == 2
    assert found in capsys.readouterr().err
