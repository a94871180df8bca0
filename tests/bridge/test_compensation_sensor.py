"""The bias as the sensor, or its own offset, becomes another, also while a tare waits; in simulated time."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from bota_ethercat_bridge.parameters.table import Parameters
from bota_ft_compensation.quantities import NO_PAYLOAD, Wrench
from tests.bridge.simulated_node import QUICK, UP, ZERO6, Node, Server, Stages, six, values
from tests.compensation.making import BIAS


class Sensor(Server):
    """Upright and without a tool, and its bias is BIAS."""

    def __init__(self) -> None:
        super().__init__()
        self.set_offset([0.0] * 6)

    def replace(self, serial: int) -> None:
        """Another sensor is there."""
        self.description["sensors"][0]["serial"] = serial
        self.drop()

    def set_offset(self, offset: list[float] | None, *, tell: bool = False) -> None:
        """As another client's tare does it: the sensor adds that from now on; `tell`: the server says so."""
        if tell:
            self.send_json({"event": "offset_changed", "sensor": 0, "offset": offset})
        self.hold(UP, payload=NO_PAYLOAD, bias=BIAS.plus(Wrench.of(offset or ZERO6)))
        self.description["sensors"][0]["offset"] = offset


@pytest.fixture
def sensor() -> Sensor:
    return Sensor()


@pytest.fixture
def node(sensor: Sensor) -> Iterator[Node]:
    with Node(sensor, **QUICK) as started:
        started.run(0.1)
        yield started


@pytest.fixture
def stages(node: Node) -> Stages:
    return Stages(node)


def test_nothing_of_one_sensor_is_used_for_another(sensor: Sensor, node: Node, stages: Stages) -> None:
    node.do("tare")
    sensor.drop()  # the same sensor comes back: its bias stays
    stages.forget()
    assert stages.first() == pytest.approx(ZERO6, abs=1e-3)
    assert sensor.connections == 2
    node.do("identify/start")
    node.do("identify/add_pose")
    sensor.replace(2)
    stages.forget()
    assert stages.first() == pytest.approx(BIAS.values, abs=1e-3)
    assert "another sensor is there now, serial number 2: the bias was the other's" in node.log
    assert list(node.parameters("bias")[0]) == ZERO6
    assert node.trigger("undo_tare") == (False, "there is no tare to undo")
    node.refuse("identify/add_pose", "another sensor is there now, so the previous poses were dropped")
    node.refuse("identify/add_pose", "no identification was started")
    with node.busy():  # the executor is: not one sample is published with what may be the other's bias
        sensor.replace(4)
        stages.forget()
        node.run(0.3)
        assert not stages.final
    stages.settle(list(BIAS.values))
    # A bias that is given is any sensor's.
    node.set("bias", [*BIAS.values])
    sensor.replace(3)
    stages.settle(ZERO6)


def test_a_change_of_the_sensors_own_offset_shifts_the_bias(
    sensor: Sensor, node: Node, stages: Stages
) -> None:
    """Of which samples, also while the node is away: tests/bridge/test_one_stream.py."""
    new = [-1.5, 2.25, 9.75, 0.5, 0.25, -0.125]
    node.do("tare")
    sensor.set_offset(new, tell=True)
    stages.settle(ZERO6)
    shifted = [b + o for b, o in zip(BIAS.values, new, strict=True)]
    assert list(node.parameters("bias")[0]) == pytest.approx(shifted, abs=1e-4)
    assert "the sensor's own offset was changed by Fx -1.5000 Fy 2.2500" in node.log
    node.until(compensation="ok")
    # What a client that does not ask the server has done is not known.
    sensor.send_json({"event": "sensor_back", "sensor": 0, "offset": None})
    node.until(
        "wrench_compensated has stopped: the sensor's own offset is being changed, or is no longer known: "
        "if this lasts, tare",
        compensation="error",
    )


def test_setting_another_parameter_keeps_a_shift_of_the_bias(
    sensor: Sensor, node: Node, stages: Stages
) -> None:
    """The parameter `bias` follows when the executor gets to it; another one may be set before."""
    new = [-1.5, 2.25, 9.75, 0.5, 0.25, -0.125]
    node.do("tare")
    stages.settle(ZERO6)
    with node.busy():
        sensor.set_offset(new, tell=True)
        node.run(0.05)
        assert list(node.parameters("bias")[0]) == pytest.approx(BIAS.values, abs=1e-4), "not yet"
        node.set("bias_ramp_time", 0.25)
    stages.forget()
    node.run(0.5)
    shifted = [b + o for b, o in zip(BIAS.values, new, strict=True)]
    assert list(node.parameters("bias")[0]) == pytest.approx(shifted, abs=1e-4)
    assert max(abs(value) for message in stages.final for value in six(message)) < 1e-3


