"""The node: what is wired to what, and in which order it is taken apart.

`run` is the program. `BridgeNode.create` and `spin` are what it does once ROS is up: with them the tests run
several nodes in one process.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Final, Self

import rclpy
from diagnostic_msgs.msg import KeyValue
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.exceptions import InvalidTopicNameException, ParameterException
from rclpy.node import Node
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from bota_ethercat.client.channel import Channel
from bridge.compensating.control import CompensationControl
from bridge.diagnostics import Monitor
from bridge.parameters.declare import LiveParameters, SettingsParameters, declare, warn_of_others
from bridge.parameters.table import ParameterError, Parameters
from bridge.process import Worker, call_on_stop_signal, prepare
from bridge.publishing.compensated_wrench import CompensatedOutput
from bridge.publishing.messages import Stamps, make_measured
from bridge.services import BiasServices, IdentifyServices, SensorServices
from bridge.spinning import PartExecutor, Spinner
from bridge.stream.link import SYSTEM_CLOCK, Clock, RequestFailedError, RequestRefusedError
from bridge.stream.reader import Outputs, Reader

SUPERVISOR_KEY, SUPERVISOR_STOP = "ft_sensors", "1"
SERVER_GOES_ON: Final = 3  # exit code: the supervisor stopped the node, but the server refused to shut down


class StartError(Exception):
    """The node cannot start with these parameters; the text is one sentence."""


class BridgeNode(Node):  # type: ignore[misc]  # rclpy has no types
    """The node `bridge`. What ends it sets `exit_code` and calls `on_finish`."""

    clock: Clock = SYSTEM_CLOCK
    channel: Channel | None = None  # tests have a clock and a channel of their own

    def __init__(self, arguments: Sequence[str] | None = None) -> None:
        """ParameterError or InvalidTopicNameException if a parameter is wrong.

        `arguments` (`--ros-args ...`) are for this node alone; None: those of the process.
        """
        super().__init__("bridge", cli_args=arguments, use_global_arguments=arguments is None)
        self.exit_code: int | None = None
        self.on_finish: Callable[[], None] = lambda: None
        self.parameters = parameters = declare(self)
        self.stamps = stamps = Stamps(self.get_logger())
        compensated = CompensatedOutput(self, parameters, stamps, lambda: self.reader.link.info.rate_hz)
        wrench, *others = make_measured(self, parameters, stamps)
        self.outputs = Outputs([wrench, compensated, *others])  # what control loops take goes first
        self.reader = Reader(
            parameters, self.outputs, self.get_logger(), self.fail, channel=self.channel, clock=self.clock
        )
        link = self.reader.link
        # rclpy asks the newest first whether parameters may be set: these ask the sensor, so they come last.
        self.sensor_settings = SettingsParameters(self, link)
        live = LiveParameters(self)
        self.compensation = CompensationControl(self, parameters, compensated, self.reader, live)
        live.apply = self._apply
        self.monitor = Monitor(
            self, parameters.limits, self.reader, self.compensation.state, self.outputs, stamps, self.fail
        )
        SensorServices(self, link, self.sensor_settings)
        BiasServices(self, self.compensation)
        IdentifyServices(self, self.compensation)
        warn_of_others(self)
        link.on_change = self._on_link_change
        if parameters.supervisor_topic:
            self.create_subscription(
                KeyValue,
                parameters.supervisor_topic,
                self._on_supervisor,
                10,
                callback_group=MutuallyExclusiveCallbackGroup(),  # received while a service waits
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )

    @classmethod
    def create(cls, arguments: Sequence[str] | None = None) -> Self:
        """A node that is ready to `spin`; StartError."""
        try:
            node = cls(arguments)
            node.compensation.start()
        except (ParameterError, InvalidTopicNameException, ParameterException) as error:
            raise StartError(" ".join(str(error).split())) from None
        except RuntimeError as error:  # rclpy says no more, and not of what
            raise StartError(
                f"ROS cannot create the node's topics and services ({' '.join(str(error).split())}): check "
                "qos_overrides, and that array_topic and the remappings give no two topics one name"
            ) from None
        return node

    def _apply(self, parameters: Parameters) -> None:
        self.stamps.update(parameters.stamp, self.reader.link)
        self.compensation.apply(parameters)
        self.monitor.limits = parameters.limits
        self.reader.limit_rate(parameters.publishing_frequency)
        for output in self.outputs.all:
            output.configure(parameters)

    def _on_link_change(self) -> None:
        self.stamps.update(self.compensation.parameters.stamp, self.reader.link)
        self.compensation.link_changed()
        self.sensor_settings.changed()

    def finish(self, exit_code: int) -> None:
        """End the node, from any thread; the first call counts."""
        if self.exit_code is None:
            self.exit_code = exit_code
        self.on_finish()
        self.reader.link.cancel()

    def fail(self, reason: str) -> None:
        """End the node with exit code 1, from any thread."""
        self.get_logger().error(reason)
        self.finish(1)

    def _on_supervisor(self, message: KeyValue) -> None:
        if message.key != SUPERVISOR_KEY or message.value != SUPERVISOR_STOP or self.exit_code is not None:
            return
        self.get_logger().info("the supervisor stops the force/torque sensors")
        try:
            self.get_logger().info(self.reader.link.shut_server_down())
        except RequestRefusedError as error:
            self.get_logger().error(str(error))
            self.finish(SERVER_GOES_ON)
        except RequestFailedError as error:
            self.get_logger().warning(str(error))
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
        text = " ".join(str(error).split())
        if "logging directory" in text:
            text += "; set HOME, or ROS_LOG_DIR to a directory for its log"
        return _refuse(f"ROS cannot start: {text}", 2 if wrong_arguments else 1)
    try:
        node = BridgeNode.create()
        call_on_stop_signal(lambda _signal: node.finish(0))
        given = node.parameters.rt_priority, node.parameters.cpu
        return spin(node, lambda: prepare(*given, node.get_logger()))
    except StartError as error:
        return _refuse(str(error), 2)
    finally:
        rclpy.try_shutdown()


def spin(node: BridgeNode, on_started: Callable[[], object] = lambda: None) -> int:
    """Run the node until it is told to finish, and destroy it; returns its exit code.

    `on_started` is called once its threads run.
    """
    prompt = PartExecutor(node)
    executor = PartExecutor(node, prompt)
    spinner, prompt_spinner = Spinner(executor), Spinner(prompt)
    node.on_finish = spinner.stop
    listener = Worker("listener", prompt_spinner.run, node.fail)
    listener.start()
    node.reader.thread.start()
    node.monitor.thread.start()
    try:
        on_started()
        if node.exit_code is not None:  # a signal came before there was a spinner
            spinner.stop()
        spinner.run()
        return node.exit_code or 0
    finally:
        prompt_spinner.stop()
        if not (listener.has_ended() & node.monitor.stop() & node.reader.stop()):
            node.get_logger().error("a thread did not end in time")
        else:
            prompt.shutdown()
        node.compensation.choice.close()
        executor.shutdown()
        node.destroy_node()


def _refuse(text: str, exit_code: int) -> int:
    sys.stderr.write(f"bridge-client: {text}\n")
    return exit_code
