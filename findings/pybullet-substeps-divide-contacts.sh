#!/usr/bin/env bash
# PyBullet 3.2.7: with numSubSteps=N contacts and motors show 1/N of their force, and motors may push N times as much.
#
# One would guess: sub-steps make a simulation finer, and forces are in N whatever their number (a change of 2020 in
# Bullet was for that).
# What happens: getContactPoints() has the normal and friction forces divided by N, getJointState()'s motor torque
# too, and `force=15` of setJointMotorControl2 holds 19.62 N: the limit is 15 x N. In the same step the joint's reaction
# force (the force/torque sensor) is right. A user meets it when a stiff contact is made finer: limits and rewards by
# contact force become N times as lax, a gripper N times as strong, and the sensor disagrees with the contacts. A
# shorter setTimeStep() with more steps has it right.
set -euo pipefail
for python in python3.11 python3.10 python3.9 python3 none; do
  if "$python" -c 'import sys; sys.exit(not (3, 9) <= sys.version_info[:2] <= (3, 11))' 2>/dev/null; then break; fi
done
[ "$python" != none ] || { echo "PyBullet 3.2.7 has wheels for Python 3.9 to 3.11; none is on PATH." >&2; exit 77; }
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"$python" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --only-binary :all: \
  pybullet==3.2.7 'numpy<3'
cat >"$folder/check.py" <<'END'
from importlib.metadata import version

import pybullet

def simulated(sub_steps, step_s=1 / 240):
    """N: a sliding box's contacts and their friction; a joint's motor and limit, and the sensor in the arm."""
    pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81)
    pybullet.setTimeStep(step_s)
    pybullet.setPhysicsEngineParameter(numSubSteps=sub_steps)
    cube = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=(0.1, 0.1, 0.1))
    table = pybullet.createMultiBody(
        0, pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=(2, 2, 0.5)), basePosition=(0, 0, -0.6))
    box = pybullet.createMultiBody(1, cube, basePosition=(0, 0, 0.001))
    none, turned, two = [(0, 0, 0)] * 2, [(0, 0, 0, 1)] * 2, [-1, -1]
    arm = pybullet.createMultiBody(
        0, -1, basePosition=(5, 0, 0), linkMasses=[1, 1], linkCollisionShapeIndices=two, linkVisualShapeIndices=two,
        linkPositions=none, linkOrientations=turned, linkInertialFramePositions=none,
        linkInertialFrameOrientations=turned, linkParentIndices=[0, 1], linkJointAxis=[(0, 0, 1)] * 2,
        linkJointTypes=[pybullet.JOINT_PRISMATIC, pybullet.JOINT_FIXED])
    pybullet.enableJointForceTorqueSensor(arm, 1)
    for _ in range(round(2 / step_s)):
        pybullet.setJointMotorControl2(arm, 0, pybullet.POSITION_CONTROL, 0, force=15)
        pybullet.applyExternalForce(box, -1, (2, 0, 0), (0, 0, -0.1), pybullet.LINK_FRAME)
        pybullet.stepSimulation()
    contacts = pybullet.getContactPoints(box, table)
    normal = sum(each[9] for each in contacts)
    friction = sum(each[10] * each[11][0] + each[12] * each[13][0] for each in contacts)
    place, _, _, motor = pybullet.getJointState(arm, 0)
    felt = pybullet.getJointState(arm, 1)[2][2]
    pybullet.disconnect()
    return [round(each, 2) for each in (normal, friction, motor, felt, place)]

print("PyBullet", version("pybullet"))
seen = {}
for name, case in {"1": (1,), "4": (4,), "10": (10,), "1, a quarter of the step": (1, 1 / 960)}.items():
    normal, friction, motor, felt, place = seen[name] = simulated(*case)
    print(f"numSubSteps={name}: 9.81 N rest on {normal} N, 2 N are held by {friction} N of friction;",
          f"19.62 N hang on a motor of up to 15 N that shows {motor} N and is at {place} m; sensor {felt} N")
for name in ("1", "1, a quarter of the step"):
    assert seen[name][:3] == [9.81, 2.0, 15.0] and seen[name][4] < -1
for parts in (4, 10):
    expected = [9.81 / parts, 2.0 / parts, 19.62 / parts, 9.81, 0.0]
    differences = [abs(one - other) for one, other in zip(seen[str(parts)], expected, strict=True)]
    assert max(differences) < 0.01, "the behavior has changed"
END
"$folder/venv/bin/python" "$folder/check.py"
