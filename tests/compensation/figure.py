"""Draws docs/compensation.svg: what each stage of compensation leaves, and what mistakes look like.

usage: python -m tests.compensation.figure [OUT.svg]. The virtual sensor runs at simulated time.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethercat_server.virtual_sensor.measurement import scene
from ethercat_server.virtual_sensor.measurement.motion import TURN_LENGTH, Turning
from ft_compensation.compensator import Compensator
from ft_compensation.orientation import AccelerometerGravity, QuaternionGravity
from ft_compensation.quantities import Payload, Wrench
from protocol.pdo import STANDARD_GRAVITY

Array = NDArray[np.float64]

FIGURE: Final = Path(__file__).parents[2] / "docs" / "compensation.svg"
BIAS: Final = (3.0, -1.5, 7.25, 0.2, -0.05, 0.125)
"""What this sensor reads without load, N and Nm."""
_RATE: Final = 100
_SETTLES: Final = 2
"""Seconds of the turn's end, in which the source of gravity settles."""
_EVERY: Final = 30
"""So many samples apart are the points that are drawn."""
_TOUCH: Final = (20.0, 24.0)
_PUSH: Final = (0.0, 0.0, -12.0)


class Samples(NamedTuple):
    """A turn of the virtual sensor with one contact: n samples."""

    times: Array
    """(n,) s"""
    force: Array
    """(n, 3) measured, N"""
    torque: Array
    """(n, 3) measured, Nm"""
    gravity: Array
    """(n, 3) in the sensor's frame, from the accelerometer, m/s²"""
    orientation: Array
    """(n, 4) of the sensor, quaternions x, y, z, w"""


def samples(noise: bool = True) -> Samples:
    """One slow full turn."""
    signal = scene.Scene(1, noise, Turning())
    source = AccelerometerGravity()
    rows: list[tuple[float, ...]] = []
    for number in range(-_SETTLES * _RATE, int(TURN_LENGTH * _RATE)):
        time_s = number / _RATE
        reading = signal.reading(number, 0, time_s)
        ax, ay, az = (part * STANDARD_GRAVITY for part in reading.acceleration)
        rx, ry, rz = (np.radians(part) for part in reading.angular_rate)
        source.update((ax, ay, az), (float(rx), float(ry), float(rz)), time_s)
        gravity = source.gravity(time_s)
        if number < 0:
            continue
        assert gravity is not None
        push = _PUSH if _TOUCH[0] <= time_s < _TOUCH[1] else (0.0, 0.0, 0.0)
        load = [*push, *scene.cross(scene.CONTACT_POINT, push)]
        measured = [a + b + c for a, b, c in zip(reading.force_torque, BIAS, load, strict=True)]
        rows.append((time_s, *measured, *gravity, *reading.orientation))
    table = np.array(rows)
    return Samples(table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7:10], table[:, 10:14])


def compensated(
    data: Samples, *, bias: object = BIAS, mass: float = scene.TOOL_MASS, gravity: Array | None = None
) -> Array:
    """What compensation leaves, (n, 6): right, or with a mistake in what is given."""
    compensator = Compensator(Payload(mass, scene.TOOL_CENTRE), Wrench.of(bias))
    rows = zip(data.force, data.torque, data.gravity if gravity is None else gravity, strict=True)
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
    weight = Compensator(Payload(scene.TOOL_MASS, scene.TOOL_CENTRE)).compensate(
        (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, -STANDARD_GRAVITY)
    ).gravity  # fmt: skip
    both: Array = np.array(BIAS) + np.array(weight.values)
    return both


def mistakes(data: Samples) -> Iterator[tuple[str, Array]]:
    """Name, and what compensation leaves then."""
    yield "tare only, no gravity", compensated(data, bias=tare(), mass=0.0)
    yield "tare with the tool on, and gravity", compensated(data, bias=tare())
    yield "bias added instead of subtracted", compensated(data, bias=-np.array(BIAS))
    yield "mass 25 % too small", compensated(data, mass=0.75 * scene.TOOL_MASS)
    yield "rotation the wrong way round", compensated(data, gravity=turned_the_wrong_way(data))
    yield "frame turned by 90° about z", compensated(data, gravity=data.gravity[:, [1, 0, 2]] * (1, -1, 1))


def panels(data: Samples) -> Iterator[tuple[str, Array]]:
    """Title, and what is left, (n, 6)."""
    yield "as measured", np.hstack([data.force, data.torque])
    yield "bias subtracted (IV.1)", compensated(data, mass=0.0)
    yield "gravity subtracted too (IV.5)", compensated(data)
    for name, left in mistakes(data):
        yield f"mistake: {name}", left


def draw(path: Path, data: Samples, shown: Mapping[str, Array]) -> None:
    """Write the figure."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    mpl.rcParams["svg.fonttype"] = "none"
    mpl.rcParams["svg.hashsalt"] = "compensation"  # the same file every time
    figure = Figure(figsize=(12, 8))
    axes = figure.subplots(3, 3, sharex=True)
    three_sigma = 3 * scene.Scene(1, noise=True).deviations[0]
    for number, (name, left) in enumerate(shown.items()):
        panel = axes[number // 3][number % 3]
        for axis, colour in enumerate(("tab:red", "tab:green", "tab:blue")):
            panel.plot(
                data.times[::_EVERY], left[::_EVERY, axis], color=colour, linewidth=0.7, label="xyz"[axis]
            )
        panel.axvspan(*_TOUCH, color="0.9", zorder=0)
        if number == 2:
            for limit in (-three_sigma, three_sigma):
                panel.axhline(limit, color="0.5", linestyle=":", linewidth=0.8)
        panel.set_title(name, fontsize=9)
        panel.set_ylim(-22, 22)
        panel.grid(visible=True, color="0.93")
    axes[0][0].legend(loc="upper right", fontsize=7, ncols=3)
    for panel in axes[:, 0]:
        panel.set_ylabel("force, N")
    for panel in axes[2]:
        panel.set_xlabel("s of a slow full turn")
    title = "A tool of 0.8 kg on the virtual sensor; grey: something pushes with 12 N along -z"
    figure.suptitle(title, fontsize=10)
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    turn = samples()
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FIGURE, turn, dict(panels(turn)))
