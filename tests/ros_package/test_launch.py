"""The launch files: without ROS by a stand-in; and run by `ros2 launch` where it is installed."""

from __future__ import annotations

import contextlib
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.ros_package.package_files import ALIAS, PACKAGE, PACKAGES, ROOT, commands
from tests.server.running import free_port, needs_bus

PATIENCE_S = 30.0
SERVER_COMMAND = f"server_command:={sys.executable} -m ethercat_server.daemon.cli"
CLIENT = f"""#!{sys.executable}
import sys
sys.path[:0] = ["{ROOT / "protocol"}", "{PACKAGE}"]
from bota_ethercat_bridge.client import main
sys.exit(main())
"""
LAUNCH = PACKAGE / "launch"
NODE = {
    "params_file", "namespace", "server_host", "server_port", "sensor", "frame_id", "imu_frame_id",
    "array_topic", "lifecycle", "realtime", "respawn", "log_level", "compat",
}  # fmt: skip
SERVER = {"server_port", "server_command", "sensor_options"}
# Of each file, with those of what it includes.
ARGUMENTS = {
    "bridge": NODE,
    "virtual_server": SERVER,
    "demo": NODE | SERVER,
    "two_sensors": NODE | SERVER | {"virtual", "first_name", "second_name"},
}


class StandIn:
    def __init__(self, *given: Any, **named: Any) -> None:
        self.given_to_it, self.named = given, named

    def get_sub_entities(self) -> list[Any]:
        return []


class LaunchDescription(StandIn):
    @property
    def entities(self) -> list[Any]:
        return list(self.given_to_it[0])

    def get_sub_entities(self) -> list[Any]:
        return self.entities


class DeclareLaunchArgument(StandIn):
    @property
    def name(self) -> str:
        return str(self.given_to_it[0])


class IncludeLaunchDescription(StandIn):
    def get_sub_entities(self) -> list[Any]:
        return [runpy.run_path(self.given_to_it[0])["generate_launch_description"]()]


class GroupAction(StandIn):
    def get_sub_entities(self) -> list[Any]:
        return list(self.given_to_it[0])


class PushRosNamespace(StandIn):
    pass


class LaunchConfiguration(StandIn):
    def perform(self, context: dict[str, str]) -> str:
        return context.get(self.given_to_it[0], "")


