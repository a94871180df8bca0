"""Bota's own estimator and compensator on samples from a file; run by the Python of an environment with them.

    bota_toolkit.py estimate samples.npz tool.json  # in real time: the estimator goes by the process's clock
    bota_toolkit.py compensate samples.npz tool.json left.npy

Samples: `times` (n,), s; `rows` (n, 12): force, torque, acceleration, angular rate, SI; `imu` (3,), m: where
the IMU is; `noise` (5,): variances in the order of the keys; `tare_s`: when to tare.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from bota_payload_utils import BotaPayloadCompensator, BotaPayloadEstimator
from bota_tf_utils import BotaTfImu

NOISE = "force", "torque", "linear_acc", "angular_vel", "angular_acc"


def xyz(value: float) -> dict[str, float]:
    return dict.fromkeys("xyz", float(value))


def moved(rows: Any, imu: Any) -> Any:
    """With the acceleration at the wrench's origin, by the vendor."""
    block, identity = BotaTfImu(), np.array([1.0, 0.0, 0.0, 0.0])
    for way, place in (("input", imu), ("output", np.zeros(3))):
        getattr(block, f"set_{way}_reference_point")("fixed_frame", place)
        getattr(block, f"set_{way}_expression_axes")("fixed_frame", identity)
    rows = rows.copy()
    for row in rows:
        block.update(row[6:].copy(), row[6:])
    return rows


def estimate(data: Any, rows: Any, path: str) -> None:
    seconds, tensor = float(data["times"][-1]), [f"I{axes}" for axes in ("xx", "xy", "xz", "yy", "yz", "zz")]
    config = {
        "output_config_file_name": path,
        "min_time": seconds - 1.0,
        "max_time": seconds + 1.0,
        "prior_payload_properties": {"mass": 1.0, "com": xyz(0.03), "inertia": dict.fromkeys(tensor, 0.0)},
        "measurement_noise_covariance": dict(zip(NOISE, map(xyz, data["noise"]), strict=True)),
        "estimation_covariance_convergence_threshold": dict.fromkeys(
            ("mass", "com", "inertia", "wrench_bias"), 1.0
        ),
        "runtime_verbosity": False,
        "output_bias_estimate": True,
    }
    Path(f"{path}.config").write_text(json.dumps({"payload_estimator_config": config}))
    estimator = BotaPayloadEstimator(f"{path}.config")
    estimator.start_payload_estimation()
    begin = time.monotonic()
    for stamp, row in zip(data["times"], rows, strict=True):
        time.sleep(max(0.0, begin + stamp - time.monotonic()))
        estimator.update(stamp, row)
        if not estimator.is_estimator_running():
            break
    print("successful" if estimator.is_estimation_successful() else "refused")


def compensate(data: Any, rows: Any, path: str, left: str) -> None:
    compensator, out = BotaPayloadCompensator(path), np.zeros((len(rows), 12))
    for number, (stamp, row) in enumerate(zip(data["times"], rows, strict=True)):
        if stamp >= data["tare_s"] > data["times"][number - 1]:
            compensator.tare_compensated_wrench()
        compensator.update(stamp, row, out[number])
    np.save(left, out[:, :6])


if __name__ == "__main__":
    what, samples, *paths = sys.argv[1:]
    data = np.load(samples)
    moved_rows = moved(data["rows"], data["imu"])
    if what == "estimate":
        estimate(data, moved_rows, *paths)
    else:
        compensate(data, moved_rows, *paths)
