"""docs/examples: what of them can be tried here."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

from bota_ethercat.framing import DataFlag
from ethercat_server.daemon.options import parse_options
from tests.bridge.scripted_server import ScriptedServer
from tests.server.running import PATIENCE_S
from tests.systemd.test_installation import CAPABILITIES

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "docs" / "examples"


def test_containers_have_the_services_capabilities_and_commands_and_sources_that_exist() -> None:
    services = yaml.safe_load((EXAMPLES / "compose.yaml").read_text())["services"]
    server, node = services.pop("server"), services.pop("node")
    assert not services
    assert [f"CAP_{name}" for name in server["cap_add"]] == list(CAPABILITIES)
    assert "cap_add" not in node
    program, *arguments = server["command"]
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert program in scripts
    assert parse_options(arguments).port == 12001
    for service in (server, node):
        assert service["cap_drop"] == ["ALL"]
        assert service["network_mode"] == "host"
        context = EXAMPLES / service["build"]["context"]
        for source in re.findall(r"^COPY (\S+) ", service["build"]["dockerfile_inline"], re.MULTILINE):
            assert (context / source).exists()


@pytest.mark.long
def test_octave_gets_the_newest_wrench_and_nan_for_one_that_is_not_valid() -> None:
    octave = shutil.which("octave-cli")
    if octave is None or not [*Path("/usr/share/octave/packages").glob("instrument-control-*")]:
        pytest.skip("octave is missing: sudo apt install octave octave-instrument-control")
    with ScriptedServer() as server:
        script = f"""
            for number = 1:2
                [wrench, stamp] = bota_wrench("127.0.0.1", {server.port});
                printf("%g ", wrench, stamp), disp(""), fflush(stdout);
            end
        """
        with subprocess.Popen(
            [octave, "--quiet", "--eval", script], cwd=EXAMPLES, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            for flags, wrench in (
                (DataFlag(0), "1.5 1.5625 1.625 1.6875 1.75 1.8125"),
                (DataFlag.INVALID, "NaN NaN NaN NaN NaN NaN"),
            ):
                assert server.subscribed.wait(PATIENCE_S)
                newest = server.frame(1.5, flags, stamp_ns=1_500_000_000)
                server.send_raw(server.frame(0.0) + newest)
                assert process.stdout.readline().split() == [*wrench.split(), "1.5"]
        assert process.returncode == 0
        assert [request["action"] for request in server.requests] == ["subscribe"]
