"""The profile for Fast DDS: it is there, it is taken, and a user's own comes first."""

from __future__ import annotations

import signal
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from bridge.middleware import PROFILES, use_own_profiles
from tests.bridge.conftest import PATIENCE_S, StartProcess
from tests.bridge.scripted_server import ScriptedServer

pytestmark = pytest.mark.ros
NAME = "FASTRTPS_DEFAULT_PROFILES_FILE"
SPACE = "{http://www.eprosima.com}"
READER_ASKS_AFTER_NS = 5_000_000


def test_it_is_named_unless_the_user_has_named_another() -> None:
    for before in ({}, {NAME: ""}):
        environment = dict(before)
        use_own_profiles(environment)
        assert environment == {NAME: str(PROFILES)}
    own = {NAME: "/etc/mine.xml"}
    use_own_profiles(own)
    assert own == {NAME: "/etc/mine.xml"}


def test_nothing_is_repeated_later_for_it() -> None:
    writers = ET.parse(PROFILES).getroot().findall(f".//{SPACE}data_writer")
    assert [writer.get("is_default_profile") for writer in writers] == ["true"]
    (nanoseconds,) = writers[0].findall(f".//{SPACE}nackSupressionDuration/{SPACE}nanosec")
    assert 0 < int(nanoseconds.text or 0) < READER_ASKS_AFTER_NS


def test_fast_dds_understands_it(
    server: ScriptedServer, start_process: StartProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In processes: the middleware reads its profiles once. And a signal ends one as it should."""
    monkeypatch.delenv(NAME, raising=False)
    node = start_process(server.port)
    node.says("connected to")
    assert "XMLPARSER" not in node.log
    node.send_signal(signal.SIGTERM)
    assert node.ends() == 0
    assert "Traceback" not in node.log
    assert server.disconnected.wait(PATIENCE_S)
    wrong = tmp_path / "wrong.xml"
    wrong.write_text(PROFILES.read_text().replace("nackSupressionDuration", "nackDuration"))
    monkeypatch.setenv(NAME, str(wrong))
    start_process(server.port).says("XMLPARSER")  # this is how it would have said so
