"""The result as a table and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from clients.identify.stationary_periods import StationaryPeriod, StationaryPeriods
from ft_compensation.identification.payload import Fit, Identified, OffsetFit
from ft_compensation.identification.poses import Pose
from ft_compensation.quantities import Wrench


def show_poses(
    console: Console, periods: Sequence[StationaryPeriod], poses: Sequence[Pose], result: Identified | None
) -> None:
    """The poses with their residuals."""
    table = Table(title="poses", title_justify="left")
    for head in ("", "at s", "for s", "samples", "up x", "up y", "up z", "residual N", "residual Nm"):
        table.add_column(head, justify="right")
    for number, (period, pose) in enumerate(zip(periods, poses, strict=True)):
        left = ["", ""]
        if result is not None:
            residual = result.residuals[number]
            left = [f"{_length(residual.force):.3f}", f"{_length(residual.torque):.5f}"]
        table.add_row(
            str(number + 1), f"{period.begin_s:.1f}", f"{period.seconds:.1f}", str(pose.samples),
            *(f"{round(part, 2) + 0.0:.2f}" for part in pose.up), *left,
        )  # fmt: skip
    console.print(table)


def show_result(console: Console, result: Identified) -> None:
    """The parameters with their intervals, and notes."""
    table = Table(title="payload and bias", title_justify="left")
    table.add_column("")
    table.add_column("value", justify="right")
    table.add_column(f"± ({100 * result.confidence:g} %)", justify="right")
    table.add_column("unit")
    table.add_row("mass", f"{result.payload.mass:.4f}", f"{result.mass_interval:.4f}", "kg")
    for axis, value, interval in zip("xyz", result.payload.center, result.centre_interval, strict=True):
        table.add_row(f"center of gravity {axis}", f"{1000 * value:.2f}", f"{1000 * interval:.2f}", "mm")
    _add_bias(table, result.bias, result.bias_interval)
    if (fit := result.accelerometer) is not None:
        found = fit.calibration
        for axis, value, half in zip("xyz", found.offset, found.offset_interval, strict=True):
            table.add_row(f"accelerometer offset {axis}", f"{value:.3f}", f"{half:.3f}", "m/s²")
        for axis, value, half in zip("xyz", found.scale, found.scale_interval, strict=True):
            table.add_row(f"accelerometer scale {axis}", f"{value:.4f}", f"{half:.4f}", "")
    console.print(table)
    console.print(
        f"residual: {_fit(result.force_fit, 'N')}, {_fit(result.torque_fit, 'Nm')}; condition number "
        f"{result.condition:.2f} (1.2 is ideal)"
    )
    for note in result.notes:
        console.print(f"note: {note}")


def _add_bias(table: Table, bias: Wrench, interval: Wrench) -> None:
    for axis, value, half in zip("xyz", bias.force, interval.force, strict=True):
        table.add_row(f"bias force {axis}", f"{value:.3f}", f"{half:.3f}", "N")
    for axis, value, half in zip("xyz", bias.torque, interval.torque, strict=True):
        table.add_row(f"bias torque {axis}", f"{value:.5f}", f"{half:.5f}", "Nm")


def as_json(
    found: StationaryPeriods, poses: Sequence[Pose], result: Identified | None, error: str | None
) -> dict[str, Any]:
    """Everything, in SI units; `ok` is whether there is a result."""
    rows = [
        {
            "begin_s": period.begin_s, "seconds": period.seconds, "samples": pose.samples,
            "force": pose.wrench.force, "torque": pose.wrench.torque, "gravity": pose.gravity,
            "force_spread": pose.force_spread, "torque_spread": pose.torque_spread,
        }
        for period, pose in zip(found.periods, poses, strict=True)
    ]  # fmt: skip
    if result is None:
        return {"ok": False, "error": error, "poses": rows, "rejected": list(found.rejected)}
    for row, residual in zip(rows, result.residuals, strict=True):
        row["residual_force"], row["residual_torque"] = residual.force, residual.torque
    return {
        "ok": True,
        "tool_mass": result.payload.mass,
        "tool_mass_interval": result.mass_interval,
        "tool_center_of_gravity": result.payload.center,
        "tool_center_of_gravity_interval": result.centre_interval,
        "bias": result.bias.values,
        "bias_interval": result.bias_interval.values,
        "confidence": result.confidence,
        "force_rms": result.force_rms,
        "torque_rms": result.torque_rms,
        "force_fit": result.force_fit._asdict(),
        "torque_fit": result.torque_fit._asdict(),
        "accelerometer": _accelerometer(result.accelerometer),
        "condition": result.condition,
        "gravity": result.gravity,
        "notes": list(result.notes),
        "poses": rows,
        "rejected": list(found.rejected),
    }


def _fit(fit: Fit, unit: str) -> str:
    times = "" if fit.chi_square is None else f", {fit.chi_square**0.5:.1f} times the noise"
    return f"{fit.rms:.3g} {unit} ({fit.verdict}{times})"


def _accelerometer(fit: OffsetFit | None) -> dict[str, Any] | None:
    if fit is None:
        return None
    return {**fit.calibration._asdict(), "undetermined": fit.undetermined}


def _length(values: Sequence[float]) -> float:
    return float(sum(value * value for value in values) ** 0.5)
