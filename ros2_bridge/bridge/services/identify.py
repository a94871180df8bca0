"""The services `~/identify/...`: the payload, from a few static poses."""

from __future__ import annotations

from pathlib import Path

from rclpy.node import Node

from bota_ethercat.errors import FileError
from bridge.compensating.bias_keeper import directory_of, expand
from bridge.compensating.control import CompensationControl
from bridge.parameters.compensation import AUTO
from bridge.services.bias import take_window
from bridge.services.sensor import create_triggers
from ft_compensation.identification.parameter_file import write_yaml
from ft_compensation.identification.payload import Identified, accelerometer_text, identify, summary
from ft_compensation.identification.poses import Pose, coverage, pose_of
from ft_compensation.quantities import CompensationError, length, wrench_text


class IdentifyServices:
    """One identification at a time. A pose blocks the executor for `rest.duration`, and never the stream."""

    def __init__(self, node: Node, control: CompensationControl) -> None:
        self._control, self._log = control, node.get_logger()
        self._poses: list[Pose] | None = None
        """Those taken so far; None: no identification was started."""
        self._sensor = self._sensor_now()
        """As of its start."""
        self._result: Identified | None = None
        """The latest solution, of the current poses."""
        acts = {
            "identify/start": self._start,
            "identify/add_pose": self._add_pose,
            "identify/drop_pose": self._drop_pose,
            "identify/solve": self._solve,
            "identify/apply": self._apply,
            "identify/cancel": self._cancel,
        }
        create_triggers(node, acts, CompensationError)

    def _start(self) -> str:
        if self._control.parameters.orientation.source == "none":
            raise CompensationError("gravity_source is none, so a pose says nothing: set it, such as to imu")
        before = "" if self._poses is None else f", the {len(self._poses)} poses before are dropped"
        self._poses, self._result = [], None
        self._sensor = self._sensor_now()
        return self._said(
            f"identification started{before}; gravity is known by {self._control.source.describe}; "
            f"{coverage([]).next_pose}, hold it still with nothing touching the tool, and call "
            "identify/add_pose"
        )

    def _add_pose(self) -> str:
        poses = self._started()
        window = take_window(self._control, needs_tool=True)
        means = window.means()
        x, y, z = window.specific_force()
        magnitude = length(self._control.parameters.gravity)
        poses.append(pose_of(means, None if window.source.is_imu else (-x, -y, -z), magnitude))
        self._result = None
        x, y, z = (round(part, 2) + 0.0 for part in poses[-1].up)
        return self._said(
            f"pose {len(poses)} taken (up is {x:.2f}, {y:.2f}, {z:.2f} in the sensor's frame); "
            f"{coverage(poses).advice}"
        )

    def _drop_pose(self) -> str:
        poses = self._started()
        if not poses:
            raise CompensationError("there is no pose to take back")
        poses.pop()
        self._result = None
        return self._said(f"the pose is dropped, {len(poses)} are left; {coverage(poses).advice}")

    def _solve(self) -> str:
        result = self._result = identify(self._started())
        parts = [summary(result), *details(result)]
        parts.append(f"{self._write(result, parts)}; identify/apply puts it in force")
        return self._said(". ".join(parts))

    def _apply(self) -> str:
        if self._poses is not None:
            self._started()
        result = self._result
        if result is None:
            raise CompensationError("there is no result to apply: call identify/solve first")
        accelerometer = result.accelerometer.calibration if result.accelerometer else None
        self._control.set_payload(result.payload, result.bias, accelerometer)
        not_kept = self._control.keeping
        return self._said(
            f"in force: tool_mass {result.payload.mass:.4f} kg, its center of gravity and the bias"
            + (", accelerometer.offset and accelerometer.scale" if accelerometer else "")
            + "; to keep the tool, start the node with the file"
            + (f"; the bias is not kept: {not_kept}" if not_kept else "")
        )

    def _cancel(self) -> str:
        poses = self._started()
        self._poses = self._result = None
        return self._said(f"identification cancelled, {len(poses)} poses dropped; nothing was changed")

    def _started(self) -> list[Pose]:
        if self._poses is not None and self._sensor != (now := self._sensor_now()):
            self._poses = self._result = None
            what = (
                "the sensor's own offset was changed"
                if now[0] == self._sensor[0]
                else "another sensor is there now"
            )
            raise CompensationError(f"{what}, so the previous poses were dropped: call identify/start again")
        if self._poses is None:
            raise CompensationError("no identification was started: call identify/start first")
        return self._poses

    def _sensor_now(self) -> tuple[int, object]:
        """What all poses must share: the sensor and its own offset."""
        return self._control.sensors, self._control.link.offset

    def _write(self, result: Identified, comment: list[str]) -> str:
        try:
            path = self._path()
            path.parent.mkdir(parents=True, exist_ok=True)
            write_yaml(path, result, "\n".join(comment), self._control.parameters.gravity)
        except (CompensationError, FileError, OSError) as error:
            self._log.warning(f"the result of the identification is not written: {error}")
            return f"Not written: {error}"
        return f"Written to {path}"

    def _path(self) -> Path:
        parameters, info = self._control.parameters, self._control.link.info
        if parameters.identify_file != AUTO:
            return expand(parameters.identify_file, "identify.file")
        serial = info.serial if info is not None and info.serial.isalnum() else "unknown"
        return directory_of(parameters.bias_directory) / f"sensor-{serial}-payload.yaml"

    def _said(self, text: str) -> str:
        self._log.info(text)
        return text


def details(result: Identified) -> list[str]:
    """What `summary` leaves out, a sentence each: bias, residuals by pose, condition, next pose."""
    left = [
        f"{position}: {length(residual.force):.2g} N {length(residual.torque):.2g} Nm"
        for position, residual in enumerate(result.residuals, 1)
    ]
    return [
        f"Bias {wrench_text(result.bias)}, ± {wrench_text(result.bias_interval)}",
        *([accelerometer_text(result.accelerometer)] if result.accelerometer else []),
        f"Residuals by pose, {', '.join(left)}",
        f"Condition {result.condition:.2f} (1.2 is ideal, beyond 10 is bad)",
        f"One more pose would help most so: {result.coverage.next_pose}",
    ]
