"""The node on one computer and a subscriber on another, as docs/ros2-network.md has it: without multicast.

Real processes in two network namespaces: who finds whom is for the middleware alone.
"""

from __future__ import annotations

import fcntl
import shutil
import subprocess
import sys
from collections.abc import Iterator

import pytest

from ethercat_server.virtual_sensor.options import SensorOptions
from tests.bridge.real_node import PATIENCE_S
from tests.served_simulation import served
from tests.server.running import HERE, Program, Veth, another_machine, free_port, on_a_bus, steady_addresses
from tests.simulation import more_if_long

# Shared memory does not know network namespaces: another computer has its own.
ALONE = ["unshare", "--mount", "sh", "-c", 'mount -t tmpfs tmpfs /dev/shm && exec "$@"', "sh"]
ENVIRONMENT = ["env", "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"]
ASK = """
import os, rclpy
from geometry_msgs.msg import WrenchStamped
from std_srvs.srv import Trigger
rclpy.init()
node, got = rclpy.create_node("desk"), []
node.create_subscription(WrenchStamped, "/robot/wrench", got.append, 10)
while not got:
    rclpy.spin_once(node, timeout_sec=0.1)
tare = node.create_client(Trigger, "/robot/bridge/tare")
assert tare.wait_for_service(30.0)
answer = tare.call_async(Trigger.Request())
while not answer.done():
    rclpy.spin_once(node, timeout_sec=0.1)
print(got[0].header.frame_id, answer.result().message, flush=True)
os._exit(0)
"""


@pytest.fixture
def there() -> Iterator[list[str]]:
    with steady_addresses(fcntl.LOCK_EX), Veth() as veth:
        veth.ip("address", "add", f"{HERE}/30", "dev", veth.near)
        with another_machine(veth) as command:
            yield command


@pytest.mark.skipif(not shutil.which("fast-discovery-server"), reason="no Fast DDS discovery server here")
@on_a_bus
@pytest.mark.parametrize("how", more_if_long(["discovery server"], ["discovery server", "static peer"]))
def test_topics_and_services_cross_the_network_without_multicast(there: list[str], how: str) -> None:
    port = free_port()
    servers = [f"ROS_DISCOVERY_SERVER={HERE}:{port}"]
    by_server = how == "discovery server"
    finding = subprocess.Popen(["fast-discovery-server", "-i", "0", "-l", HERE, "-p", str(port)])
    with served(SensorOptions(signal="rest"), sinc_length=512) as server:
        options = f"--ros-args -r __ns:=/robot -p server_port:={server.port} -p rest.duration:=0.3"
        node = Program(
            "bota_ethercat_bridge.client", options.split(), under=[*ENVIRONMENT, *servers * by_server]
        )
        try:
            asked = [*ENVIRONMENT, *(servers if by_server else [f"ROS_STATIC_PEERS={HERE}"])]
            command = [*there, *ALONE, *asked, sys.executable, "-c", ASK]
            told = subprocess.run(command, check=False, capture_output=True, text=True, timeout=PATIENCE_S)
            assert told.stdout.startswith("ft_sensor bias of"), (told, node.said())
        finally:
            node.close()
            finding.kill()
            finding.wait()