class Module(types.ModuleType):
    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name == "get_package_share_path":
            return PACKAGES.get
        ours = (
            LaunchDescription, DeclareLaunchArgument, IncludeLaunchDescription, GroupAction,
            PushRosNamespace, LaunchConfiguration,
        )  # fmt: skip
        return next((own for own in ours if own.__name__ == name), StandIn)


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Launch files can be run, to list their arguments and to call their functions; nothing is started."""
    within = "actions", "conditions", "event_handlers", "logging", "substitutions"
    of_ros = "actions", "parameter_descriptions", "substitutions"
    names = ["ament_index_python.packages", "launch", "launch_ros", *(f"launch.{name}" for name in within)]
    for name in (*names, *(f"launch_ros.{name}" for name in of_ros)):
        monkeypatch.setitem(sys.modules, name, Module(name))


@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize("package", [PACKAGE, ALIAS], ids=["bota_ethercat_bridge", "bridge"])
@pytest.mark.parametrize("name", ARGUMENTS)
def test_it_offers_its_arguments_under_both_names_of_the_package(name: str, package: Path) -> None:
    listed: list[str] = []

    def walk(entity: Any) -> None:
        for inner in entity.get_sub_entities():
            if isinstance(inner, DeclareLaunchArgument):
                listed.append(inner.name)
            walk(inner)

    walk(runpy.run_path(str(package / f"launch/{name}.launch.py"))["generate_launch_description"]())
    assert set(listed) == ARGUMENTS[name]


def configurations(value: Any) -> set[str]:
    """The names of all arguments that a value is made of."""
    if isinstance(value, LaunchConfiguration):
        return {value.given_to_it[0]}
    if isinstance(value, StandIn):
        value = value.given_to_it
    return set().union(*map(configurations, value)) if isinstance(value, list | tuple) else set()


@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize("name", ARGUMENTS)
def test_what_it_offers_has_an_effect(name: str) -> None:
    """An argument that it gives to a file that it includes is made of the argument of that name."""
    ignored: list[str] = []

    def walk(entity: Any) -> None:
        entities = entity.get_sub_entities()
        pushed = {"namespace"} & configurations([e for e in entities if isinstance(e, PushRosNamespace)])
        for inner in entities:
            for given, value in dict(inner.named.get("launch_arguments", ())).items():
                if given not in configurations(value) | pushed:
                    ignored.append(given)
            walk(inner)

    walk(runpy.run_path(str(LAUNCH / f"{name}.launch.py"))["generate_launch_description"]())
    assert not ignored


@pytest.mark.usefixtures("stand_in")
def test_a_parameter_file_is_found_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start_node = runpy.run_path(str(LAUNCH / "bridge.launch.py"))["start_node"]
    # launch_ros would start the node with its defaults: with the wrong sensor, say.
    with pytest.raises(FileNotFoundError, match=r"params_file: there is no file /.*/nofile\.yaml"):
        start_node({"params_file": "nofile.yaml"})
    # The shell leaves the ~ of `params_file:=~/robot.yaml` as it is.
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "robot.yaml").touch()
    (node,) = start_node({"params_file": "~/robot.yaml"})
    assert node.named["parameters"] == [tmp_path / "robot.yaml"]
    assert not node.named["additional_env"]
    (node,) = start_node({"params_file": "~/robot.yaml", "realtime": "true"})
    assert node.named["parameters"][1] == {"rt_priority": 40}
    profiles = [Path(file) for file in node.named["additional_env"].values()]
    assert [file.name for file in profiles if file.is_file()] == ["fastdds.xml", "fastdds3.xml"]
    monkeypatch.setenv("FASTDDS_DEFAULT_PROFILES_FILE", "of the user")
    (node,) = start_node({"params_file": "~/robot.yaml", "realtime": "true"})
    assert not node.named["additional_env"]
    (node,) = start_node({"params_file": "~/robot.yaml", "compat": "bota"})  # what that is: tests/bridge
    assert (node.named["name"], len(node.named["parameters"])) == ("bota_ft_sensor", 2)


@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize(
    ("code", "is_shutdown", "fails"), [(0, False, False), (1, False, True), (-2, True, False)]
)
def test_a_launch_whose_server_fails_fails_unless_it_was_stopped(
    code: int, is_shutdown: bool, fails: bool
) -> None:
    """Launch has exit code 1 for an exception, and no other way."""
    end = runpy.run_path(str(LAUNCH / "virtual_server.launch.py"))["end"]
    event = types.SimpleNamespace(process_name="ethercat-server-2", returncode=code)
    said = rf"^ethercat-server-2 has ended with exit code {code}: see its message above$"
    with pytest.raises(RuntimeError, match=said) if fails else contextlib.nullcontext():
        end(event, types.SimpleNamespace(is_shutdown=is_shutdown))


# Run by `ros2 launch`.


class Launched:
    def __init__(self, environment: dict[str, str], file: str, *arguments: str) -> None:
        self.environment = environment
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115
        self.process = subprocess.Popen(
            ["ros2", "launch", str(PACKAGE / "launch" / file), *arguments],
            env=environment,
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    @property
    def log(self) -> str:
        self._log.seek(0)
        return self._log.read()

    def says(self, *words: str, times: int = 1) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not all(len(re.findall(word, self.log)) >= times for word in words):
            assert time.monotonic() < deadline, f"waited in vain for {words} in:\n{self.log}"
            time.sleep(0.05)

    def stop(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(PATIENCE_S)

    def close(self) -> None:
        # Not SIGTERM: at that, `ros2 launch` leaves its processes behind.
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(PATIENCE_S)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self._log.close()


Launch = Callable[..., Launched]


@pytest.fixture
def launch(tmp_path: Path) -> Iterator[Launch]:
    """Gives a function that runs a launch file, with this checkout as the package."""
    pytest.importorskip("launch_ros", reason="launch_ros is missing: source ROS 2")
    pytest.importorskip("rclpy", reason="rclpy is missing: source ROS 2")
    if shutil.which("ros2") is None:
        pytest.skip("ros2 launch is missing: source ROS 2")
    (tmp_path / "share/ament_index/resource_index/packages").mkdir(parents=True)
    (tmp_path / "share/ament_index/resource_index/packages/bota_ethercat_bridge").touch()
    (tmp_path / "share/bota_ethercat_bridge").symlink_to(PACKAGE)
    (tmp_path / "lib/bota_ethercat_bridge").mkdir(parents=True)
    client = tmp_path / "lib/bota_ethercat_bridge/client"
    client.write_text(CLIENT)
    client.chmod(0o755)
    environment = os.environ | {
        "AMENT_PREFIX_PATH": f"{tmp_path}:{os.environ.get('AMENT_PREFIX_PATH', '')}",
        "ROS_LOG_DIR": str(tmp_path),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "PYTHONUNBUFFERED": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    running: list[Launched] = []

    def start(file: str, *arguments: str) -> Launched:
        running.append(Launched(environment, file, *arguments))
        return running[-1]

    yield start
    for launched in running:
        launched.close()


@pytest.mark.ros
def test_what_is_given_wins_over_the_file_and_the_rest_stays(launch: Launch, tmp_path: Path) -> None:
    file_port, given_port = free_port(), free_port()
    file = tmp_path / "parameters.yaml"
    file.write_text(f"bridge:\n  ros__parameters: {{server_host: 127.0.0.1, server_port: {file_port}}}\n")
    as_in_file = launch("bridge.launch.py", f"params_file:={file}")
    given = launch("bridge.launch.py", f"params_file:={file}", f"server_port:={given_port}")
    as_in_file.says(f"no server at 127.0.0.1:{file_port}")
    given.says(f"no server at 127.0.0.1:{given_port}")
    for launched in (as_in_file, given):
        assert launched.stop() == 0
        assert "process has finished cleanly" in launched.log


@pytest.mark.ros
def test_namespace_log_level_respawn_and_text_that_looks_like_a_number(launch: Launch) -> None:
    launched = launch(
        "bridge.launch.py", "namespace:=left", "server_host:=127", f"server_port:={free_port()}"
    )
    launched.says(r"\[left.bridge\]: no server at 127:")
    quiet = launch("bridge.launch.py", "log_level:=error", "server_port:=70000", "respawn:=true")
    quiet.says("parameter server_port is 70000", "--log-level error", times=2)
    launch("bridge.launch.py", "realtime:=yes").says('"realtime" provided value "yes" is not valid')


@pytest.mark.ros
def test_two_sensors_are_in_a_robots_namespace(launch: Launch) -> None:
    launched = launch("two_sensors.launch.py", "namespace:=left", f"server_port:={free_port()}")
    launched.says(r"\[left.sensone.bridge\]: no server", r"\[left.rokubi.bridge\]: no server")


@pytest.mark.ros
def test_two_sensors_have_names_and_frames_of_ones_own(launch: Launch) -> None:
    names = "namespace:=/cell/arm", "first_name:=wrist", "second_name:=foot", f"server_port:={free_port()}"
    launched = launch("two_sensors.launch.py", *names)
    launched.says(r"\[cell.arm.wrist.bridge\]: no server", r"\[cell.arm.foot.bridge\]: no server")
    # A node says what frame it was given only if it is none.
    refused = launch("two_sensors.launch.py", *names, "frame_id:=/arm/link/ft")
    refused.says(
        *(f"parameter frame_id is '/arm/link/{name}_ft': frames have no" for name in ("wrist", "foot"))
    )
    refused = launch("two_sensors.launch.py", *names, "imu_frame_id:=/imu")
    refused.says("imu_frame_id is '/wrist_imu'", "imu_frame_id is '/foot_imu'")


@pytest.mark.ros
def test_a_server_that_is_not_there_ends_the_demo_with_a_sentence(launch: Launch) -> None:
    launched = launch("demo.launch.py", "server_command:=/no/such/server")
    assert launched.process.wait(PATIENCE_S) == 1
    assert "'/no/such/server' is no program: give server_command:=" in launched.log
    assert "[client-1]: process started" not in launched.log or "[client-1]: process has" in launched.log


@pytest.mark.ros
@pytest.mark.bus
@needs_bus
def test_the_demo_runs_with_the_commands_of_the_page_and_ends_cleanly(launch: Launch) -> None:
    port = free_port()
    launched = launch("demo.launch.py", f"server_port:={port}", SERVER_COMMAND)
    launched.says(f"connected to localhost:{port}: sensor 0 .BFT-SENS-ECAT-M8", "streaming")
    try:
        for command in commands("ros2.md"):
            # A node, not a managed one, runs already; interfaces are not built.
            if not re.search("ros2 (run|launch) bridge|lifecycle|bota_ethercat_msgs", command):
                typed = ["bash", "-c", command.replace("NAME", "sensor")]
                done = subprocess.run(
                    typed, env=launched.environment, check=False, capture_output=True, text=True
                )
                assert done.returncode == 0, done.stderr
    finally:
        subprocess.run(["ros2", "daemon", "stop"], env=launched.environment, check=False, capture_output=True)
    assert launched.stop() == 0
    assert launched.log.count("process has finished cleanly") == 2, launched.log
    assert "has died" not in launched.log


@pytest.mark.ros
@pytest.mark.bus
@needs_bus
def test_the_end_of_the_server_ends_the_demo(launch: Launch) -> None:
    launched = launch("demo.launch.py", f"server_port:={free_port()}", SERVER_COMMAND)
    launched.says("connected to localhost")
    (pid,) = re.findall(r"\[ethercat-server-\d+\]: process started with pid \[(\d+)\]", launched.log)
    os.kill(int(pid), signal.SIGTERM)
    assert launched.process.wait(PATIENCE_S) == 0
    assert launched.log.count("process has finished cleanly") == 2, launched.log


@pytest.mark.ros
@pytest.mark.bus
@needs_bus
def test_two_sensors_have_a_node_and_a_namespace_each(launch: Launch) -> None:
    launched = launch("two_sensors.launch.py", "virtual:=true", f"server_port:={free_port()}", SERVER_COMMAND)
    launched.says("streaming")
    for namespace, sensor in (("sensone", r"0 \(BFT-SENS-"), ("rokubi", r"1 \(BFT-ROKS-")):
        launched.says(rf"\[{namespace}\.bridge\]: connected to \S+ sensor {sensor}")
    assert launched.stop() == 0
    assert launched.log.count("process has finished cleanly") == 3, launched.log
