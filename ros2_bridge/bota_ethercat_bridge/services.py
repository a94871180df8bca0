# SPDX-License-Identifier: Apache-2.0
"""The services: `std_srvs/Trigger`, whose message is the result; where the package `bota_ethercat_msgs` is
built, some with numbers too, as `~/typed/NAME`.

Each blocks the executor, and never the stream: until the server has answered or a time-out, or for the
`rest.duration` of a window.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

from geometry_msgs.msg import Wrench as WrenchMessage
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from bota_ethercat.control import MAX_TARE_SAMPLES, known_six
from bota_ethercat.errors import FileError
from bota_ethercat.pdo import Vector3
from bota_ethercat.program import state
from bota_ethercat_bridge.compensating.compensation import RestWindow
from bota_ethercat_bridge.compensating.control import CompensationControl
from bota_ethercat_bridge.parameters.declare import NodeParameters
from bota_ethercat_bridge.parameters.table import AUTO, ParameterError
from bota_ethercat_bridge.rclpy_internals import filling
from bota_ethercat_bridge.stream.link import (
    CONFIGURE_TIMEOUT_S,
    DESCRIBE_TIMEOUT_S,
    Link,
    RequestFailedError,
    find_sensor,
    offset_text,
)
from bota_ft_compensation.bias import TareBasis, check_at_rest, estimate_bias
from bota_ft_compensation.bounds import at_reference
from bota_ft_compensation.identification.parameter_file import write_yaml
from bota_ft_compensation.identification.payload import (
    Identified,
    accelerometer_text,
    identify,
    summary,
)
from bota_ft_compensation.identification.poses import Pose, coverage, pose_of
from bota_ft_compensation.identification.weighted import CONFIDENCE
from bota_ft_compensation.quantities import (
    NO_WRENCH,
    ZERO,
    CompensationError,
    Wrench,
    length,
    vector,
    wrench_text,
)

TYPED: dict[str, Any] = {}
with suppress(ImportError):  # the package is built in a workspace
    from bota_ethercat_msgs.srv import GetSettings, Identify, Tare

    TYPED |= {"tare": Tare, "sensor_tare": Tare, "get_settings": GetSettings, "identify/solve": Identify}

_USUAL_HZ: Final = 800.0  # where the server does not tell
_UNKNOWN: Final = (math.nan,) * 6
_TARE_S: Final = 0.5  # how long a tare of the sensor averages
_FEWEST_SAMPLES: Final = 20
# The server may take this many times as long as the samples, which it takes twice, and some time more.
_TARE_PATIENCE, _TARE_EXTRA_S = 6.0, 4.0
_PATIENCE_S: Final = 2.0  # a window may take this much longer than half as long again as it lasts
_POLL_S: Final = 0.05
_SETTLED_WITHIN_S: Final = 10.0
_AS_USUAL: Final = SimpleNamespace(target=WrenchMessage(), samples=0)  # what a Trigger asks for


class Done(NamedTuple):
    """What was done, a sentence, and the fields of a typed response; a tuple is a vector's, or a wrench's."""

    text: str
    fields: Mapping[str, object] = {}


def create_services(node: Any) -> None:
    """All services of the node `bridge`."""
    sensor = SensorServices(node.reader.link, node.live)
    bias, identifying = BiasServices(node.compensation), IdentifyServices(node, node.compensation)
    acts: dict[str, Callable[..., Done]] = {
        "sensor_tare": sensor.tare, "get_settings": sensor.get_settings,
        "apply_settings": sensor.apply_settings, "save_settings": sensor.save_settings,
        "tare": bias.tare, "clear_tare": bias.clear, "undo_tare": bias.undo,
        "identify/start": identifying.start, "identify/add_pose": identifying.add_pose,
        "identify/drop_pose": identifying.drop_pose, "identify/solve": identifying.solve,
        "identify/apply": identifying.apply,
    }  # fmt: skip
    log = node.get_logger()

    def answer(name: str, act: Callable[..., Done], request: Any, response: Any) -> Any:
        is_typed = name.startswith("typed/")
        try:
            done = act(request) if is_typed else act()
        except (CompensationError, ParameterError, RequestFailedError) as error:
            response.message = str(error)
            log.warning(f"{name} failed: {error}")
            return response
        response.success, response.message = True, done.text
        for field, value in done.fields.items() if is_typed else ():
            if isinstance(value, tuple):
                filling(getattr(response, field))(*value)
            else:
                setattr(response, field, value)
        if not name.endswith("get_settings"):
            log.info(response.message)
        return response

    for name, act in acts.items():
        node.create_service(Trigger, f"~/{name}", partial(answer, name, act))
        if name in TYPED:
            node.create_service(TYPED[name], f"~/typed/{name}", partial(answer, f"typed/{name}", act))


def _target(request: Any) -> Wrench:
    parts = request.target.force, request.target.torque
    try:
        return Wrench(*(vector((part.x, part.y, part.z), "a target") for part in parts))
    except ValueError as error:
        raise CompensationError(str(error)) from None


class SensorServices:
    """What the server does, for every client."""

    def __init__(self, link: Link, parameters: NodeParameters) -> None:
        self._link, self._parameters = link, parameters

    def tare(self, request: Any = _AS_USUAL) -> Done:
        """The sensor's own offset."""
        sensor, rate_hz = self._link.sensor, self._link.info.rate_hz or _USUAL_HZ
        samples = _bounded(request.samples or round(_TARE_S * rate_hz))
        timeout_s = _TARE_EXTRA_S + _TARE_PATIENCE * samples / rate_hz
        target = [*_target(request).values]
        reply = self._link.ask("tare", timeout_s, sensor=sensor, samples=samples, target=target)
        parts = [
            f"{key.replace('_', ' ')} {offset_text(reply.get(key))}"
            for key in ("old_offset", "new_offset", "residual")
        ]
        offset, spread, residual = (
            known_six(reply.get(key)) or _UNKNOWN for key in ("new_offset", "deviation", "residual")
        )
        fields = {"bias": tuple(-value for value in offset), "spread": spread, "residual": residual}
        return Done(f"sensor {sensor} tared: " + "; ".join(parts), fields)

    def get_settings(self, _: Any = None) -> Done:
        info = find_sensor(self._link.ask("describe", DESCRIBE_TIMEOUT_S), self._link.sensor)
        settings = [Parameter(name, value=value).to_parameter_msg() for name, value in info.settings.items()]
        fields = {"message": f"of {info}", "rate_hz": info.rate_hz, "settings": settings}
        return Done(json.dumps({**info.settings, "rate_hz": info.rate_hz}), fields)

    def apply_settings(self) -> Done:
        in_force = json.dumps(self._parameters.apply_settings())
        return Done(f"sensor {self._link.sensor} has these settings now: {in_force}")

    def save_settings(self) -> Done:
        # `configure` wants at least one setting: one as it is.
        sensor, settings = self._link.sensor, dict(list(self._link.info.settings.items())[:1])
        self._link.ask("configure", CONFIGURE_TIMEOUT_S, sensor=sensor, settings=settings, save=True)
        return Done(f"sensor {sensor} keeps its settings and offset in its flash now")


