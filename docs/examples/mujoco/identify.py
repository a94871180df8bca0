"""An arm turns its tool into six poses; mass and center of gravity are identified from what is measured.

ethercat-server virtual 12001 --virtual "--world /tmp/world"
python -m docs.examples.mujoco.identify
"""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from bota_ethercat.client import Reading
from bota_ft_compensation.identification.payload import Identified, identify
from bota_ft_compensation.identification.poses import Pose, pose_of
from bota_ft_compensation.stationary import NotStationaryError, StationaryWindow

if TYPE_CHECKING:  # the task does without MuJoCo
    from docs.examples.mujoco.arm import Arm

MASS: Final = 0.65  # kg, as in arm.xml
CENTER: Final = (0.01, -0.015, 0.05)  # in the sensor's frame, m
# Degrees, beside the wall: the sensor's z axis up and down, then level, with each side up.
POSES: Final = (
    (90, 20, 60, 0, -80, 0),
    (90, 20, 60, 0, 100, 0),
    *((90, 20, 100, 0, -30, roll) for roll in (0, 90, 180, -90)),
)
_MOVE_S, _SETTLE_S = 2.0, 0.5


class Identification:
    """The task, one control cycle at a time: `update` until it is `done`; then there is a `result`."""

    def __init__(self, robot: Arm) -> None:
        self.robot, self.poses = robot, list[Pose]()
        self._begun_s: float | None = None  # the move to the next pose
        self._from = robot.joints
        self._window = StationaryWindow()

    @property
    def done(self) -> bool:
        """Whether all poses are taken."""
        return len(self.poses) == len(POSES)

    def result(self) -> Identified:
        """IdentificationError where the poses do not fit one payload."""
        return identify(self.poses)

    def update(self, reading: Reading, seconds: float) -> None:
        """Move on, or take the newest sample; `seconds` are of any clock."""
        if self._begun_s is None:
            self._begun_s, self._from = seconds, self.robot.joints
        passed_s = seconds - self._begun_s
        share = min(1.0, passed_s / _MOVE_S)
        smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)  # from standstill to standstill
        to = np.radians(POSES[len(self.poses)])
        self.robot.turn_to(self._from + smooth * (to - self._from))
        if passed_s < _MOVE_S + _SETTLE_S or not reading.is_new or reading.sample is None:
            return
        if self._window.add(reading.sample, seconds):
            with contextlib.suppress(NotStationaryError):  # then it is taken again
                self.poses.append(pose_of(self._window.means()))
                self._begun_s = None
            self._window = StationaryWindow()


def main() -> None:
    """The command line."""
    from docs.examples.mujoco.arm import Arm, arguments, perform  # noqa: PLC0415 - as above

    options, arm = arguments(str(__doc__)).parse_args(), Arm()
    task = Identification(arm)
    perform(task, arm, options)
    tool = task.result().payload
    print(f"mass {tool.mass:.3f} kg, error {1e3 * (tool.mass - MASS):+.1f} g")
    x, y, z = (1e3 * part for part in tool.center)
    print(
        f"center of gravity {x:.1f}, {y:.1f}, {z:.1f} mm, error {1e3 * math.dist(tool.center, CENTER):.1f} mm"
    )


if __name__ == "__main__":
    main()
