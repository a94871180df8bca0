"""How often what is said of an error holds: of intervals, bounds, refusals and alarms, by case; seeded.

    .venv/bin/python -m tests.compensation.coverage intervals|bounds|contact [RUNS] [CASE|SINC|FIR ...]

Rigid bodies in analytic motion, through the sensor's filters (`motion`), and a real IMU: its errors are drawn
anew for every run, with the standard deviations of `imu_of`.
"""

from __future__ import annotations

import functools
import itertools
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path as File
from types import SimpleNamespace
from typing import Any, Final, NamedTuple, cast

import numpy as np

from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ethercat.replies import SensorInfo
from bota_ethercat.sensor.response import healthy_noise, imu_noise
from bota_ethercat.sensor.rest import StationaryLimits
from bota_ethercat.stream.timeline import InForce
from bota_ft_compensation.alignment import align
from bota_ft_compensation.bias import TareBasis, estimate_bias
from bota_ft_compensation.bounds import at_reference
from bota_ft_compensation.contact import ContactDetector, Plane
from bota_ft_compensation.identification.free_motion import identify_in_motion
from bota_ft_compensation.identification.inertia import turn
from bota_ft_compensation.identification.parameter_file import stream_of, write_payload, write_yaml
from bota_ft_compensation.identification.payload import Identified, TooVagueError, identify
from bota_ft_compensation.identification.poses import Pose, pose_of
from bota_ft_compensation.imu import ImuSource
from bota_ft_compensation.quantities import EXACT, NO_WRENCH, NORMAL_95, CompensationError, Payload
from bota_ft_compensation.stationary import stationary_means
from bota_ft_compensation.stream import CompensatedStream
from tests.compensation import motion
from tests.compensation.making import AXES, BIAS, written_parameters
from tests.compensation.motion import IMU, Array, Felt, Imperfection, Path, settings, tool_of

FORCE_NOISE, TORQUE_NOISE = 0.1, 0.003  # N, Nm, on each axis at SINC 64
_ROOM: Final = StationaryLimits()


class Case(NamedTuple):
    poses: int = 6
    seconds: float = 20.0  # of motion
    rate: float = 3.0  # rad/s
    spin: float = 20.0  # rad/s²
    turned_deg: float = 0.0  # the IMU
    noise: float = 1.0
    sinc_length: int = 64
    touch_n: float = 0.0
    fir: bool = False

    @property
    def settings(self) -> dict[str, Any]:
        return settings(self.sinc_length, self.fir)

    @property
    def rate_hz(self) -> float:
        return 51200 / self.sinc_length


CASES: Final = {
    "poses": Case(seconds=0.0),
    "poses and motion": Case(),
    "four poses and motion": Case(4),
    "slow": Case(rate=1.5, spin=6.0),
    "turned 1": Case(turned_deg=1.0),
    "turned 3": Case(turned_deg=3.0),
    "twice the noise": Case(noise=2.0),
    "SINC 32": Case(sinc_length=32),
    "SINC 512": Case(sinc_length=512),
    "free motion": Case(0),
    "free, slow": Case(0, rate=1.5, spin=6.0),
    "free, turned 1": Case(0, turned_deg=1.0),
    "free, turned 3": Case(0, turned_deg=3.0),
    "free, twice the noise": Case(0, noise=2.0),
    "free, SINC 32": Case(0, sinc_length=32),
    "free, SINC 512": Case(0, sinc_length=512),
    "touched": Case(touch_n=10.0),
    "free, touched": Case(0, touch_n=10.0),
}


