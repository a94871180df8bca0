"""The bias across restarts, in simulated time: kept if asked to, by serial number; never another sensor's."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ft_compensation.quantities import Payload, Wrench
from ft_compensation.store import CompensationStore
from tests.bridge.simulated_node import OVER, QUICK, UP, ZERO6, Node, Server, Stages, six
from tests.compensation.making import BIAS, TOOL

NOTHING = Payload()


class Bench:
    """Starts nodes that keep the bias in `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.store = folder, CompensationStore(folder)
        self.server = Server()
        self.server.hold(UP, payload=NOTHING, bias=BIAS)

    @contextlib.contextmanager
    def start(self, **parameters: Any) -> Iterator[tuple[Node, Stages]]:
        given = {**QUICK, "bias_keep": True, "bias_directory": self.folder, **parameters}
        with Node(self.server, **given) as node:
            stages = Stages(node)
            node.run(0.1)
            yield node, stages

    def replace_sensor(self, serial: int) -> None:
        """Another sensor is there."""
        self.server.description["sensors"][0]["serial"] = serial
        self.server.drop()

    def kept(self, serial: int = 1) -> list[float] | None:
        stored = self.store.load(serial)
        return None if stored is None else list(stored.bias.values)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path / "kept")


def test_a_tare_survives_a_restart(bench: Bench) -> None:
    with bench.start() as (node, stages):
        assert stages.first() == pytest.approx(BIAS.values, abs=1e-5)
        assert bench.kept() is None  # nothing to keep yet: the bias is zero and nobody set it
        node.do("tare", "kept for the next start")
        assert bench.kept() == pytest.approx(BIAS.values, abs=1e-4)
    with bench.start() as (node, stages):
        assert stages.first() == pytest.approx(ZERO6, abs=1e-4)  # not one sample without it
        assert list(node.parameters("bias")[0]) == pytest.approx(BIAS.values, abs=1e-4)
        assert "has the bias that was kept at" in node.log
        node.do("clear_tare")
        assert bench.kept() == ZERO6
        assert not node.trigger("undo_tare")[1].startswith("there is no")


def test_it_does_not_survive_unasked(bench: Bench) -> None:
    with bench.start(bias_keep=False) as (node, _):
        text = node.do("tare")
        assert "kept" not in text
        assert bench.kept() is None
    with bench.start(bias_keep=False) as (node, stages):
        assert stages.first() == pytest.approx(BIAS.values, abs=1e-5)
        # Asked for while it runs, what is in force is kept from then on.
        node.do("tare")
        node.set("bias_keep", True)
        assert bench.kept() == pytest.approx(BIAS.values, abs=1e-4)


def test_a_bias_that_is_given_wins(bench: Bench) -> None:
    bench.store.save(1, Wrench.of([1.0] * 6))
    with bench.start(bias="[3.0, -1.5, 7.25, 0.2, -0.05, 0.125]") as (node, stages):
        assert stages.first() == pytest.approx(ZERO6, abs=1e-5)
        assert "is not used, because the parameter bias is given" in node.log
        assert bench.kept() == pytest.approx(BIAS.values)


def test_another_sensor_has_its_own(bench: Bench) -> None:
    bench.store.save(2, Wrench.of([3.0, -1.5, 7.0, 0.2, -0.05, 0.125]))
    with bench.start() as (node, stages):
        node.do("tare")
        bench.replace_sensor(2)
        stages.forget()
        assert stages.first() == pytest.approx([0.0, 0.0, 0.25, 0.0, 0.0, 0.0], abs=1e-3)
        assert bench.kept(1) == pytest.approx(BIAS.values, abs=1e-4)
        bench.replace_sensor(3)
        stages.forget()
        assert stages.first() == pytest.approx(BIAS.values, abs=1e-3)
        assert "another sensor is there now, serial number 3: the bias was the other's" in node.log
        assert list(node.parameters("bias")[0]) == ZERO6


def test_nothing_of_one_sensor_is_used_for_another(bench: Bench) -> None:
    with bench.start(bias_keep=False) as (node, stages):
        node.do("tare")
        bench.server.drop()  # the same sensor comes back: its bias stays
        stages.forget()
        assert stages.first() == pytest.approx(ZERO6, abs=1e-3)
        assert bench.server.connections == 2
        node.do("identify/start")
        node.do("identify/add_pose")
        bench.replace_sensor(2)
        stages.forget()
        assert stages.first() == pytest.approx(BIAS.values, abs=1e-3)
        assert node.trigger("undo_tare") == (False, "there is no change of the bias to undo")
        node.refuse("identify/add_pose", "another sensor is there now, so the previous poses were dropped")
        node.refuse("identify/add_pose", "no identification was started")


def test_a_limit_to_the_rate_leaves_out_no_sample_of_a_tare(bench: Bench) -> None:
    with bench.start(publishing_frequency=10.0, **{"rest.duration": 1.0}) as (node, stages):
        stages.forget()
        text = node.do("tare")
        assert len(stages.final) <= 12
        found = re.match(r"bias of (\d+) samples", text)
        assert found is not None
        assert int(found[1]) in range(99, 102)


def test_a_damaged_file_is_said_and_not_used(bench: Bench) -> None:
    path = bench.store.save(1, Wrench.of([1.0] * 6))
    path.write_text(path.read_text()[:-20])
    with bench.start() as (node, stages):
        assert stages.first() == pytest.approx(BIAS.values, abs=1e-5)
        node.until("is not used: it is not whole", compensation="warn")
        assert "take the bias again or remove the file" in node.log
        node.do("tare", "kept for the next start")
        node.until(compensation="ok")
        assert bench.kept() == pytest.approx(BIAS.values, abs=1e-4)


def test_a_sensor_without_a_number(bench: Bench) -> None:
    bench.server.description["sensors"][0]["serial"] = "12a"
    with bench.start() as (node, _):
        node.do("tare", "not kept: the sensor's serial number is")


def offset_changed(bench: Bench, offset: list[float] | None, *, tell: bool = False) -> None:
    """As another client's tare does it: the sensor adds that from now on; `tell`: the server says so."""
    if tell:
        bench.server.send_json({"event": "offset_changed", "sensor": 0, "offset": offset})
    changed = ZERO6 if offset is None else offset
    reads = [b + o for b, o in zip(BIAS.values, changed, strict=True)]
    bench.server.hold(UP, payload=NOTHING, bias=Wrench.of(reads))
    bench.server.description["sensors"][0]["offset"] = offset


def test_a_change_of_the_sensors_own_offset_shifts_the_bias(bench: Bench) -> None:
    offset_changed(bench, [0.0] * 6)
    new = [-1.5, 2.25, 9.75, 0.5, 0.25, -0.125]
    with bench.start() as (node, stages):
        node.do("tare")
        stages.settle(ZERO6)
        stages.forget()
        offset_changed(bench, new, tell=True)
        node.run(0.2)
        worst = max(abs(value) for message in stages.final for value in six(message))
        assert len(stages.final) == 20
        assert worst < 1e-3, "in no sample"
        shifted = [b + o for b, o in zip(BIAS.values, new, strict=True)]
        assert list(node.parameters("bias")[0]) == pytest.approx(shifted, abs=1e-4)
        assert "the sensor's own offset was changed by Fx -1.5000 Fy 2.2500" in node.log
        node.until(compensation="ok")
        assert bench.kept() == pytest.approx(shifted, abs=1e-4)
        offset_changed(bench, [1.0] * 6)  # while the node is away, too
        bench.server.drop()
        stages.settle(ZERO6)
        # What a client that does not ask the server has done is not known.
        bench.server.send_json({"event": "sensor_back", "sensor": 0, "offset": None})
        node.until("the sensor's own offset is no longer known", compensation="warn")
        bench.server.send_json({"event": "sensor_back", "sensor": 0, "offset": [1.0] * 6})
        node.until(compensation="ok")


def test_an_offset_that_was_not_known_puts_the_bias_in_doubt(bench: Bench) -> None:
    """As of a server that was too old to tell it."""
    with bench.start() as (node, _):
        node.do("tare")
        node.until(compensation="ok")
        offset_changed(bench, [0.0] * 6)
        bench.server.drop()
        node.until("was unknown when the bias was taken", compensation="warn")
        node.do("tare")
        node.until(compensation="ok")


def test_no_bias_is_kept_as_none_and_not_shifted(bench: Bench) -> None:
    offset_changed(bench, [0.0] * 6)
    with bench.start() as (node, stages):
        offset_changed(bench, [1.0] * 6, tell=True)
        stages.settle([b + 1.0 for b in BIAS.values])
        assert list(node.parameters("bias")[0]) == ZERO6
    # What ~/clear_tare leaves goes with every offset, after a restart too; ~/undo_tare goes back to none.
    offset_changed(bench, [0.0] * 6)
    with bench.start() as (node, _):
        node.do("tare")
        node.do("clear_tare")
    offset_changed(bench, [1.0] * 6)
    raw = [b + 1.0 for b in BIAS.values]
    with bench.start() as (node, stages):
        assert stages.first() == pytest.approx(raw, abs=1e-4)
        node.until(compensation="ok")
        node.do("tare")
        offset_changed(bench, [2.0] * 6, tell=True)
        stages.settle(ZERO6)
        node.do("undo_tare")
        stages.settle([b + 2.0 for b in BIAS.values])


def test_a_zero_that_was_measured_is_a_bias(bench: Bench) -> None:
    """The sensor's tare and then the node's, or a shift, may leave a bias of exactly 0."""
    offset_changed(bench, [-b for b in BIAS.values])
    with bench.start() as (node, stages):
        node.do("tare")
        assert list(node.parameters("bias")[0]) == pytest.approx(ZERO6, abs=1e-9)
        offset_changed(bench, [1.0] * 6, tell=True)
        stages.settle(ZERO6)
    offset_changed(bench, [2.0] * 6)
    with bench.start() as (_, stages):
        assert stages.first() == pytest.approx(ZERO6, abs=1e-3)


def test_a_tare_during_which_the_offset_changes_is_refused(bench: Bench) -> None:
    offset_changed(bench, [0.0] * 6)
    with bench.start() as (node, _):
        changed = {"event": "offset_changed", "sensor": 0, "offset": [1e-3] * 6}
        node.do("identify/start")
        node.at(0.1, lambda: bench.server.send_json(changed))
        assert node.trigger("tare") == (False, "the sensor's own offset was changed meanwhile: call again")
        assert (
            "the sensor's own offset was changed, so the previous poses"
            in node.trigger("identify/add_pose")[1]
        )


@pytest.mark.parametrize(
    ("then", "now", "words"),
    [
        ([0.5] * 6, [0.5] * 6, "has the bias that was kept at"),
        ([0.5] * 6, [-1.0, 2.0, 3.0, 0.1, 0.2, 0.3], "has changed by Fx -1.5000 Fy 1.5000"),
        (None, [0.5] * 6, "it is unknown whether the sensor's own offset has changed since: tare"),
        ([0.5] * 6, None, "it is unknown whether the sensor's own offset has changed since: tare"),
    ],
)
def test_a_kept_bias_is_for_the_offset_of_then(
    bench: Bench, then: list[float] | None, now: list[float] | None, words: str
) -> None:
    offset_changed(bench, then)
    with bench.start() as (node, _):
        node.do("tare")
    offset_changed(bench, now)
    with bench.start() as (node, stages):
        assert words in node.log
        if then is not None and now is not None:
            assert stages.first() == pytest.approx(ZERO6, abs=1e-3)
            node.until(compensation="ok")
        else:
            assert list(node.parameters("bias")[0]) == ZERO6
            node.until("it is unknown whether", compensation="warn")


def test_a_folder_that_cannot_be_written(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with bench.start(bias_directory=tmp_path / "file") as (node, stages):
        node.do("tare", "not kept: ")  # it is in force all the same
        stages.settle(ZERO6)
        node.until("cannot be", compensation="warn")
        node.set("bias_directory", str(tmp_path / "other"))
        node.until(compensation="ok")
        assert CompensationStore(tmp_path / "other").load(1) is not None


def test_a_kept_bias_is_for_the_tool_of_now(bench: Bench) -> None:
    """A tare without tool_mass, a shift, and a restart with one."""
    bench.server.hold(UP, bias=BIAS)
    bench.server.description["sensors"][0]["offset"] = ZERO6
    tool = {"tool_mass": TOOL.mass, "tool_center_of_gravity": [*TOOL.center]}
    with bench.start() as (node, _):
        node.run(0.5)
        node.do("tare")
        changed = [1.0] * 6
        bench.server.description["sensors"][0]["offset"] = changed
        bench.server.send_json({"event": "offset_changed", "sensor": 0, "offset": changed})
        node.run(0.1)
    shifted = Wrench.of([b + 1.0 for b in BIAS.values])
    for _ in range(2):
        with bench.start(**tool) as (node, stages):
            for up in (OVER, UP):
                stages.at(up, bias=shifted)
            node.until(compensation="ok")
        assert bench.kept() == pytest.approx(shifted.values, abs=1e-3)
    assert "if the tool was put on or exchanged since" not in node.log, "said at the first start"


def test_a_kept_bias_of_a_tool_whose_pose_is_not_known(bench: Bench) -> None:
    """As of an older file."""
    tool = Payload(1.5, (0.0, 0.0, 0.1))
    bench.store.save(1, BIAS, tool, Wrench.of(ZERO6))
    bench.server.description["sensors"][0]["offset"] = ZERO6
    with bench.start() as (node, stages):
        assert stages.first() == pytest.approx(ZERO6, abs=1e-5)
        told = "taken with a tool of 1.5 kg, and in which pose is not known: with no tool_mass it may be "
        told += "wrong by 14.7 N and 1.47 Nm in every pose: tare again"
        assert node.log.count(told) == 1
        node.until(told, compensation="warn")
        bench.server.send_json({"event": "offset_changed", "sensor": 0, "offset": [1.0] * 6})
        node.run(0.1)
        stored = bench.store.load(1)
        assert stored is not None
        assert stored.bias == BIAS.plus(Wrench.of([1.0] * 6))
        assert (stored.payload, stored.specific_force) == (tool, None), "as it was taken"


def test_the_node_ends_while_a_tare_waits(bench: Bench) -> None:
    with bench.start(**{"rest.duration": 30.0}) as (node, stages):
        arrays = node.hear("/diagnostics")
        arrays.clear()
        stages.forget()
        began_ns = bench.server.monotonic_ns()
        node.at(3.0, lambda: node.node.finish(0))
        assert node.trigger("tare") == (False, "the node ends")
        assert bench.server.monotonic_ns() - began_ns < 3.2e9  # not the 30 s
        assert len(stages.final) >= 299, "the stream does not wait for it"
        assert len(arrays) >= 2, "nor do the diagnostics"


def test_a_sensor_that_is_replaced_while_a_tare_waits(bench: Bench) -> None:
    """Nothing is looked up meanwhile: the executor, which would do it, is what waits."""
    with bench.start(**{"rest.duration": 1.0}) as (node, _):
        node.at(0.2, lambda: bench.replace_sensor(2))
        done, text = node.trigger("tare")
        assert (done, text) == (False, "the sensor was replaced by another meanwhile: call again")
        assert bench.kept(1) is None
