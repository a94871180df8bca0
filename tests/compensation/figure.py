"""Draws docs/compensation.svg: the residual after each stage of compensation, and what mistakes look like.

usage: python -m tests.compensation.figure

The virtual sensor runs in simulated time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
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
_COLUMNS: Final = 3
_PANEL: Final = (270, 180)
_PLOT: Final = (236, 136)  # width and height of a panel, and of the plot in it, px
_LARGEST: Final = 22.0  # N
_MARKS: Final = (-20, -10, 0, 10, 20)  # N
_COLORS: Final = {"x": "#d62728", "y": "#2ca02c", "z": "#1f77b4"}
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
    title = "A tool of 0.8 kg on the virtual sensor; gray: a push of 12 N along -z. Force in N over time in s"
    legend = "".join(f' <tspan fill="{color}">{axis}</tspan>' for axis, color in _COLORS.items())
    rows = -(-len(shown) // _COLUMNS)
    width, height = _COLUMNS * _PANEL[0] + 8, rows * _PANEL[1] + 24
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        'font-family="sans-serif" font-size="9">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        f'<text x="{width / 2:g}" y="14" font-size="11" text-anchor="middle">{title}:{legend}</text>',
    ]
    three_sigma = 3 * measured(sinc=_SINC).deviations[0]
    for number, (name, left) in enumerate(shown.items()):
        down, across = divmod(number, _COLUMNS)
        lines.append(f'<g transform="translate({across * _PANEL[0] + 26} {down * _PANEL[1] + 38})">')
        lines += _panel(name, data.times, left, three_sigma if name.endswith("(IV.5)") else None)
        lines.append("</g>")
    path.write_text("\n".join([*lines, "</svg>", ""]), encoding="utf-8")


def _panel(name: str, times: Array, left: Array, limit: float | None) -> Iterator[str]:
    """One panel, its upper left corner at the origin, with dotted lines at ± `limit` N."""
    width, height = _PLOT
    x_scale, y_scale = width / TURN_LENGTH, 0.5 * height / _LARGEST
    middle = 0.5 * height
    begin, end = (time_s * x_scale for time_s in _TOUCH)
    yield f'<text x="{width / 2:g}" y="-4" text-anchor="middle">{name}</text>'
    yield f'<path fill="#e6e6e6" d="M{begin:.1f} 0V{height}H{end:.1f}V0z"/>'
    for force in _MARKS:
        y = middle - force * y_scale
        yield f'<path stroke="#ddd" d="M0 {y:.1f}H{width}"/>'
        yield f'<text x="-3" y="{y + 3:.1f}" text-anchor="end">{force}</text>'
    for time_s in range(0, int(TURN_LENGTH) + 1, 20):
        yield f'<text x="{time_s * x_scale:.1f}" y="{height + 10}" text-anchor="middle">{time_s}</text>'
    for sign in (-1, 1) if limit is not None else ():
        y = middle - sign * (limit or 0.0) * y_scale
        yield f'<path stroke="gray" stroke-dasharray="1 2" d="M0 {y:.1f}H{width}"/>'
    for axis, color in enumerate(_COLORS.values()):
        drawn = zip(times[::_EVERY] * x_scale, middle - left[::_EVERY, axis] * y_scale, strict=True)
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in drawn)
        yield f'<polyline fill="none" stroke="{color}" stroke-width="0.7" points="{points}"/>'
    yield f'<rect width="{width}" height="{height}" fill="none" stroke="black" stroke-width="0.8"/>'


if __name__ == "__main__":
    turn = samples()
    draw(FIGURE, turn, dict(panels(turn)))