def imu_of(seed: int, case: Case = Case()) -> Imperfection:  # noqa: B008
    """Offset 0.25 m/s², scale 0.5 %, crossed axes 0.4 %; gyroscope 1 %, 0.6 %; place 1, 1.5 and 1 mm."""
    draw = np.random.default_rng([seed, 11])
    gyroscope = draw.normal(0.0, 0.006, (3, 3))
    np.fill_diagonal(gyroscope, 1.0 + draw.normal(0.0, 0.01, 3))
    axis = draw.normal(size=3)
    x, y, z = (np.radians(case.turned_deg) * axis / np.linalg.norm(axis)).tolist()
    (a, b, c), (u, v, w), (d, e, f) = (
        draw.normal(0.0, size, 3).tolist() for size in (0.25, 0.005, (1e-3, 1.5e-3, 1e-3))
    )
    return Imperfection(
        *imu_noise(case.settings), 0.005, (a, b, c), (1.0 + u, 1.0 + v, 1.0 + w),
        tuple(draw.normal(0.0, 0.004, 6).tolist()), tuple(gyroscope.ravel().tolist()), (x, y, z), (d, e, f),
    )  # fmt: skip


def read_as(imu: Imperfection) -> tuple[Array, Array]:
    """(3,) offset, (3, 3): what the accelerometer reads of a specific force in the sensor's frame."""
    crossed = np.eye(3)
    crossed[~np.eye(3, dtype=bool)] = -np.array(imu.cross_axis)
    chip = motion.rotations(np.array(imu.turned[::-1]))
    return np.array(imu.acceleration_offset), np.diag(imu.scale) @ np.linalg.inv(crossed) @ chip.T


def true_calibration(imu: Imperfection) -> tuple[Array, Array, Array]:
    """Offset, scale, crossed axes, as an `Accelerometer` has them."""
    offset, matrix = read_as(imu)
    back = np.linalg.inv(matrix)
    scale = 1.0 / np.diag(back)
    return offset, scale, -(back * scale)[~np.eye(3, dtype=bool)]


def noise_of(case: Case) -> Array:
    ratio = np.divide(healthy_noise(case.sinc_length, fir=case.fir), healthy_noise(64))
    return np.asarray(np.repeat([FORCE_NOISE, TORQUE_NOISE], 3) * ratio * case.noise)


def with_noise(felt: Felt, case: Case, seed: int) -> Felt:
    noise = noise_of(case) * motion.noise_like(case.settings, (len(felt.times), 6), [seed, 12])
    return felt._replace(
        force=felt.force + BIAS.force + noise[:, :3], torque=felt.torque + BIAS.torque + noise[:, 3:]
    )


def felt_in(path: Path, tool: Payload, seconds: float, case: Case, imu: Imperfection, seed: int) -> Felt:
    return with_noise(motion.filtered(path, tool, seconds, case.settings, seed=seed, imu=imu), case, seed)


def held(up: Sequence[float], tool: Payload, case: Case, imu: Imperfection, seed: Any) -> Array:
    """(n, 12): a second at rest."""
    draw, count = np.random.default_rng([13, *np.atleast_1d(seed)]), round(case.rate_hz)
    direction = np.array(up) / np.linalg.norm(up) + draw.normal(0.0, 0.05, 3)
    felt = STANDARD_GRAVITY * direction / np.linalg.norm(direction)
    (offset, matrix), force = read_as(imu), -tool.mass * felt
    mean = [*force + BIAS.force, *np.cross(tool.center, force) + BIAS.torque, *matrix @ felt + offset]
    of_imu = draw.normal(0.0, [imu.acceleration_noise] * 3 + [imu.rate_noise] * 3, (count, 6))
    noise = noise_of(case) * motion.noise_like(case.settings, (count, 6), draw)
    return np.array([*mean, *[imu.rate_offset] * 3]) + np.hstack([noise, of_imu])


def poses_of(tool: Payload, case: Case, imu: Imperfection, seed: int) -> list[Pose]:
    ups = AXES if case.poses == 6 else [*AXES[:2], *AXES[2:6:2]]
    rows = [held(up, tool, case, imu, [seed, n]) for n, up in enumerate(ups[: case.poses])]
    if case.touch_n and rows:
        rows[3][:, :6] += [case.touch_n, 0.0, 0.0, 0.0, 0.1 * case.touch_n, 0.0]
    return [pose_of(stationary_means(each, _ROOM)) for each in rows]