class BiasServices:
    """The node's own bias."""

    def __init__(self, control: CompensationControl) -> None:
        self._control = control

    def tare(self, request: Any = _AS_USUAL) -> Done:
        """Measure the bias; without a tool_mass the weight of whatever hangs there is part of it."""
        control, target = self._control, _target(request)
        payload = control.parameters.payload
        window = collect_window(control, needs_tool=payload.mass > 0, samples=request.samples)
        means = window.means()
        specific_force: Vector3 | None = None
        try:
            if conflict := control.conflict(needs_tool=True):
                raise CompensationError(conflict)
            check_at_rest(found := window.specific_force(), length(control.parameters.gravity))
            specific_force = found
        except CompensationError:
            if payload.mass:
                raise
        bias = estimate_bias(means, payload, specific_force or ZERO).plus(target, -1.0)
        by_imu = specific_force is not None and window.source.is_imu
        accelerometer = control.parameters.accelerometer if by_imu else None
        noise = at_reference(means.noise, control.output.stream.in_force.info.settings)
        control.set_bias(bias, "tare", TareBasis(payload, specific_force, accelerometer, noise))
        weight = f"the weight of tool_mass {payload.mass:.3g} kg is not part of it"
        if not payload.mass:
            weight = (
                "tool_mass is 0, so the weight of whatever hangs on the sensor is part of it and it holds in "
                "this orientation only"
            )
        residual = means.latest.plus(means.wrench, -1.0)
        fields = {
            "bias": bias.values,
            "spread": means.force_spread + means.torque_spread,
            "residual": residual.values,
        }
        return Done(f"bias of {means.samples} samples: {wrench_text(bias)}; {weight}", fields)

    def clear(self) -> Done:
        self._control.set_bias(NO_WRENCH, "cleared")
        return Done("the bias is zero")

    def undo(self) -> Done:
        return Done(f"back to the bias before: {wrench_text(self._control.undo_bias())}")


