"""Draws docs/compensation.svg: the residual after each stage of compensation, and what mistakes look like.

usage: python -m tests.compensation.figure

The virtual sensor runs in simulated time.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bota_ethercat.pdo import STANDARD_GRAVITY
from ethercat_server.virtual_sensor import signals
from ft_compensation.compensator import Compensator
from ft_compensation.quantities import Payload, Wrench
from ft_compensation.specific_force import QuaternionGravity
from tests.virtual_sensor.motions import TURN_LENGTH, measured, turning

Array = NDArray[np.float64]

FIGURE: Final = Path(__file__).parents[2] / "docs" / "compensation.svg"
BIAS: Final = (3.0, -1.5, 7.25, 0.2, -0.05, 0.125)  # what this sensor reads without load, N and Nm
_SINC: Final = 512
_RATE: Final = 51200 // _SINC  # Hz
_EVERY: Final = 40  # one sample in this many is drawn
_LARGEST: Final = 22.0  # N
_COLORS: Final = {"x": "#d62728", "y": "#2ca02c", "z": "#1f77b4"}
_STYLE: Final = {
    "svg.fonttype": "none",
    "svg.hashsalt": "compensation",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8,
    "axes.titlesize": 8,
    "path.simplify_threshold": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "xtick.bottom": False,
    "ytick.left": False,
}
_TOUCH: Final = (20.0, 24.0)
_PUSH: Final = (0.0, 0.0, -12.0)


class Samples(NamedTuple):
    """A turn of the virtual sensor with one contact: n samples."""

    times: Array  # (n,) s
    force: Array  # (n, 3) measured, N
    torque: Array  # (n, 3) measured, Nm
    gravity: Array  # (n, 3) in the sensor's frame, from the accelerometer, m/s²
    orientation: Array  # (n, 4) of the sensor, quaternions x, y, z, w


def samples(noise: bool = True) -> Samples:
    """One slow full turn."""
    signal = measured(turning, _SINC, seed=1, noise=noise)
    rows: list[tuple[float, ...]] = []
    for number in range(int(TURN_LENGTH * _RATE)):
        time_s = number / _RATE
        reading = signal.reading(number, 0, time_s)
        ax, ay, az = (part * STANDARD_GRAVITY for part in reading.acceleration)
        push = _PUSH if _TOUCH[0] <= time_s < _TOUCH[1] else (0.0, 0.0, 0.0)
        load = [*push, *signals.cross(signals.CONTACT_POINT, push)]
        wrench = [a + b + c for a, b, c in zip(reading.force_torque, BIAS, load, strict=True)]
        rows.append((time_s, *wrench, -ax, -ay, -az, *reading.orientation))
    table = np.array(rows)
    return Samples(table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7:10], table[:, 10:14])


def compensated(
    data: Samples, *, bias: object = BIAS, mass: float = signals.TOOL_MASS, gravity: Array | None = None
) -> Array:
    """What compensation leaves, (n, 6): right, or with a mistake in what is given."""
    compensator = Compensator(Payload(mass, signals.TOOL_CENTRE), Wrench.of(bias))
    rows = zip(data.force, data.torque, -(data.gravity if gravity is None else gravity), strict=True)
    return np.array([compensator.compensate(*(row.tolist() for row in three)).final.values for three in rows])


def turned_the_wrong_way(data: Samples) -> Array:
    """Gravity by the orientation instead of its inverse, (n, 3)."""
    source = QuaternionGravity()
    found = []
    for time_s, (x, y, z, w) in zip(data.times.tolist(), data.orientation.tolist(), strict=True):
        source.update((-x, -y, -z, w), time_s)
        found.append(source.gravity(time_s))
    return np.array(found)


def tare() -> Array:
    """The bias of somebody who tares with the tool on at the first pose, (6,): the weight is in it."""
    weight = Compensator(Payload(signals.TOOL_MASS, signals.TOOL_CENTRE)).compensate(
        (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, STANDARD_GRAVITY)
    ).tool  # fmt: skip
    both: Array = np.array(BIAS) + np.array(weight.values)
    return both


def mistakes(data: Samples) -> Iterator[tuple[str, Array]]:
    """Name, and what compensation leaves then."""
    yield "tare only, no gravity", compensated(data, bias=tare(), mass=0.0)
    yield "tare with the tool on, and gravity", compensated(data, bias=tare())
    yield "bias added instead of subtracted", compensated(data, bias=-np.array(BIAS))
    yield "mass 25 % too small", compensated(data, mass=0.75 * signals.TOOL_MASS)
    yield "rotation the wrong way round", compensated(data, gravity=turned_the_wrong_way(data))
    yield "frame turned by 90° about z", compensated(data, gravity=data.gravity[:, [1, 0, 2]] * (1, -1, 1))


def panels(data: Samples) -> Iterator[tuple[str, Array]]:
    """Title, and what is left, (n, 6)."""
    yield "as measured", np.hstack([data.force, data.torque])
    yield "bias subtracted (IV.1)", compensated(data, mass=0.0)
    yield "weight and inertia subtracted too (IV.5)", compensated(data)
    for name, left in mistakes(data):
        yield f"mistake: {name}", left


def draw(path: Path, data: Samples, shown: Mapping[str, Array]) -> None:
    """Write the figure as SVG: three panels in a row, with the force along x, y and z in each."""
    three_sigma = 3 * measured(sinc=_SINC).deviations[0]
    with mpl.rc_context(_STYLE):
        drawn = Figure(figsize=(11.0, 7.5), layout="constrained")
        drawn.suptitle("A tool of 0.8 kg on the virtual sensor; gray: a push of 12 N along -z")
        panel: Any
        panels_drawn = drawn.subplots(3, 3, sharex=True, sharey=True).flat
        for panel, (name, left) in zip(panels_drawn, shown.items(), strict=True):
            panel.set_title(name)
            panel.axvspan(*_TOUCH, color="#e6e6e6")
            for axis, color in _COLORS.items():
                column = left[::_EVERY, "xyz".index(axis)]
                panel.plot(data.times[::_EVERY], column, color, linewidth=0.7, label=axis)
            if name.endswith("(IV.5)"):
                panel.hlines((-three_sigma, three_sigma), 0, TURN_LENGTH, "gray", "dotted")
        panel.set(xlim=(0, TURN_LENGTH), ylim=(-_LARGEST, _LARGEST))
        drawn.supxlabel("time, s")
        drawn.supylabel("force, N")
        drawn.legend(*panel.get_legend_handles_labels(), loc="outside upper right", ncols=3)
        buffer = io.StringIO()
        drawn.savefig(buffer, format="svg", metadata=dict.fromkeys(["Creator", "Date", "Format", "Type"]))
    # A tenth of a point is enough, and what follows a point is a line to the next.
    short = re.sub(r"-?\d+\.\d{2,}", lambda m: f"{round(float(m[0]), 1):g}", buffer.getvalue())
    path.write_text(short.replace(" \nL ", " "))


if __name__ == "__main__":
    turn = samples()
    draw(FIGURE, turn, dict(panels(turn)))