def identified(case: Case, tool: Payload, imu: Imperfection, seed: int) -> Identified:
    """As `ethercat-identify` does it; CompensationError."""
    poses, found = poses_of(tool, case, imu, seed), None
    if poses:
        try:
            found = identify(poses)
        except TooVagueError as vague:
            if not case.seconds:
                raise
            found = vague.result
    if not case.seconds:
        assert found is not None
        return found
    felt = felt_in(motion.turned(seed, rate=case.rate, spin=case.spin), tool, case.seconds, case, imu, seed)
    if case.touch_n and not poses:
        touched = (felt.times[:, None] % 5.0 < 0.5) * np.array([case.touch_n, 0.0, 0.0])
        at = np.cross([0.0, 0.0, 0.1], touched)
        felt = felt._replace(force=felt.force + touched, torque=felt.torque + at)
    return in_motion(felt, case, found)


def in_motion(felt: Felt, case: Case, poses: Identified | None) -> Identified:
    alignment, rows = align(case.settings, case.rate_hz), np.hstack(felt[1:])
    return identify_in_motion(turn(felt.times, rows, alignment, EXACT, IMU), IMU, poses)


def intervals(case: Case, runs: int, first: int = 0) -> tuple[dict[str, Array], list[str], list[str]]:
    """Of each quantity the errors as shares of the intervals; refusals; notes."""
    shares: dict[str, list[Array]] = {}
    refused, noted = [], []
    for seed in range(first, first + runs):
        tool, imu = tool_of(seed, mass=0.5 + 0.1 * (seed % 20)), imu_of(seed, case)
        try:
            found = identified(case, tool, imu, seed)
        except CompensationError as error:
            refused.append(f"{seed}: {error}")
            continue
        noted += [f"{seed}: {note}" for note in found.notes]
        payload, fit = found.payload, found.accelerometer
        assert fit is not None
        read, (offset, scale, crossed) = fit.calibration, true_calibration(imu)
        rows: dict[str, tuple[Any, Any, Any]] = {
            "mass": ([payload.mass], [found.mass_interval], [tool.mass]),
            "center": (payload.center, payload.center_interval, tool.center),
            "offset": (read.offset, read.offset_interval, offset),
            "scale": (read.scale, read.scale_interval, scale),
            "crossed": (read.cross_axis, read.cross_axis_interval, crossed),
        }
        if case.poses:
            rows["bias"] = found.bias.values, found.bias_interval.values, BIAS.values
        if case.seconds:
            rows["tensor"] = payload.inertia, payload.inertia_interval, tool.inertia
        for name, (value, half, truth) in rows.items():
            shares.setdefault(name, []).append(np.subtract(value, truth) / half)
            shares.setdefault(f"({name})", []).append(np.array(half) / (tool.mass if name == "mass" else 1.0))
    return {name: np.array(each) for name, each in shares.items()}, refused, noted


def orbit(seed: int) -> Path:
    """An orbital polisher at 4 to 7 Hz: a circle, and a tilt that follows it."""
    draw = np.random.default_rng([seed, 14])
    hertz, phase = draw.uniform(4.0, 7.0), draw.uniform(0.0, 6.28, 4)
    slow = motion.guided(seed, metres=0.05, radians=0.4, hertz=(0.1, 0.4))

    def path(t: Array) -> tuple[Array, Array]:
        around = 2 * np.pi * hertz * t
        place = 0.004 * np.stack([np.cos(around), np.sin(around), 0.0 * t], axis=1)
        tilt = 0.03 * np.stack([np.sin(around + each) for each in phase[:3]], axis=1)
        return place, tilt

    return motion.together(path, slow)


