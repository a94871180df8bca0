#!/usr/bin/env bash
# PyBullet 3.2.7: what is fixed to the first moving link of a fixed robot passes through a table, with contacts of 0 N.
#
# One would guess: a tool behind a fixed joint (the force/torque sensor) touches what its collision shape touches.
# What happens: with a fixed base, links that are fixed to link 0 count as static although link 0 moves, and static
# things do not push each other: getContactPoints() lists the contact, its force is 0, the sensor shows the bare
# weight, the tool goes on. The tool is stopped by a table that is not fixed (mass above 0), or once a link without
# mass, `world`, is above the base, so that the moving link is number 1. A user meets it with a test stand of one
# axis: slide, sensor, tool. The same tool on an arm's second joint is stopped. It is so for createMultiBody, too.
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
import sys
from importlib.metadata import version
from pathlib import Path

import pybullet

INERTIAL = '<inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>'
STAND = f"""
  <link name="base">{INERTIAL}</link>
  <link name="slide">{INERTIAL}</link>
  <joint name="axis" type="prismatic"><parent link="base"/><child link="slide"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1000" velocity="1"/></joint>
  <link name="tool">{INERTIAL}<collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <joint name="sensor" type="fixed"><parent link="slide"/><child link="tool"/></joint>"""
WORLD = '<link name="world"/><joint name="feet" type="fixed"><parent link="world"/><child link="base"/></joint>'

def pressed(description, table_mass=0.0):
    """Contacts, their force, the sensor's, N, and the place, m, of a tool pressed by 40 N on a table at -0.01 m."""
    path = Path(sys.argv[1], "stand.urdf")
    path.write_text(f'<robot name="stand">{description}</robot>')
    pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81)
    floor = pybullet.createCollisionShape(pybullet.GEOM_PLANE)
    pybullet.createMultiBody(0, floor, basePosition=(0, 0, -1.11))
    shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=(2, 2, 0.5))
    table = pybullet.createMultiBody(table_mass, shape, basePosition=(0, 0, -0.61))
    stand = pybullet.loadURDF(str(path), useFixedBase=True)
    joints = {pybullet.getJointInfo(stand, number)[1]: number for number in range(pybullet.getNumJoints(stand))}
    axis, sensor = joints[b"axis"], joints[b"sensor"]
    pybullet.enableJointForceTorqueSensor(stand, sensor)
    for _ in range(480):
        pybullet.setJointMotorControl2(stand, axis, pybullet.POSITION_CONTROL, -0.05, force=40)
        pybullet.stepSimulation()
    contacts = pybullet.getContactPoints(stand, table)
    felt, place = pybullet.getJointState(stand, sensor)[2][2], pybullet.getJointState(stand, axis)[0]
    pybullet.disconnect()
    return [round(each, 2) + 0.0 for each in (len(contacts), sum(each[9] for each in contacts), felt, place)]

print("PyBullet", version("pybullet"))
seen = {}
cases = {
    "a fixed table": (STAND,),
    "a table of 1000 kg": (STAND, 1000.0),
    "a fixed table, with a link `world`": (STAND + WORLD,),
}
for name, case in cases.items():
    count, force, felt, place = seen[name] = pressed(*case)
    print(f"{name}: {count:.0f} contact(s) of {force} N, sensor {felt} N, tool at {place} m (table: -0.01 m)")
fixed, heavy, world = seen.values()
assert all(abs(each[1] - 59.62) < 0.1 and abs(each[2] + 49.81) < 0.1 and each[3] == -0.01 for each in (heavy, world))
assert fixed[0] >= 1 and fixed[1:] == [0.0, 9.81, -0.05], "the behavior has changed"
END
"$folder/venv/bin/python" "$folder/check.py" "$folder"
