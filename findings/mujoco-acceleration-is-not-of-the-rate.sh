#!/usr/bin/env bash
# MuJoCo 4.0.0: with damping, accelerometer and force sensor show more acceleration than the gyroscope's rate changes by.
#
# One would guess: the derivative of what the gyroscope shows is the angular acceleration that accelerometer, force,
# torque and frameangacc contain, but for the order of the step.
# What happens: they contain qacc, which the equations of motion give at the beginning of the step. Integrators that
# take damping (of joints; with implicit and implicitfast also an actuator's kv) implicitly change velocities by less:
# by 1 / (1 + step * damping / inertia) of it, in any motion, however slow and smooth. A user meets it with a stiff arm
# at 1 ms, whose wrist had half: weight and inertia of its tool, computed by the simulated IMU, left 0.4 N of 7 N.
# RK4, and Euler with <flag eulerdamp="disable"/>, agree; RK4 only if controls do not jump from step to step.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
cat >"$folder/check.py" <<'END'
import math
import mujoco
import numpy as np

STEP, DAMPING, INERTIA = 0.001, 50.0, 0.1

def shown(integrator, flag=""):
    """What the rate changes by, as a share of the angular acceleration that is shown."""
    model = mujoco.MjModel.from_xml_string(f"""
      <mujoco><option timestep="{STEP}" gravity="0 0 0" integrator="{integrator}">{flag}</option>
        <worldbody><body><joint name="joint" axis="0 0 1" damping="{DAMPING}"/>
          <inertial mass="1" pos="0 0 0" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/><site name="imu"/></body>
        </worldbody>
        <actuator><motor joint="joint"/></actuator>
        <sensor><gyro site="imu"/><frameangacc objtype="site" objname="imu"/></sensor></mujoco>""")
    data, rows = mujoco.MjData(model), []
    for step in range(4000):
        data.ctrl[0] = 100.0 * math.sin(2.0 * math.pi * step * STEP)  # 1 Hz
        mujoco.mj_step(model, data)
        rows.append((data.sensordata[2], data.sensordata[5]))
    rate, shown = np.array(rows)[1000:].T
    return float(np.gradient(rate, STEP) @ shown / (shown @ shown))

print("mujoco", mujoco.__version__)
off = '<flag eulerdamp="disable"/>'
found = {f"{name}{flag}": shown(name, flag) for name, flag in (
    ("implicitfast", ""), ("implicit", ""), ("Euler", ""), ("Euler", off), ("RK4", ""))}
for name, share in found.items():
    print(f"{name}: the rate changes by {share:.3f} of the angular acceleration that is shown")
expected = 1.0 / (1.0 + STEP * DAMPING / INERTIA)
*implicit, explicit, runge_kutta = found.values()
assert all(abs(share - expected) < 0.01 for share in implicit), "the behavior has changed"
assert abs(explicit - 1.0) < 0.01 and runge_kutta < 0.9, "the behavior has changed"
END
"$folder/venv/bin/python" "$folder/check.py"