MOTIONS: Final[dict[str, Callable[[int], Path]]] = {
    "rest": lambda seed: motion.shaken(1.0, 0.0),
    "pick": lambda seed: motion.waypoints(0.6, 1.0, seed),
    "wrist": motion.turned,
    "hand-guided": motion.guided,
    "polishing": orbit,
    "vibration": lambda seed: motion.together(motion.shaken(31.0), motion.guided(seed)),
}


def arrays(felt: Felt) -> Any:
    """As recordings give them to a `CompensatedStream`."""
    nothing = np.zeros(len(felt.times), int)
    return SimpleNamespace(
        force=felt.force, torque=felt.torque, acceleration=felt.acceleration, angular_rate=felt.rate,
        monotonic_ns=(1e9 * (felt.times + 100.0)).astype(np.int64), warnings=nothing,
        force_torque_saturated=nothing, acceleration_saturated=nothing, angular_rate_saturated=nothing,
    )  # fmt: skip


KINDS: Final = ("typed, tared", "tensor typed, tared", "poses", "poses and motion", "poses and motion, tared",
                "free motion, tared", "free motion")  # fmt: skip


def typed(tool: Payload, seed: int, *, has_tensor: bool) -> Payload:
    """As somebody knows it who is about as wrong as is assumed."""
    draw = np.random.default_rng([seed, 15])
    x, y, z = (tool.center + draw.normal(0.0, Payload().center_interval) / NORMAL_95).tolist()
    inertia = tool.inertia + draw.normal(0.0, 0.1 / NORMAL_95 * max(tool.inertia), 6)
    return Payload(tool.mass, (x, y, z), tuple(inertia.tolist()) if has_tensor else (0.0,) * 6)


@functools.lru_cache(maxsize=100)
def stream_for(kind: str, case: Case, seed: int) -> CompensatedStream:
    """As it is started with a file; CompensationError."""
    tool, imu = tool_of(seed), imu_of(seed, case)
    with tempfile.TemporaryDirectory() as folder:
        file = File(folder) / "tool.yaml"
        if "typed" in kind:
            write_payload(file, typed(tool, seed, has_tensor="tensor" in kind))
        else:
            name = kind.removesuffix(", tared")
            poses, seconds = {"poses": (6, 0.0), "poses and motion": (6, 20.0), "free motion": (0, 20.0)}[
                name
            ]
            write_yaml(file, identified(case._replace(poses=poses, seconds=seconds), tool, imu, seed),
                       offset=NO_WRENCH, settings=case.settings)  # fmt: skip
        stream = stream_of(written_parameters(file))
    info = SensorInfo(
        name="BFT-SENS-ECAT-M8", rate_hz=case.rate_hz, settings=case.settings, offset=(0.0,) * 6
    )
    stream.configure(InForce(info))
    if kind.endswith("tared"):
        tare(stream, held((0.3, -0.2, 1.0), tool, case, imu, [seed, 99]))
    return stream


def tare(stream: CompensatedStream, rows: Array) -> None:
    """As `~/tare` does it."""
    plan, means = stream.plan, stationary_means(rows, _ROOM)
    x, y, z = plan.accelerometer.correct(means.acceleration)
    bias = estimate_bias(means, plan.payload, (x, y, z))
    noise = at_reference(means.noise, stream.in_force.info.settings)
    taken = TareBasis(plan.payload, (x, y, z), plan.accelerometer, noise)
    stream.plan = plan._replace(ramp=plan.ramp.go(bias, 0.0, taken=taken))


def bounds(kind: str, name: str, case: Case, runs: int, first: int = 0) -> Array:
    """(4, n) errors and bounds of force and torque, N and Nm; of all runs that are not refused."""
    rows = []
    for seed in range(first, first + runs):
        try:
            stream = stream_for(kind, case, seed)
        except CompensationError:
            continue
        felt = felt_in(MOTIONS[name](seed + 500), tool_of(seed), 4.0, case, imu_of(seed, case), seed + 700)
        found, said = stream.compensate(arrays(felt))
        sizes = [np.linalg.norm(part, axis=1) for part in np.split(found, 2, axis=1)]
        rows.append(np.stack([*sizes, *said.T])[:, felt.times > 1.0])
    return np.concatenate(rows, axis=1)


