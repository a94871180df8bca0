"""The table of docs/world.md: each simulator that is installed, against its own numbers.

A tool hangs on a turned sensor on an arm at rest: by the page's formulas its weight, and the torque of that.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

MASS, CENTER = 1.3, (0.03, -0.02, 0.11)  # kg; m in the sensor's frame
TURNED = (
    f"{np.pi / 2} 0 {np.pi / 2}"  # roll, pitch, yaw of the sensor in the arm, of the inertia in the sensor
)
ROTATION = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # the same
DOWN = np.array([0.0, 0.0, -9.81])
PAGE = (Path(__file__).parents[1] / "docs" / "world.md").read_text()
ROWS = re.findall(r"^\| ?(\w+) [\d.]+ ?\|.*\| ?([^|]+); ([^|]+?) ?\|$", PAGE, re.MULTILINE)
INERTIA = '<inertia ixx=".02" iyy=".03" izz=".02" ixy="0" ixz="0" iyz="0"/></inertial></link>'
WHERE = " ".join(map(str, CENTER))
URDF = f"""<robot name="arm"><link name="base"/><link name="link"><inertial><mass value="2"/>{INERTIA}
<link name="tool"><inertial><origin xyz="{WHERE}" rpy="{TURNED}"/><mass value="{MASS}"/>{INERTIA}
<joint name="shoulder" type="fixed"><parent link="base"/><child link="link"/><axis xyz="0 0 1"/>
  <limit effort="1000" velocity="10" lower="-3" upper="3"/></joint>
<joint name="sensor" type="fixed"><origin xyz="0.1 0.2 0.3" rpy="{TURNED}"/>
  <parent link="link"/><child link="tool"/></joint></robot>"""
MOVABLE = URDF.replace("fixed", "revolute", 1)
MJCF = f"""<mujoco><compiler angle="radian" eulerseq="XYZ"/><worldbody><body euler="{TURNED}">
<inertial pos="{WHERE}" mass="{MASS}" diaginertia=".02 .03 .02"/><site name="s"/></body></worldbody>
<sensor><force site="s"/><torque site="s"/></sensor></mujoco>"""


def from_mujoco(steps: int, _path: Path) -> Any:
    module = pytest.importorskip("mujoco")
    model = module.MjModel.from_xml_string(MJCF)
    data = module.MjData(model)
    for _ in range(steps):
        module.mj_step(model, data)
    return data.sensordata


def from_pybullet(steps: int, path: Path) -> Any:
    module = pytest.importorskip("pybullet")
    path.write_text(URDF)
    client = module.connect(module.DIRECT)
    try:
        module.setGravity(*DOWN)
        arm = module.loadURDF(str(path), useFixedBase=True, flags=module.URDF_USE_INERTIA_FROM_FILE)
        module.enableJointForceTorqueSensor(arm, 1)
        for _ in range(steps):
            module.stepSimulation()
        return np.kron(np.eye(2), ROTATION) @ module.getJointState(arm, 1)[2]
    finally:
        module.disconnect(client)


def from_drake(steps: int, _path: Path) -> Any:
    drake = pytest.importorskip("pydrake.all")
    plant = drake.MultibodyPlant(time_step=0.001)
    drake.Parser(plant).AddModelsFromString(URDF, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.mutable_gravity_field().set_gravity_vector(DOWN)
    plant.Finalize()
    simulator = drake.Simulator(plant)
    simulator.AdvanceTo(steps * 0.001)
    forces = plant.get_reaction_forces_output_port().Eval(simulator.get_context())
    felt = forces[int(plant.GetJointByName("sensor").index())]
    return np.concatenate([felt.translational(), felt.rotational()])


def from_pinocchio(_steps: int, _path: Path) -> Any:
    module = pytest.importorskip("pinocchio")
    model = module.buildModelFromXML(MOVABLE)
    model.gravity.linear = DOWN
    data, state = model.createData(), (module.neutral(model), np.zeros(model.nv), np.zeros(model.nv))
    module.rnea(model, data, *state)
    module.forwardKinematics(model, data, *state)
    return module.computeSupportedForceByFrame(model, data, model.getFrameId("sensor")).vector


def from_newton(steps: int, path: Path) -> Any:
    module = pytest.importorskip("newton")
    pytest.importorskip("mujoco_warp")
    path.write_text(MOVABLE)
    builder = module.ModelBuilder(gravity=tuple(DOWN))
    builder.add_urdf(str(path), floating=False)
    model = builder.finalize(device="cpu")
    solver, states = module.solvers.SolverMuJoCo(model), (model.state(), model.state())
    seen = solver.observables(["body_parent_f"])
    for _ in range(steps):
        solver.step(*states, model.control(), None, 1e-5, observables=seen)
    return seen.body_parent_f.numpy()[-1]


def evaluated(formula: str, felt: Any) -> Any:
    """As on the page."""
    names = {"f": felt[:3], "t": felt[3:], "R": ROTATION, "c": CENTER, "cross": np.cross}
    text = re.sub("c \u00d7 (Rᵀf|f)", r"cross(c, \1)", formula)
    return eval(re.sub(r"Rᵀ(\w)", r"(R.T @ \1)", text), names)


@pytest.mark.long
@pytest.mark.timeout(900)  # Newton compiles its kernels
@pytest.mark.filterwarnings("ignore:set_const_")  # Newton's
@pytest.mark.parametrize(("name", "force", "torque"), ROWS, ids=[name for name, *_ in ROWS])
def test_the_page_turns_what_a_simulator_gives_into_the_load_on_the_sensor(
    name: str, force: str, torque: str, tmp_path: Path
) -> None:
    assert len(ROWS) == 5
    give = globals()[f"from_{name.lower()}"]
    assert give(0, tmp_path / "arm.urdf").any() == (name in ("Drake", "Pinocchio")), "before the first step"
    felt, weight = give(1, tmp_path / "arm.urdf"), ROTATION.T @ DOWN * MASS
    np.testing.assert_allclose(evaluated(force, felt), weight, atol=1e-3)
    np.testing.assert_allclose(evaluated(torque, felt), np.cross(CENTER, weight), atol=1e-4)
