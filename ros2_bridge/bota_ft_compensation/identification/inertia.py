# SPDX-License-Identifier: Apache-2.0
"""A recording in which the tool turned: force, torque and what the IMU felt, at one instant and bandwidth.

What `free_motion` and its tests need of samples: smoothed instants, those in which something touched the tool
left out, as while a hand moves it from pose to pose, and least squares whose covariance is that of pieces of
the recording (sandwich), and so covers residuals that are correlated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bota_ethercat.pdo import Vector3
from bota_ethercat.sensor.response import (
    acceleration_response,
    angular_rate_response,
    fir_taps,
    imu_noise,
    noise_taps,
)
from bota_ft_compensation.alignment import Alignment, Array
from bota_ft_compensation.identification.resampling import (
    at_times,
    hann_window,
    smoothed,
    stretches,
)
from bota_ft_compensation.quantities import Accelerometer, CompensationError
from bota_ft_compensation.turning import PLACES, TENSORS, on_places, on_tensors

_RESPONSES: Final = acceleration_response, angular_rate_response
_WINDOW_S: Final = 0.05  # of the smoothing; a quarter of it apart are the instants that are compared
_PIECE_S: Final = 0.5  # whose residuals are independent of those of the others
_CONTACT_N, _CONTACT_SHARE = 1.0, 0.05  # contact: so much force, and of the weight, is not explained
_AROUND_S: Final = 0.2  # left out before and after a contact
# rad/s², rms of a piece: less is mostly noise of the gyroscope, which would pass for motion.
_LEAST_SPIN: Final = 0.3
# m/s²; how far from 1, also in standard errors: of a healthy IMU in motion.
_GRAVITY, _GAIN, _CHANCE = (7.0, 13.0), 0.35, 4.0
_CHANGES: Final = 1.0  # m/s³, rms: with less an offset of the gyroscope would be most of the turning
_AT_FIRST: Final = 1e6  # weights: what is measured goes first, not what was known before


class Turned(NamedTuple):
    """What `turn` makes of samples: n instants, smoothed alike."""

    force: Array  # (n, 3)
    torque: Array  # (n, 3)
    felt: Array  # (n, 3): specific force at the wrench origin, m/s²
    spin: Array  # (n, 3): angular acceleration, rad/s²
    products: Array  # (n, 3, 3) of angular rates, (rad/s)²
    times: Array  # (n,) s; none where a sample is missing
    # Deviations of noise: of force and torque, of single samples by those of smoothed ones, and of the
    # acceleration of smoothed ones, m/s².
    noisier: float = 1.0
    imu_noise: float = 0.0


def turn(
    stamps: Array, samples: Array, alignment: Alignment, accelerometer: Accelerometer, imu: Vector3
) -> Turned:
    """Force and torque, and what the IMU at `imu`, m, felt of them, at one instant and bandwidth.

    Of `samples` (n, 12): N, Nm, m/s², rad/s; taken at `stamps` (n,), s, in order.
    """
    if alignment.lag_s is None:
        raise CompensationError("by the filters that were set it is not known how late the force is")
    period, settings = alignment.period_s, alignment.settings
    late = [each(settings).delay_s or 0.0 for each in _RESPONSES]
    taps = np.array(fir_taps()) if settings.get("fir") else np.ones(1)
    lag_s = alignment.lag_s - period * (len(taps) - 1) / 2
    window, every = hann_window(_WINDOW_S, period), max(1, round(_WINDOW_S / period / 4))
    reach_s = period * len(taps) + abs(lag_s) + _WINDOW_S
    moved, found, instants = list[tuple[Array, ...]](), list[Array](), list[Array]()
    for stretch in stretches(stamps, max(alignment.gap_s, 2.5 * period)):
        own = stamps[stretch]
        begin_s, end_s = own[[0, -1]]  # of a single sample too
        if end_s - begin_s < reach_s + 4 * _WINDOW_S:
            continue
        times = np.arange(begin_s, end_s, period)
        load, acceleration, rate = np.split(samples[stretch], [6, 9], axis=1)
        load = at_times(times, own, load)
        acceleration, rate = (
            at_times(times - lag_s + delay_s - late[0], own, columns)
            for columns, delay_s in zip((acceleration, rate), late, strict=True)
        )
        # Products of rates pass the FIR filter otherwise than as products of what passes.
        read = np.hstack([acceleration, rate, (rate[:, :, None] * rate[:, None]).reshape(-1, 9)])
        passed = smoothed(read, taps, "full")[: len(times)]
        acceleration, rate, products = np.split(passed, [3, 6], axis=1)
        felt = np.stack(accelerometer.correct(tuple(acceleration.T)), axis=1)
        spin = np.gradient(rate, period, axis=0)
        arm = on_places(spin, products.reshape(-1, 3, 3))
        moved.append((felt, rate, arm))
        columns = np.hstack([load, felt - arm @ np.array(imu), spin, products])
        smooth, times = smoothed(columns, window)[::every], times[::every]
        is_whole = (times > begin_s + reach_s) & (times < end_s - _WINDOW_S)
        found.append(smooth[is_whole])
        instants.append(times[is_whole])
    if not found:
        raise CompensationError("there is a gap in every half second: ethercat-report tells why")
    _check_imu(moved, period)
    force, torque, felt, spin, products = np.split(np.concatenate(found), [3, 6, 9, 12], axis=1)
    times = np.concatenate(instants)
    return Turned(
        force, torque, felt, spin, products.reshape(-1, 3, 3), times,
        1.0 / float(np.linalg.norm(np.convolve(window, noise_taps(settings)))),
        imu_noise(settings)[0] * float(np.linalg.norm(np.convolve(window, taps))),
    )  # fmt: skip


def _check_imu(moved: Sequence[tuple[Array, ...]], period: float) -> None:
    """CompensationError if gravity does not turn as the gyroscope says, in what the IMU felt of stretches."""
    size = float(np.median(np.concatenate([np.linalg.norm(felt, axis=1) for felt, _, _ in moved])))
    if not _GRAVITY[0] < size < _GRAVITY[1]:
        raise CompensationError(
            f"the accelerometer reads {size:.2f} m/s² mostly, where gravity is 9.81: check imu_raw_units"
        )
    window, rows = hann_window(2 * _WINDOW_S, period), list[Array]()
    for felt, rate, arm in moved:
        slow = smoothed(np.concatenate([felt, arm.reshape(-1, 9)], axis=1), window)
        turns = smoothed(np.cross(felt, rate), window)
        row = np.concatenate([np.gradient(slow, period, axis=0), turns], axis=1)
        rows.append(row[len(window) : -len(window)])
    changes, swung, turns = np.split(np.concatenate(rows), [3, 12], axis=1)
    # Less what the IMU feels on the arm about which it turns, which is as regular.
    swung = swung.reshape(-1, 3)
    found = np.linalg.lstsq(swung, np.stack([changes.ravel(), turns.ravel()], axis=1), rcond=None)[0]
    changes, turns = (
        each - (swung @ at).reshape(-1, 3) for each, at in zip((changes, turns), found.T, strict=True)
    )
    each = float((turns**2).sum()) or 1.0
    gain = float((turns * changes).sum()) / each
    # What else accelerates the sensor is by chance in step with its turns: from piece to piece.
    starts = np.arange(0, len(turns), max(1, round(2 * _PIECE_S / period)))
    by_chance = np.add.reduceat((turns * (changes - gain * turns)).sum(axis=1), starts)
    error = max(_GAIN, _CHANCE * float(np.linalg.norm(by_chance)) / each)
    if abs(gain - 1.0) > error and (changes**2).sum() > _CHANGES**2 * len(changes):
        raise CompensationError(
            f"gravity turns {gain:.3g} times as fast as the gyroscope says, which should be 1: the "
            "angular rate has another sign or frame, or is in °/s (0.0175): check imu_raw_units"
        )


def untouched(turned: Turned, beyond: Array, weight: float) -> NDArray[np.bool_]:
    """(n,): so much force, N, that the tool does not explain is no contact."""
    spread = max(1, round(_AROUND_S / float(np.diff(turned.times[:2])[0])))
    is_touched = beyond > _CONTACT_N + _CONTACT_SHARE * weight
    return np.asarray(np.convolve(is_touched, np.ones(2 * spread + 1))[spread:-spread] < 0.5)


def divided(turned: Turned) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_]]:
    """Minutes (n, 1, 1), numbers of the pieces (n,), and (n, 6): whether more than noise shows elements."""
    pieces = np.unique((turned.times / _PIECE_S).astype(int), return_inverse=True)[1]
    squares, lengths = np.zeros((pieces[-1] + 1, 6)), np.maximum(np.bincount(pieces), 1)
    spun = on_tensors(turned.spin, turned.products)
    np.add.at(squares, pieces, (spun**2).sum(axis=1) / lengths[pieces, None])
    is_shown = (squares > _LEAST_SPIN**2)[pieces] & spun.any(axis=1)
    return (turned.times - turned.times.mean())[:, None, None] / 60.0, pieces, is_shown


def solve_pieces(
    design: Array, measured: Array, pieces: NDArray[np.int64], known: Array, towards: Array
) -> tuple[Array, Array, float]:
    """The unknowns (p,) of `design` (n, k, p) times unknowns = `measured` (n, k), covariance and degrees.

    `pieces` (n,) numbers those whose residuals are correlated. `known` (p, p): inverse of the covariance that
    was known before, and `towards` (p,): times what was expected.
    """
    pieces = np.unique(pieces, return_inverse=True)[1]
    (_, kinds, unknowns), count = design.shape, int(pieces[-1]) + 1
    scale = np.sqrt((design**2).mean(axis=(0, 1)))
    scale[scale == 0.0] = 1.0  # of what the motion does not show at all
    design, known, towards = design / scale, known / np.outer(scale, scale), towards / scale
    weights = np.full(kinds, _AT_FIRST)
    for _ in range(3):
        weighted = design * weights[:, None]
        information = np.tensordot(weighted, design, ([0, 1], [0, 1])) + known
        right = np.tensordot(weighted, measured, ([0, 1], [0, 1])) + towards
        answer = np.linalg.lstsq(information, right, rcond=1e-15)[0]
        residuals = measured - design @ answer
        # Neighboring instants tell the same: so many as a piece has count as one.
        weights = 1.0 / (np.maximum((residuals**2).mean(axis=0), 1e-12) * 2.0)
    scores = np.zeros((count, unknowns))
    np.add.at(scores, pieces, np.einsum("nip,ni->np", design * weights[:, None], residuals))
    degrees = max(count - unknowns / kinds, 1.0)
    meat = scores.T @ scores * count / degrees
    inverse = np.linalg.pinv(information, rcond=1e-15, hermitian=True)
    covariance = inverse @ (meat + known) @ inverse
    return answer / scale, covariance / np.outer(scale, scale), degrees


def possible_inertia(found: Array, interval: Array) -> Array:
    """The nearest tensor that a body can have; CompensationError if that is beyond the interval.

    Half its trace less itself is the second moment of the mass, which is nowhere negative: this is that the
    moments are positive, and none larger than the sum of the others.
    """
    tensor = np.tensordot(found, TENSORS, 1)
    spread, axes = np.linalg.eigh(0.5 * np.trace(tensor) * np.eye(3) - tensor)
    if spread[0] < -np.linalg.norm(interval):
        moments = ", ".join(f"{moment:.2g}" for moment in np.linalg.eigvalsh(tensor))
        raise CompensationError(
            f"the principal moments of inertia would be {moments} kg m², which no body has: something "
            "touched the tool, or the angular rate has another sign or unit"
        )
    spread = np.maximum(spread, 0.0)
    tensor = spread.sum() * np.eye(3) - (axes * spread) @ axes.T
    return np.array([tensor[i, j] for i, j in PLACES])