def judged(rows: Array) -> list[float]:
    """Of force and of torque: the share within the bound, %, how much wider it is than needed, error rms."""
    told = []
    for error, bound in ((rows[0], rows[2]), (rows[1], rows[3])):
        share = error / bound
        told += [100.0 * np.mean(share <= 1.0), 1.0 / np.quantile(share, 0.95), np.sqrt(np.mean(error**2))]
    return told


def alarms(kind: str, name: str, case: Case, minutes: int, first: int = 0) -> int:
    """In so many minutes, another tool in each."""
    count = 0
    for seed in range(first, first + minutes):
        stream = stream_for(kind, case, seed)
        felt = felt_in(MOTIONS[name](seed + 500), tool_of(seed), 61.0, case, imu_of(seed, case), seed + 700)
        count += contacts(stream, felt)
    return count


def contacts(stream: CompensatedStream, felt: Felt) -> int:
    """How often contact begins, after a second."""
    detector = stream.contact_detector(Plane((0.0, 0.0, 0.1), (0.0, 0.0, 1.0), 0.05))
    source = stream.plan.source
    assert isinstance(source, ImuSource)
    source.configure(stream.in_force)
    at, turning = source.follow_all(felt.acceleration, felt.rate, felt.times)
    columns = SimpleNamespace(force=felt.force.T, torque=felt.torque.T)
    final, late = stream.stages(columns, 0.0, cast(Any, at), cast(Any, turning)).final, felt.times > 1.0
    return begun(detector, *(part[..., late] for part in (*map(np.array, final), turning)))


def begun(detector: ContactDetector, force: Array, torque: Array, turning: Any) -> int:
    """How often contact begins, of samples (3, n); `turning` (2, 3, n)."""
    is_beyond: list[Any] = []
    for detector.is_contact in (False, True):  # of the limits of the beginning and of the end
        is_beyond.append(detector.update(cast(Any, force), cast(Any, torque), turning))
    begins, lasts = is_beyond
    return len(np.unique(np.cumsum(~lasts)[begins]))


def main(what: str, runs: int, names: Sequence[str]) -> None:
    sizes = [int(name) for name in names if name.isdigit()] or [64]
    names, firs = [name for name in names if not name.isdigit() and name != "FIR"], ["FIR" in names]
    if what == "intervals":
        for name in (name for name in CASES if name in names or not names):
            shares, refused, noted = intervals(CASES[name], runs)
            told = "  ".join(
                f"{each} {100 * (np.abs(found) <= 1).mean():.1f} {np.sqrt((found**2).mean()) * 1.96:.2f}"
                for each, found in shares.items() if "(" not in each
            )  # fmt: skip
            touched = len({line.split(":")[0] for line in [*refused, *noted] if "touched" in line})
            sys.stdout.write(f"{name:24}{told}; refused {len(refused)}, touch named {touched} of {runs}\n")
            sys.stdout.flush()
        return
    for kind, size, fir, name in itertools.product(KINDS, sizes, firs, MOTIONS):
        if {kind, name} & {*names} or not names:
            case = Case(sinc_length=size, fir=fir)
            if what == "contact":
                told = f"{alarms(kind, name, case, runs)} alarms in {runs} minutes"
            else:
                force, wide, left, torque, torque_wide, twist = judged(bounds(kind, name, case, runs))
                told = f"force {force:5.1f} % {wide:5.2f} {left:.3f} N   "
                told += f"torque {torque:5.1f} % {torque_wide:5.2f} {twist:.4f} Nm"
            sys.stdout.write(f"{kind:26}{name:12}{size:4}  {told}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1], int((sys.argv[2:] or ["20"])[0]), sys.argv[3:])