def test_a_shift_while_the_parameters_are_made_to_show_the_bias_is_kept(
    sensor: Sensor, node: Node, stages: Stages
) -> None:
    first, second = [1.0] * 6, [3.0] * 6
    check = node.node.live.check

    def shift_meanwhile(wanted: Parameters) -> None:
        node.node.live.check = check
        sensor.set_offset(second, tell=True)
        node.node.reader.read(0.0)

    node.do("tare")
    node.node.live.check = shift_meanwhile
    sensor.set_offset(first, tell=True)
    node.run(0.2)
    stages.settle(ZERO6)
    shifted = [b + o for b, o in zip(BIAS.values, second, strict=True)]
    assert list(node.parameters("bias")[0]) == pytest.approx(shifted, abs=1e-4)
    assert values(node.statuses()["compensation"])["bias_from"] == "tare"


def test_a_bias_of_a_file_is_of_the_offset_that_the_file_names(sensor: Sensor) -> None:
    """Identified, written, and started with again after the sensor was tared, or lost its offset."""
    new = [1.0, 2.0, -8.0, 0.1, 0.2, 0.3]
    sensor.set_offset(new)
    given = {"bias": [*BIAS.values], "sensor_offset": ZERO6}
    with Node(sensor, **QUICK, **given) as node:
        stages = Stages(node)
        assert stages.first() == pytest.approx(ZERO6, abs=1e-3)
        shown = [list(value) for value in node.parameters("bias", "sensor_offset")]
        assert shown == [pytest.approx([b + n for b, n in zip(BIAS.values, new, strict=True)]), new]
        node.until(compensation="ok")
        # A bias that is given or taken while it runs goes with the offset of now, unless another is given.
        node.do("tare")
        sensor.set_offset(ZERO6, tell=True)
        stages.settle(ZERO6)
        assert list(node.parameters("sensor_offset")[0]) == ZERO6
        node.set("bias", [1.0] * 6)
        stages.settle([b - 1.0 for b in BIAS.values])
        node.set("sensor_offset", [-1.0] * 6)
        stages.settle([b - 2.0 for b in BIAS.values])
        assert [list(value) for value in node.parameters("bias", "sensor_offset")] == [[2.0] * 6, ZERO6]


def test_with_an_offset_that_was_not_known_nothing_is_compensated(sensor: Sensor, node: Node) -> None:
    """As of a server that was too old to tell it."""
    sensor.set_offset(None, tell=True)
    node.run(0.1)
    node.do("tare")
    node.until(compensation="ok")
    sensor.set_offset([0.0] * 6)
    sensor.drop()
    node.until(
        "the sensor's own offset was unknown when the bias was taken: the bias may be wrong, tare",
        compensation="error",
    )
    node.do("tare")
    node.until(compensation="ok")


def test_no_bias_is_not_shifted(sensor: Sensor, node: Node, stages: Stages) -> None:
    """Nor is what ~/clear_tare leaves; ~/undo_tare goes back to none."""

    def check(offset: float) -> None:
        sensor.set_offset([offset] * 6, tell=True)
        stages.settle([b + offset for b in BIAS.values])
        assert list(node.parameters("bias")[0]) == ZERO6

    check(1.0)
    node.do("tare")
    node.do("clear_tare")
    check(2.0)
    node.do("tare")
    sensor.set_offset([3.0] * 6, tell=True)
    stages.settle(ZERO6)
    node.do("undo_tare")
    check(4.0)


def test_a_zero_that_was_measured_is_a_bias(sensor: Sensor, node: Node, stages: Stages) -> None:
    """The sensor's tare and then the node's, or a shift, may leave a bias of exactly 0."""
    sensor.set_offset([-b for b in BIAS.values], tell=True)
    node.run(0.1)
    node.do("tare")
    assert list(node.parameters("bias")[0]) == pytest.approx(ZERO6, abs=1e-9)
    sensor.set_offset([0.0] * 6, tell=True)
    stages.settle(ZERO6)


# While a tare waits for its samples, as the executor, which would look at the sensor, does.


def test_an_offset_that_changes_while_a_tare_waits(sensor: Sensor, node: Node) -> None:
    node.do("identify/start")
    node.at(0.1, lambda: sensor.set_offset([1e-3] * 6, tell=True))
    assert node.trigger("tare") == (False, "the sensor's own offset was changed meanwhile: call again")
    node.refuse("identify/add_pose", "the sensor's own offset was changed, so the previous poses")


def test_a_sensor_that_is_replaced_while_a_tare_waits(sensor: Sensor, node: Node) -> None:
    node.at(0.2, lambda: sensor.replace(2))
    node.set("rest.duration", 1.0)
    words = "the sensor was replaced by another meanwhile: call again"
    assert node.trigger("tare") == (False, words)


def test_the_node_ends_while_a_tare_waits(sensor: Sensor, node: Node) -> None:
    node.set("rest.duration", 30.0)
    began_ns = sensor.monotonic_ns()
    node.at(3.0, lambda: node.node.finish(0))
    assert node.trigger("tare") == (False, "the node ends")
    assert sensor.monotonic_ns() - began_ns < 3.2e9  # not the 30 s


def test_a_limit_to_the_rate_leaves_out_no_sample_of_a_tare(node: Node, stages: Stages) -> None:
    node.set("publishing_frequency", 10.0)
    node.set("rest.duration", 1.0)
    stages.forget()
    text = node.do("tare")
    assert len(stages.final) <= 12
    found = re.match(r"bias of (\d+) samples", text)
    assert found is not None
    assert int(found[1]) in range(99, 102)
