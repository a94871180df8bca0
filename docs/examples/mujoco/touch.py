"""An arm touches a wall with 10 N, slides along it to a hole, and puts its peg in, by admittance control.

    ethercat-server virtual 12001 --virtual "--world /tmp/world"
    python -m docs.examples.mujoco.touch --picture touch.png

The controller knows the sensor by the TCP client only, as with a real one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bota_ethercat.client import Condition, Reading
from bota_ft_compensation.contact import Capsule, Contact, ContactDetector, Uncertainty
from bota_ft_compensation.quantities import Payload
from bota_ft_compensation.stationary import triple

if TYPE_CHECKING:  # the controller does without MuJoCo
    from docs.examples.mujoco.arm import Arm

Array = NDArray[np.float64]

FORCE: Final = 10.0  # N
GAIN: Final = 0.002  # m/s for each N
LIMIT: Final = 0.005  # m/s
SLIDE: Final = 0.015  # m/s
HOLE: Final = (0.67, 0.0, 0.5)  # its middle in the face of the wall, in the base's frame, m
DEPTH: Final = 0.015  # of the peg in it, m
PEG: Final = Capsule((0.0, 0.0, 0.05), (0.0, 0.0, 0.11), 0.01)  # in the sensor's frame, m
TIP: Final = (0.0, 0.0, 0.12)
_HZ: Final = 1000.0  # of the control cycles, of which not all have a new sample
_SLOW: Final = 0.2  # N: of what the mean unloaded force is wrong by, and motion adds, 95 %
_UNLOADED: Final = 200  # readings before anything is touched
_PRESS_S: Final = 2.0
_NEAR: Final = 0.0005  # m
_WANTED: Final = np.array((-FORCE, 0.0, 0.0))  # of the wall on the tip, in the base's frame


class Row(NamedTuple):
    """What a control cycle saw."""

    seconds: float
    force: float  # on the wall, N, as measured
    tip: Array  # (3,) m
    condition: Condition


class Touch:
    """The task, one control cycle at a time, until it is `done`. Without a fresh sample it stops."""

    def __init__(self, robot: Arm) -> None:
        self.robot, self.rows, self.done = robot, list[Row](), False
        self.contact: Contact | None = None  # the first that has a point
        self._unloaded: list[tuple[float, ...]] = []
        self._detector: ContactDetector | None = None
        self._plan = self._steps()

    def update(self, reading: Reading, seconds: float) -> None:
        """Set the robot's velocity by the newest sample; `seconds` are of any clock."""
        robot = self.robot
        if not reading.fresh or reading.sample is None:
            robot.velocity = np.zeros(3)
            self.rows.append(Row(seconds, np.nan, robot.tip, reading.condition))
            return
        if len(self._unloaded) < _UNLOADED:  # the tool's weight: it does not turn
            self._unloaded.append(reading.sample.force + reading.sample.torque)
            return
        if self._detector is None:
            noise = Uncertainty.of(np.std(self._unloaded, axis=0).tolist(), _SLOW, 0.0, Payload())
            self._detector = ContactDetector(PEG, noise, _HZ)
        load = np.array(reading.sample.force + reading.sample.torque) - np.mean(self._unloaded, axis=0)
        force = robot.rotation @ load[:3]
        if self.contact is None and self._detector.update(triple(load[:3]), triple(load[3:])):
            found = self._detector.locate(triple(load[:3]), triple(load[3:]))
            self.contact = found if found.region else None
        self.rows.append(Row(seconds, -force[0], robot.tip, reading.condition))
        # The tip gives way to what is more than wanted, unless it is to move along the wall.
        robot.velocity = np.clip(GAIN * (force - _WANTED), -LIMIT, LIMIT)
        if along := next(self._plan, None):
            robot.velocity[2] = along
        self.done = along is None
        if self.done:
            robot.velocity = np.zeros(3)

    def _steps(self) -> Iterator[float]:
        """Velocity along the wall, m/s, cycle by cycle; 0: give way."""
        robot = self.robot
        while self.rows[-1].force < FORCE / 2:
            yield 0.0
        touched = self.rows[-1].seconds
        while self.rows[-1].seconds < touched + _PRESS_S:
            yield 0.0
        while (way := HOLE[2] - robot.tip[2]) > _NEAR:
            yield min(SLIDE, 5.0 * way)
        while robot.tip[0] < HOLE[0] + DEPTH:
            yield 0.0


def draw(path: Path, rows: Sequence[Row]) -> None:
    """A picture of force and position over time."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - only for the picture

    figure = Figure(figsize=(7, 3.6), layout="constrained")
    above, below = figure.subplots(2, sharex=True)
    seconds = np.array([row.seconds for row in rows]) - rows[0].seconds
    above.plot(seconds, [row.force for row in rows], linewidth=0.6)
    above.set_ylabel("force, N")
    for axis, name in ((0, "into the wall"), (2, "along it")):
        below.plot(seconds, [1e3 * (row.tip[axis] - rows[0].tip[axis]) for row in rows], label=name)
    below.set_ylabel("tip, mm")
    below.set_xlabel("time, s")
    below.legend()
    for plot in (above, below):
        plot.grid(alpha=0.3)
    figure.savefig(path, dpi=90)


def main() -> None:
    """The command line."""
    from docs.examples.mujoco.arm import Arm, arguments, perform  # noqa: PLC0415 - as above

    parser = arguments(str(__doc__))
    parser.add_argument("--picture", type=Path, metavar="FILE", help="of force and position over time")
    options, arm = parser.parse_args(), Arm()
    if options.picture and not options.picture.parent.is_dir():
        parser.error(f"there is no folder {options.picture.parent} for the picture")
    touch = Touch(arm)
    perform(touch, arm, options)
    print(f"{np.nanmax([row.force for row in touch.rows]):.1f} N at most in {len(touch.rows)} control cycles")
    if touch.contact and touch.contact.region:
        off, within = math.dist(touch.contact.point, TIP), touch.contact.region.largest
        print(f"contact {1e3 * off:.1f} mm from the tip, 95 % region of {1e3 * within:.1f} mm")
    if options.picture:
        draw(options.picture, touch.rows)


if __name__ == "__main__":
    main()
