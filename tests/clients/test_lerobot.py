"""docs/examples/lerobot_robot_bota as LeRobot finds it: `lerobot-record` with a simulated arm and sensor."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ft_compensation.identification.parameter_file import write_payload
from bota_ft_compensation.quantities import Payload
from ethercat_server.virtual_sensor.signals import CONSTANT
from tests.server.running import needs_bus, server

PLUGIN = Path(__file__).parents[2] / "docs" / "examples" / "lerobot_robot_bota"
MASS, END = 0.5, 10
ARM = """
import socket
from dataclasses import dataclass
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

class Simulated:
    name, is_connected, is_calibrated, joint = "simulated", False, True, -1.0
    action_features = observation_features = {"joint": float}
    feedback_features = {}
    def connect(self, calibrate=True): self.is_connected = True
    def disconnect(self): self.is_connected = False
    def calibrate(self): ...
    configure = send_feedback = calibrate
    def get_observation(self): return {"joint": self.joint}
    def get_action(self): self.joint += 1.0; return self.get_observation()
    def send_action(self, action):
        self.joint = action["joint"]
        if self.joint == END:
            with socket.create_connection(("localhost", PORT)) as server:
                server.sendall(b'{"action": "shutdown"}')
                server.recv(4096)
        return action

@RobotConfig.register_subclass("simulated")
@dataclass
class SimulatedRobotConfig(RobotConfig): ...
class SimulatedRobot(Simulated, Robot): config_class = RobotConfig
@TeleoperatorConfig.register_subclass("simulated")
@dataclass
class SimulatedHandConfig(TeleoperatorConfig): ...
class SimulatedHand(Simulated, Teleoperator): config_class = TeleoperatorConfig
"""


@needs_bus
@pytest.mark.bus
@pytest.mark.timeout(300)
def test_a_data_set_has_the_compensated_wrench_and_where_it_is_valid(tmp_path: Path) -> None:
    pytest.importorskip("lerobot")
    parquet = pytest.importorskip("pyarrow.parquet")
    site, data, tool = tmp_path / "site", tmp_path / "data", tmp_path / "tool.yaml"
    source = shutil.copytree(PLUGIN, tmp_path / "source")
    install = ("pip", "install", "--no-deps", "--no-build-isolation", "--no-index", "--target", site, source)
    subprocess.run([sys.executable, "-m", *install], check=True)
    metadata = site / "lerobot_robot_simulated-1.dist-info" / "METADATA"
    metadata.parent.mkdir()
    metadata.write_text("Metadata-Version: 2.1\nName: lerobot_robot_simulated\nVersion: 1\n")
    write_payload(tool, Payload(MASS, (0.0, 0.0, 0.05)), "", ())
    with server("virtual", "--virtual=--signal constant") as running:
        (site / "lerobot_robot_simulated.py").write_text(f"END, PORT = {END}, {running.port}\n{ARM}")
        options = (
            f'robot.type=bota robot.tool={tool} robot.port={running.port} robot.arm={{"type":"simulated"}} '
            f"teleop.type=simulated dataset.repo_id=me/run dataset.root={data} dataset.single_task=press "
            "dataset.fps=10 dataset.num_episodes=1 dataset.episode_time_s=3 dataset.push_to_hub=false "
            "play_sounds=false"
        ).split()
        paths = {"PYTHONPATH": os.pathsep.join([str(site), *sys.path]), "HF_HOME": str(tmp_path / "home")}
        record = [sys.executable, "-m", "lerobot.scripts.lerobot_record", *(f"--{each}" for each in options)]
        subprocess.run(record, env={**os.environ, **paths, "HF_HUB_OFFLINE": "1"}, check=True)
    states = np.stack(parquet.read_table(data / "data")["observation.state"].to_numpy())
    joints, wrenches, valid = states[:, 0], states[:, 1:7], states[:, 7] == 1
    assert joints.tolist() == [-1, *range(len(states) - 1)]
    wrench = np.add(CONSTANT, (0, 0, MASS * STANDARD_GRAVITY, 0, 0, 0))
    np.testing.assert_allclose(wrenches[valid], np.broadcast_to(wrench, wrenches[valid].shape), atol=0.02)
    assert valid[:END].sum() > END / 2
    assert not valid[joints > END + 2].any(), "the server has ended"
    assert not states[~valid, 1:].any()