class IdentifyServices:
    """`~/identify/...`: the payload, from a few static poses; one identification at a time."""

    def __init__(self, node: Node, control: CompensationControl) -> None:
        self._control, self._log = control, node.get_logger()
        self._poses: list[Pose] | None = None  # those taken so far; None: no identification was started
        self._sensor = self._sensor_now()  # as of its start
        self._result: Identified | None = None  # the latest solution, of the current poses

    def start(self) -> Done:
        if self._control.parameters.gravity_source == "none":
            raise CompensationError("gravity_source is none, so a pose says nothing: set it, such as to imu")
        before = "" if self._poses is None else f", the {len(self._poses)} poses before are dropped"
        self._poses, self._result, self._sensor = [], None, self._sensor_now()
        return Done(
            f"identification started{before}; gravity is known by {self._control.source.name}; "
            f"{coverage([]).next_pose}, hold it still with nothing touching the tool, and call "
            "identify/add_pose"
        )

    def add_pose(self) -> Done:
        poses = self._started()
        window = collect_window(self._control, needs_tool=True)
        x, y, z = window.specific_force()
        gravity = None if window.source.is_imu else (-x, -y, -z)
        poses.append(pose_of(window.means(), gravity, length(self._control.parameters.gravity)))
        self._result = None
        x, y, z = (round(part, 2) + 0.0 for part in poses[-1].up)
        up = f"up is {x:.2f}, {y:.2f}, {z:.2f} in the sensor's frame"
        return Done(f"pose {len(poses)} taken ({up}); {coverage(poses).advice}")

    def drop_pose(self) -> Done:
        poses = self._started()
        if not poses:
            raise CompensationError("there is no pose to take back")
        poses.pop()
        self._result = None
        return Done(f"the pose is dropped, {len(poses)} are left; {coverage(poses).advice}")

    def solve(self, _: Any = None) -> Done:
        result = self._result = identify(self._started())
        residuals = [
            f"{position}: {length(residual.force):.2g} N {length(residual.torque):.2g} Nm"
            for position, residual in enumerate(result.residuals, 1)
        ]
        parts = [
            summary(result),
            f"Bias {wrench_text(result.bias)}, ± {wrench_text(result.bias_interval)}",
            *([accelerometer_text(result.accelerometer)] if result.accelerometer else []),
            f"Residuals by pose, {', '.join(residuals)}",
            f"One more pose would help most so: {result.coverage.next_pose}",
        ]
        text = ". ".join([*parts, f"{self._write(result, parts)}; identify/apply puts it in force"])
        fields = {
            "poses": result.coverage.poses,
            "confidence": CONFIDENCE,
            "mass": result.payload.mass,
            "mass_interval": result.mass_interval,
            "center": result.payload.center,
            "center_interval": result.payload.center_interval,
            "bias": result.bias.values,
            "bias_interval": result.bias_interval.values,
            "force_residual": result.force_fit.rms,
            "torque_residual": result.torque_fit.rms,
        }
        return Done(text, fields)

    def apply(self) -> Done:
        if self._poses is not None:
            self._started()
        if (result := self._result) is None:
            raise CompensationError("there is no result to apply: call identify/solve first")
        accelerometer = result.accelerometer.calibration if result.accelerometer else None
        settings = self._control.output.stream.in_force.info.settings
        self._control.set_payload(result.payload, result.bias, result.accuracy(settings), accelerometer)
        also = ", accelerometer.offset and accelerometer.scale" if accelerometer else ""
        return Done(
            f"in force: tool_mass {result.payload.mass:.4f} kg, its center of gravity, a likely tool_inertia "
            f"and the bias{also}; to "
            "keep the tool, start the node with the file"
        )

    def _started(self) -> list[Pose]:
        now = self._sensor_now()
        if self._poses is not None and self._sensor != now:
            self._poses = self._result = None
            is_same = now[0] == self._sensor[0]
            what = "the sensor's own offset was changed" if is_same else "another sensor is there now"
            raise CompensationError(f"{what}, so the previous poses were dropped: call identify/start again")
        if self._poses is None:
            raise CompensationError("no identification was started: call identify/start first")
        return self._poses

    def _sensor_now(self) -> tuple[object, object]:
        """What all poses must share: the sensor and its own offset."""
        info = self._control.link.info
        return info.serial, info.offset

    def _write(self, result: Identified, comment: list[str]) -> str:
        control = self._control
        path, serial = control.parameters.identify_file, control.link.info.serial
        if path == AUTO:
            name = f"sensor-{'unknown' if serial is None else serial}-payload.yaml"
            path = f"{state.folder()}/{name}"
        try:
            file = Path(path).expanduser()
            file.parent.mkdir(parents=True, exist_ok=True)
            settings = control.output.stream.in_force.info.settings
            write_yaml(file, result, "\n".join(comment), control.parameters.gravity, control.offset, settings)
        except (FileError, OSError, RuntimeError) as error:
            if isinstance(error, RuntimeError):
                error = RuntimeError(f"there is no home directory for {path}: give identify.file in full")
            self._log.warning(f"the result of the identification is not written: {error}")
            return f"Not written: {error}"
        return f"Written to {file}"


