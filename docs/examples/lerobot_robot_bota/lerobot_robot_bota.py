r"""A LeRobot robot that adds the newest compensated wrench to the observation of another robot.

pip install '.[dataset]' ./docs/examples/lerobot_robot_bota 'lerobot[core-scripts]'
lerobot-record --robot.type=bota --robot.tool=tool.yaml \
    --robot.arm='{type: so101_follower, port: /dev/ttyACM0}' --teleop.type=so101_leader ...
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import draccus
from lerobot.robots import Robot, RobotConfig, make_robot_from_config

from bota_clients.export.live import LiveWindows
from bota_ethercat.client import Client, connect

WRENCH: Final = tuple(f"wrench.{part}.{axis}" for part in ("force", "torque") for axis in "xyz")
VALID: Final = "wrench.valid"
_SLOTS: Final = 64  # periods of the sensor: its filters' delay, 2 to 30 ms, and how old a wrench may be


@RobotConfig.register_subclass("bota")
@dataclass(kw_only=True)
class BotaConfig(RobotConfig):
    """`arm`: another robot's configuration, with its `type`; `tool`: a file of `ethercat-identify --yaml`;
    the others: where the sensor is.
    """

    arm: dict[str, Any]  # a RobotConfig in one of its own is a recursion without end for draccus
    tool: Path
    host: str = "localhost"
    port: int = 12001
    sensor: int = 0


class Bota(Robot):
    """`wrench.force.x` ... (N), `wrench.torque.x` ... (Nm): in the sensor's frame, without bias, weight and
    inertia of the tool. `wrench.valid`: 1, or 0 while there is none; the wrench is 0 then, for NaN would
    spoil all statistics. The clocks of this computer and of the server's must be synchronized.
    """

    config_class = BotaConfig
    name = "bota"

    def __init__(self, config: BotaConfig) -> None:
        super().__init__(config)
        self._config = config
        self._arm: Any = make_robot_from_config(draccus.decode(RobotConfig, config.arm))
        self._client: Client | None = None
        self._windows: Any = None
        self._taking, self._closing = threading.Lock(), threading.Event()

    @property
    def cameras(self) -> dict[str, Any]:
        """Those of the arm: LeRobot counts them."""
        return getattr(self._arm, "cameras", {})

    @property
    def observation_features(self) -> dict[str, Any]:
        return {**self._arm.observation_features, **dict.fromkeys((*WRENCH, VALID), float)}

    @property
    def action_features(self) -> dict[str, Any]:
        return self._arm.action_features

    @property
    def is_connected(self) -> bool:
        return self._client is not None and self._arm.is_connected

    def connect(self, calibrate: bool = True) -> None:
        """UnreachableError, RecordingError of the tool's file: the arm is not touched then."""
        config = self._config
        client = connect(config.port, config.host, sensors=[config.sensor])
        try:
            self._windows = LiveWindows(client, _SLOTS, sensor=config.sensor, tool=config.tool)
            self._arm.connect(calibrate)
        except BaseException:
            client.close()
            raise
        self._client = client
        self._closing.clear()
        threading.Thread(target=self._keep_taking, daemon=True).start()

    def _keep_taking(self) -> None:
        """While LeRobot writes an episode, too: who reads nothing for 10 s is disconnected."""
        while not self._closing.wait(0.2):
            with self._taking:
                if not self._closing.is_set():
                    self._windows.at(timeout_s=0.0)

    def get_observation(self) -> dict[str, Any]:
        """Of the arm, then the wrench, which is newer by what the arm's cameras took."""
        observation = self._arm.get_observation()
        with self._taking:
            seen = self._windows.at(time.time_ns(), timeout_s=0.0)
        valid = seen["force_torque_compensated_valid"].nonzero()[0]
        newest = seen["force_torque_compensated"][valid[-1]].tolist() if len(valid) else [0.0] * 6
        return {**observation, **dict(zip(WRENCH, newest, strict=True)), VALID: float(len(valid) > 0)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return self._arm.send_action(action)

    def disconnect(self) -> None:
        self._closing.set()
        client, self._client = self._client, None
        if client is not None:
            with self._taking:
                client.close()
        self._arm.disconnect()

    @property
    def is_calibrated(self) -> bool:
        return self._arm.is_calibrated

    def calibrate(self) -> None:
        self._arm.calibrate()

    def configure(self) -> None:
        self._arm.configure()
