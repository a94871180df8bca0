"""The node: what is wired to what, and in which order it is taken apart."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import rclpy
from diagnostic_msgs.msg import KeyValue
from rclpy.exceptions import InvalidTopicNameException, ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from bridge.bias_services import BiasServices
from bridge.compensated_output import CompensatedOutput
from bridge.compensation_control import CompensationControl
from bridge.identify_services import IdentifyServices
from bridge.messages import make
from bridge.monitor import Monitor
from bridge.parameters import ParameterError, declare
from bridge.reader import Reader
from bridge.requests import Requests
from bridge.services import Services
from bridge.settings_parameters import SettingsParameters
from bridge.signals import call_on_stop_signal
from bridge.spinning import Spinner

SUPERVISOR_TOPIC = "/supervisor_status_data"
SUPERVISOR_KEY, SUPERVISOR_STOP = "ft_sensors", "1"


class BridgeNode(Node):  # type: ignore[misc]  # rclpy has no types
    """The node `bridge`. What ends it sets `exit_code` and calls `on_finish`."""

    def __init__(self) -> None:
        """ParameterError or InvalidTopicNameException if a parameter is wrong."""
        super().__init__("bridge")
        self.exit_code: int | None = None
        self.on_finish: Callable[[], None] = lambda: None
        parameters = declare(self)
        compensated = CompensatedOutput(self, parameters.frame_id)
        outputs = make(self, parameters, compensated)
        self.reader = Reader(parameters, outputs, self.get_logger(), self._fail)
        link = self.reader.link
        # rclpy asks the newest first whether parameters may be set: these ask the sensor, so they come last.
        self.requests = Requests(parameters, link)
        self.sensor_settings = SettingsParameters(self, link, self.requests)
        self.compensation = CompensationControl(
            self, parameters, compensated, link, lambda: self.reader.not_finite, self._fail
        )
        self.monitor = Monitor(
            self, parameters.thresholds, self.reader, self.compensation.state, outputs, self._fail
        )
        self.triggers = (
            Services(self, link, self.requests, self.sensor_settings, self.compensation.after_sensor_tare),
            BiasServices(self, self.compensation),
            IdentifyServices(self, self.compensation),
        )
        link.on_change = self._on_link_change
        self.create_subscription(
            KeyValue,
            SUPERVISOR_TOPIC,
            self._on_supervisor,
            10,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def _on_link_change(self) -> None:
        self.compensation.link_changed()
        self.sensor_settings.changed()

    def finish(self, exit_code: int) -> None:
        """End the node, from any thread; the first call counts."""
        if self.exit_code is None:
            self.exit_code = exit_code
        self.on_finish()
        self.requests.cancel()
        self.compensation.cancel()

    def _fail(self, reason: str) -> None:
        self.get_logger().error(reason)
        self.finish(1)

    def _on_supervisor(self, message: KeyValue) -> None:
        if message.key != SUPERVISOR_KEY or message.value != SUPERVISOR_STOP or self.exit_code is not None:
            return
        self.get_logger().info("the supervisor stops the force/torque sensors")
        self.get_logger().info(self.requests.shut_server_down())
        self.finish(0)


def run(arguments: Sequence[str]) -> int:
    """Run the node with these command-line arguments until it ends; returns the exit code."""
    try:
        unknown = remove_ros_args(["bridge-client", *arguments])[1:]
        if unknown:
            return _refuse(f"unknown argument {unknown[0]!r}: see --help", 2)
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # noqa: BLE001 - rclpy raises several unrelated ones, most about arguments
        # rclpy has no public names for these.
        wrong_arguments = type(error).__name__ in {"RCLInvalidROSArgsError", "UnknownROSArgsError"}
        return _refuse(f"ROS cannot start: {' '.join(str(error).split())}", 2 if wrong_arguments else 1)
    try:
        try:
            node = BridgeNode()
            node.compensation.start()
        except (ParameterError, InvalidTopicNameException, ParameterException) as error:
            return _refuse(" ".join(str(error).split()), 2)
        except RuntimeError as error:  # rclpy says no more, and not of what
            return _refuse(
                f"ROS cannot make the node's topics and services ({' '.join(str(error).split())}): check "
                "qos_overrides, and that array_topic and the remappings give no two topics one name",
                2,
            )
        return _spin(node)
    finally:
        rclpy.try_shutdown()


def _spin(node: BridgeNode) -> int:
    call_on_stop_signal(lambda _signal: node.finish(0))
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinner = Spinner(executor)
    node.on_finish = spinner.stop
    node.reader.start()
    node.monitor.start()
    try:
        if node.exit_code is not None:  # it was told before there was a spinner
            spinner.stop()
        spinner.run()
        return node.exit_code or 0
    finally:
        stopped = node.monitor.stop() & node.reader.stop() & node.compensation.close()
        if not stopped:
            node.get_logger().error("a thread did not end in time")
        executor.shutdown()
        node.destroy_node()


def _refuse(text: str, exit_code: int) -> int:
    sys.stderr.write(f"bridge-client: {text}\n")
    return exit_code