def _bounded(samples: int) -> int:
    return min(max(samples, _FEWEST_SAMPLES), MAX_TARE_SAMPLES)


def collect_window(control: CompensationControl, *, needs_tool: bool, samples: int = 0) -> RestWindow:
    """The samples of the next `rest.duration`, or so many, once the sensor's data has settled.

    CompensationError or RequestFailedError if they do not come or mean nothing.
    """
    if conflict := control.conflict(needs_tool=needs_tool):
        raise CompensationError(conflict)
    link, clock = control.link, control.link.clock
    if not link.is_connected:
        raise CompensationError(f"there are no samples: {link.absence}")
    # After a sensor has entered OP its data settles, which the server knows.
    deadline_s = clock.monotonic() + _SETTLED_WITHIN_S
    while find_sensor(link.ask("describe", DESCRIBE_TIMEOUT_S), link.sensor).settling:
        if clock.monotonic() > deadline_s:
            raise CompensationError(f"sensor {link.sensor} does not settle: see the server's log")
        clock.wait(threading.Event(), _POLL_S)
    seconds, limits = control.parameters.rest_duration, control.parameters.rest
    window = RestWindow(seconds, limits, control.source)
    if samples:
        limits = replace(limits, least_samples=_bounded(samples))
        seconds = limits.least_samples / (link.info.rate_hz or _USUAL_HZ)
        window = RestWindow(0.0, limits, control.source)
    patience_s = 1.5 * seconds + _PATIENCE_S
    deadline_s = clock.monotonic() + patience_s
    info, bad = link.info, control.reader.not_finite
    control.output.window = window
    try:
        while not clock.wait(window.done, _POLL_S):
            if link.ending:
                raise CompensationError("the node ends")
            if clock.monotonic() > deadline_s:
                raise CompensationError(
                    f"only {window.count} samples came in {patience_s:.1f} s: see /diagnostics, stream"
                )
    finally:
        control.output.window = None
    # By what the reader knows: the executor, which would count another sensor, is the one that waits here.
    if info.serial != link.info.serial:
        raise CompensationError("the sensor was replaced by another meanwhile: call again")
    if info.offset != link.info.offset:
        raise CompensationError("the sensor's own offset was changed meanwhile: call again")
    if bad := control.reader.not_finite - bad:
        raise CompensationError(
            f"the window is spoiled: {bad} of its samples were not finite; see /diagnostics, stream, and "
            "call again"
        )
    return window
