#!/usr/bin/env bash
# MuJoCo 4.0.0: the force sensor does not feel thrusters, wind or water on the tool, nor that it has no weight.
#
# One would guess: `<sensor><force site=...>` gives what passes from parent to child, whatever pushes the child, so
# that a push of 20 N changes it by 20 N; and with gravcomp="1" the tool weighs nothing in it.
# What happens: xfrc_applied and a tendon's motor are felt; a motor of a site, wind or water (density, wind) and
# gravcomp are not: the joint below carries more, or less, and the sensor shows the bare weight as before. A user
# meets it in a simulation of a drone's or an underwater arm; and who gives all bodies gravcomp so that the arm does
# not sag still has the tool's weight in the sensor, as on a real arm.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
cat >"$folder/check.py" <<'END'
import mujoco

STIFFNESS, WEIGHT = 100_000.0, 9.81

def settled(tool="", option="", more="", control=None, push=0.0):
    """Force of the sensor, N, and of the spring below everything less both weights, upward."""
    model = mujoco.MjModel.from_xml_string(f"""
      <mujoco><option timestep="0.001" {option}/>
        <worldbody><site name="world"/>
          <body pos="0 0 1"><joint type="slide" axis="0 0 1" stiffness="{STIFFNESS}" damping="1000"/>
            <geom size="0.01" mass="1"/>
            <body name="tool" pos="0 0 0.2" {tool}><site name="sensor"/>
              <geom type="box" size="0.1 0.1 0.01" mass="1"/></body></body></worldbody>
        {more}<sensor><force site="sensor"/></sensor></mujoco>""")
    data = mujoco.MjData(model)
    data.xfrc_applied[model.body("tool").id, 2] = push
    if control is not None:
        data.ctrl[0] = control
    for _ in range(3000):
        mujoco.mj_step(model, data)
    return data.sensordata[2] - WEIGHT, -STIFFNESS * data.qpos[0] - 2 * WEIGHT

tendon = '<tendon><spatial name="rope"><site site="world"/><site site="sensor"/></spatial></tendon>'
cases = {
    "nothing": settled(),
    "xfrc_applied -20 N": settled(push=-20.0),
    "a tendon's motor, -20 N": settled(more=tendon + '<actuator><motor tendon="rope"/></actuator>', control=-20.0),
    "a site's motor, -20 N": settled(
        more='<actuator><motor site="sensor" gear="0 0 1 0 0 0"/></actuator>', control=-20.0),
    "water that flows down": settled(option='density="1000" wind="0 0 -1"'),
    "gravcomp of the tool": settled(tool='gravcomp="1"'),
}
print("mujoco", mujoco.__version__)
for name, (felt, carried) in cases.items():
    print(f"{name}: the support carries {carried:.2f} N more than both weights,",
          f"the sensor shows {felt:.2f} N more than the tool's")
felt = [round(felt, 2) + 0.0 for felt, _ in cases.values()]
carried = [round(carried, 1) for _, carried in cases.values()]
assert carried[1:4] == [20.0, 20.0, 20.0] and carried[4] > 15 and carried[5] == -9.8
assert felt == [0.0, 20.0, 20.0, 0.0, 0.0, 0.0], "the behavior has changed"
END
"$folder/venv/bin/python" "$folder/check.py"
