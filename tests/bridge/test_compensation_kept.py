"""The bias across restarts: kept when asked to, by serial number; never another sensor's."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from std_srvs.srv import Trigger

from ft_compensation.quantities import Payload, Wrench
from ft_compensation.store import CompensationStore
from tests.bridge.compensating import QUICK, UP, ZERO6, Stages, hold, six, stamp_ns
from tests.bridge.conftest import Listener, NodeThread, Start, wait_until
from tests.bridge.scripted_server import ScriptedServer
from tests.bridge.streaming import Diagnostics, Stream, streaming, streaming_description
from tests.compensation.making import BIAS

pytestmark = pytest.mark.ros
OK, WARN, ERROR, STALE = range(4)
NOTHING = Payload()


@pytest.fixture
def stream(server: ScriptedServer) -> Iterator[Stream]:
    with streaming(server) as running:
        hold(running, UP, payload=NOTHING, bias=BIAS)
        yield running


class Bench:
    """Starts nodes that keep the bias in `folder`."""

    def __init__(self, server: ScriptedServer, listener: Listener, start: Start, folder: Path) -> None:
        self.server, self.listener, self._start, self.folder = server, listener, start, folder
        self.stages = Stages(listener)
        self.store = CompensationStore(folder)

    def start(self, **parameters: Any) -> NodeThread:
        self._began_ns = time.time_ns()
        node = self._start(
            self.server.port, **{**QUICK, "bias_keep": True, "bias_directory": self.folder, **parameters}
        )
        wait_until(self._fresh, "wrench_compensated")
        return node

    def stop(self, node: NodeThread) -> None:
        node.close()
        time.sleep(0.1)

    def kept(self, serial: int = 1) -> list[float] | None:
        stored = self.store.load(serial)
        return None if stored is None else list(stored.bias.values)

    def first(self) -> list[float]:
        return six(self._fresh()[0])

    def _fresh(self) -> list[Any]:
        """What the node of the last start has sent."""
        return [message for message in [*self.stages.final.queue] if stamp_ns(message) > self._began_ns]


@pytest.fixture
def bench(server: ScriptedServer, stream: Stream, listener: Listener, start: Start, tmp_path: Path) -> Bench:
    return Bench(server, listener, start, tmp_path / "kept")


def test_a_tare_survives_a_restart(bench: Bench) -> None:
    node = bench.start()
    assert bench.first() == pytest.approx(BIAS.values, abs=1e-5)
    assert bench.kept() is None  # nothing to keep yet: the bias is zero and nobody set it
    done, text = bench.listener.trigger("tare")
    assert done
    assert "kept for the next start" in text
    assert bench.kept() == pytest.approx(BIAS.values, abs=1e-4)
    bench.stop(node)
    again = bench.start()
    assert bench.first() == pytest.approx(ZERO6, abs=1e-4)  # not one sample without it
    assert list(bench.listener.parameters("bias")[0]) == pytest.approx(BIAS.values, abs=1e-4)
    again.says("has the bias that was kept at")
    assert bench.listener.trigger("clear_tare")[0]
    assert bench.kept() == ZERO6
    assert not bench.listener.trigger("undo_tare")[1].startswith("there is no")


def test_it_does_not_survive_unasked(bench: Bench) -> None:
    node = bench.start(bias_keep=False)
    done, text = bench.listener.trigger("tare")
    assert done
    assert "kept" not in text
    assert bench.kept() is None
    bench.stop(node)
    bench.start(bias_keep=False)
    assert bench.first() == pytest.approx(BIAS.values, abs=1e-5)
    # Asked for while it runs, what is in force is kept from then on.
    assert bench.listener.trigger("tare")[0]
    assert bench.listener.set_parameter("bias_keep", True) == (True, "")
    assert bench.kept() == pytest.approx(BIAS.values, abs=1e-4)


def test_a_bias_that_is_given_wins(bench: Bench) -> None:
    bench.store.save(1, Wrench.of([1.0] * 6))
    node = bench.start(bias="[3.0, -1.5, 7.25, 0.2, -0.05, 0.125]")
    assert bench.first() == pytest.approx(ZERO6, abs=1e-5)
    node.says("is not used, because the parameter bias is given")
    assert bench.kept() == pytest.approx(BIAS.values)


def test_another_sensor_has_its_own(bench: Bench, stream: Stream) -> None:
    bench.store.save(2, Wrench.of([3.0, -1.5, 7.0, 0.2, -0.05, 0.125]))
    node = bench.start()
    assert bench.listener.trigger("tare")[0]
    bench.stages.settle(ZERO6)
    bench.server.description["sensors"][0]["serial"] = 2
    bench.server.drop()
    bench.stages.settle([0.0, 0.0, 0.25, 0.0, 0.0, 0.0])
    assert bench.kept(1) == pytest.approx(BIAS.values, abs=1e-4)
    bench.server.description["sensors"][0]["serial"] = 3
    bench.server.drop()
    bench.stages.settle(list(BIAS.values))
    node.says("another sensor is there now, serial number 3: the bias was the other's")
    assert list(bench.listener.parameters("bias")[0]) == ZERO6


def test_another_sensor_does_not_get_a_tare_that_is_not_kept(bench: Bench, stream: Stream) -> None:
    bench.start(bias_keep=False)
    assert bench.listener.trigger("tare")[0]
    bench.stages.settle(ZERO6)
    bench.server.drop()  # the same sensor comes back: its bias stays
    wait_until(lambda: bench.server.connections > 1 and bench.server.subscribed.is_set(), "a connection")
    bench.stages.settle(ZERO6)
    bench.stages.forget()
    bench.server.description["sensors"][0]["serial"] = 9
    bench.server.drop()
    bench.stages.settle(list(BIAS.values))


def test_nothing_of_one_sensor_is_used_for_another(bench: Bench, stream: Stream) -> None:
    bench.start(bias_keep=False)
    listener = bench.listener
    assert listener.trigger("tare")[0]
    assert listener.set_parameter("bias", [0.0] * 6) == (True, "")
    assert listener.trigger("identify/start")[0]
    assert listener.trigger("identify/add_pose")[0]
    bench.server.description["sensors"][0]["serial"] = 2
    bench.server.drop()
    wait_until(lambda: bench.server.connections > 1 and bench.server.subscribed.is_set(), "a connection")
    bench.stages.settle(list(BIAS.values))
    assert listener.trigger("undo_tare") == (False, "there is no change of the bias to undo")
    done, text = listener.trigger("identify/add_pose")
    assert not done
    assert "another sensor is there now, so the poses before were dropped" in text
    assert "no identification was started" in listener.trigger("identify/add_pose")[1]


def test_a_limit_to_the_rate_leaves_out_no_sample_of_a_tare(bench: Bench, stream: Stream) -> None:
    bench.start(publishing_frequency=10.0, **{"rest.duration": 1.0})
    done, text = bench.listener.trigger("tare")
    assert done, text
    found = re.match(r"bias of (\d+) samples", text)
    assert found is not None
    assert int(found[1]) > 30  # of about 100, where 10 are published


def test_a_damaged_file_is_said_and_not_used(bench: Bench) -> None:
    path = bench.store.save(1, Wrench.of([1.0] * 6))
    path.write_text(path.read_text()[:-20])
    node = bench.start()
    assert bench.first() == pytest.approx(BIAS.values, abs=1e-5)
    diagnostics = Diagnostics(bench.listener)
    diagnostics.until("is not used: it is not whole", compensation=WARN)
    node.says("take the bias again or remove the file")
    done, text = bench.listener.trigger("tare")
    assert done
    assert "kept for the next start" in text
    diagnostics.until(compensation=OK)
    assert bench.kept() == pytest.approx(BIAS.values, abs=1e-4)


@pytest.mark.parametrize("serial", ["?", "12a"])
def test_a_sensor_without_a_number(bench: Bench, serial: str) -> None:
    bench.server.description = streaming_description()
    bench.server.description["sensors"][0]["serial"] = serial
    bench.start()
    done, text = bench.listener.trigger("tare")
    assert done
    assert "not kept: the sensor's serial number is" in text


def test_a_folder_that_cannot_be_written(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    bench.start(bias_directory=tmp_path / "file")
    done, text = bench.listener.trigger("tare")
    assert done  # it is in force all the same
    assert "not kept: " in text
    bench.stages.settle(ZERO6)
    diagnostics = Diagnostics(bench.listener)
    diagnostics.until("cannot be", compensation=WARN)
    assert bench.listener.set_parameter("bias_directory", str(tmp_path / "other")) == (True, "")
    diagnostics.until(compensation=OK)
    assert CompensationStore(tmp_path / "other").load(1) is not None


def test_a_kept_bias_that_was_taken_with_another_tool(bench: Bench) -> None:
    bench.store.save(1, BIAS, Payload(1.5, (0.0, 0.0, 0.1)))
    node = bench.start()
    assert bench.first() == pytest.approx(ZERO6, abs=1e-5)
    node.says("was taken with a tool of 1.5 kg, and now there is no tool_mass: tare again")


def test_the_node_ends_while_a_tare_waits(bench: Bench, stream: Stream) -> None:
    node = bench.start(**{"rest.duration": 30.0})
    bench.listener.ask(Trigger, "tare")
    diagnostics = Diagnostics(bench.listener)
    diagnostics.next()  # the stream and the diagnostics do not wait for it
    bench.stages.forget()
    assert bench.stages.final.get(timeout=20)
    time.sleep(1.0)
    began = time.monotonic()
    node.finish()
    assert node.ends() == 0
    assert time.monotonic() - began < 10  # not the 30 s
    assert "Traceback" not in node.log


@pytest.mark.parametrize(
    "wrong", [{"settings.sinc_length": 1}, {"tool_mass": -1.0}, {"gravity": "[0.0, 0.0, 0.0]"}]
)
def test_a_wrong_parameter_ends_the_node_with_a_sentence(
    server: ScriptedServer, start: Start, wrong: dict[str, Any]
) -> None:
    node = start(server.port, orientation_source="topic_imu", **wrong)
    assert node.ends() == 2
    (line,) = node.log.splitlines()
    assert line.startswith("bridge-client: ")
    assert next(iter(wrong)) in line
