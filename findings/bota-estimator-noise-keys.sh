#!/usr/bin/env bash
# bota-payload-utils 1.0.3: the estimator takes the five variances of the noise shifted by two keys.
#
# One would guess: `measurement_noise_covariance.force` is the variance of the force.
# What happens: as it prints itself, the force gets the value of `linear_acc`, the torque that of `angular_vel`, the
# acceleration that of `angular_acc`, the angular rate that of `force`, the angular acceleration that of `torque`.
# With variances under the right keys the inertia is far off and the estimation is successful; under the keys by which
# they arrive where they belong it is near. A user meets it by measuring the noise of his sensor and typing it in.
# It takes 90 s: the estimator goes by the process's clock.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check bota-payload-utils==1.0.3 bota-control==1.0.7 'numpy<3'
cat >"$folder/check.py" <<'END_OF_CHECK'
import json, sys, time
from importlib.metadata import version

import numpy as np
from bota_payload_utils import BotaPayloadEstimator

KEYS = ("force", "torque", "linear_acc", "angular_vel", "angular_acc")
VARIANCES = (0.03, 3e-5, 4e-4, 3e-6, 0.1)  # of what is felt below, N, Nm, m/s^2, rad/s, rad/s^2
SHIFTED = tuple(VARIANCES[(number + 3) % 5] for number in range(5))  # by which each arrives at its own
MASS, CENTER, INERTIA = 1.5, np.array([0.02, -0.03, 0.05]), np.diag([0.012, 0.010, 0.008])  # about the origin
SECONDS, RATE_HZ = 20.0, 400

def felt():
    """Rows of a sensor that is turned about its origin: force, torque, acceleration, angular rate, with noise."""
    draw, period, turned = np.random.default_rng(1), 1 / RATE_HZ, np.eye(3)
    sizes, hertz, phases = draw.uniform(0.6, 1.0, (4, 3)), draw.uniform(0.2, 1.0, (4, 3)), draw.uniform(0, 6.28, (4, 3))
    for at in np.arange(0.0, SECONDS + 0.5, period):
        angle = 6.2832 * hertz * at + phases
        rate, spin = (sizes * np.sin(angle)).sum(axis=0), (sizes * 6.2832 * hertz * np.cos(angle)).sum(axis=0)
        x, y, z = rate * period
        turned, _ = np.linalg.qr(turned @ (np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])))
        turned = turned * np.sign(np.diag(turned.T @ before)) if at else turned * np.sign(np.diag(turned))
        before, up = turned, turned.T @ [0.0, 0.0, 9.80665]
        force = -MASS * (up + np.cross(spin, CENTER) + np.cross(rate, np.cross(rate, CENTER)))
        torque = np.cross(CENTER, -MASS * up) - INERTIA @ spin - np.cross(rate, INERTIA @ rate)
        exact = np.concatenate([force, torque, up, rate])
        yield at, exact + np.sqrt(np.repeat(VARIANCES[:4], 3)) * draw.normal(size=12)

def estimated(variances):
    """Code and the estimated mass, kg, and moments about the origin, kg m^2."""
    xyz, out = lambda value: dict.fromkeys("xyz", value), f"{sys.argv[1]}/tool.json"
    moments = dict.fromkeys(("Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz"), 0.0)
    config = {
        "output_config_file_name": out, "min_time": SECONDS - 1, "max_time": SECONDS + 1,
        "prior_payload_properties": {"mass": 1.0, "com": xyz(0.03), "inertia": moments},
        "measurement_noise_covariance": dict(zip(KEYS, map(xyz, variances))),
        "estimation_covariance_convergence_threshold": dict.fromkeys(("mass", "com", "inertia", "wrench_bias"), 1.0),
    }
    with open(out + ".config", "w") as file:
        json.dump({"payload_estimator_config": config}, file)
    estimator = BotaPayloadEstimator(out + ".config")
    estimator.start_payload_estimation()
    begin = time.monotonic()
    for at, row in list(felt()):
        time.sleep(max(0.0, begin + at - time.monotonic()))
        estimator.update(at, row)
        if not estimator.is_estimator_running():
            break
    with open(out) as file:
        found = json.load(file)["payload_compensator_config"]["payload_properties"]
    assert estimator.is_estimation_successful()
    return found["mass"], [found["inertia"][name] for name in ("Ixx", "Iyy", "Izz")]

print("bota-payload-utils", version("bota-payload-utils"), "variances", dict(zip(KEYS, VARIANCES)))
errors = []
for name, variances in {"under the keys of their names": VARIANCES, "shifted by two keys": SHIFTED}.items():
    mass, moments = estimated(variances)
    errors.append(max(abs(moment / truth - 1) for moment, truth in zip(moments, np.diag(INERTIA))))
    print(f"{name}: successful, {mass} kg, moments {moments}, error up to {100 * errors[-1]:.0f} %")
assert errors[0] > 3 * errors[1] and errors[0] > 1.0, "it has changed"
END_OF_CHECK
"$folder/venv/bin/python" "$folder/check.py" "$folder" | tee "$folder/out" | grep -a 'variances\|Force:\|Torque:\|Lin acc:\|Ang \|keys'
grep -aq 'Force: \[0.000400' "$folder/out" || { echo "it has changed" >&2; exit 1; }
