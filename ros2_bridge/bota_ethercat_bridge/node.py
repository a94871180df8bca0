# SPDX-License-Identifier: Apache-2.0
"""The node: what is wired to what, and in which order it is taken apart.

`run` is the program. `BridgeNode.create` and `spin` are what it does once ROS is up: with them the tests run
several nodes in one process.
"""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, TypeVar

import rclpy
from diagnostic_msgs.msg import KeyValue
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.exceptions import InvalidTopicNameException, ParameterException
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from bota_ethercat.client.channel import TcpChannel
from bota_ethercat_bridge.compensating.compensation import Compensation
from bota_ethercat_bridge.compensating.control import CompensationControl
from bota_ethercat_bridge.diagnostics import DiagnosticsPublisher
from bota_ethercat_bridge.parameters.declare import NodeParameters, converted
from bota_ethercat_bridge.parameters.table import ParameterError, Parameters
from bota_ethercat_bridge.process import StopSignals, Worker, favor_stream, prepare, refuse
from bota_ethercat_bridge.publishing.messages import Stamps, TerminalTopics, make_measured
from bota_ethercat_bridge.rclpy_internals import (
    Spinner,
    is_about_arguments,
    make_executors,
    refuse_what_raises,
)
from bota_ethercat_bridge.services import create_services
from bota_ethercat_bridge.stream.link import SYSTEM_CLOCK, NodeClock, RequestFailedError, RequestRefusedError
from bota_ethercat_bridge.stream.reader import Outputs, Reader

SUPERVISOR_KEY, SUPERVISOR_STOP = "ft_sensors", "1"
_Node = TypeVar("_Node", bound="BridgeNode")  # typing.Self needs Python 3.11
# What a node has, and what destroys one.
_KINDS: Final = {
    "publishers": "destroy_publisher", "subscriptions": "destroy_subscription", "timers": "destroy_timer",
    "services": "destroy_service", "guards": "destroy_guard_condition",
}  # fmt: skip
SERVER_NOT_STOPPED: Final = 3  # exit code: the supervisor stopped the node, but the server refused


class StartError(Exception):
    """The node cannot start with these parameters; the text is one sentence."""


@contextlib.contextmanager
def _sentences() -> Iterator[None]:
    """StartError for what ROS and the parameters raise."""
    try:
        yield
    except (ParameterError, InvalidTopicNameException, ParameterException) as error:
        raise StartError(_text_of(error)) from None
    except RuntimeError as error:  # rclpy says no more, and not of what
        text, what = _text_of(error), "the node's topics and services"
        remedy = "qos_overrides, and that array_topic and the remappings give no two topics one name"
        if text.startswith("error creating node"):
            what, remedy = "the node", "the environment variables of ROS and of its middleware"
        raise StartError(f"ROS cannot create {what} ({text}): check {remedy}") from None


def _text_of(error: Exception) -> str:
    return re.sub(r", at /\S+:\d+", "", " ".join(str(error).split()))


def _transition(act: Callable[[Any], object]) -> Callable[[Any, LifecycleState], TransitionCallbackReturn]:
    """A transition of a managed node, by what it does while no other thread sets parameters."""

    def change(node: BridgeNode, _: LifecycleState) -> TransitionCallbackReturn:
        try:
            with node.setting, _sentences():
                act(node)
        except Exception as error:  # noqa: BLE001 - rclpy would answer the same, without a word
            text = str(error) if isinstance(error, StartError) else f"the transition failed: {error!r}"
            node.get_logger().error(text)
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    return change


class BridgeNode(LifecycleNodeMixin, Node):  # type: ignore[misc]  # rclpy has no types
    """The node `bridge`. What ends it sets `exit_code` and calls `on_finish`.

    With the parameter `lifecycle` it is a managed node, which its transitions configure and activate.
    """

    clock: NodeClock = SYSTEM_CLOCK
    channel: TcpChannel | None = None  # tests have a clock and a channel of their own
    is_open = False

    def __init__(self, arguments: Sequence[str] | None = None) -> None:
        """ParameterError or InvalidTopicNameException if a parameter is wrong.

        `arguments` (`--ros-args ...`) are for this node alone; None: those of the process.
        """
        self.setting = threading.RLock()
        Node.__init__(self, "bridge", cli_args=arguments, use_global_arguments=arguments is None)
        self.exit_code: int | None = None
        self.on_finish: Callable[[], None] = lambda: None
        self.live = NodeParameters(self)
        self.parameters = self.live.given
        if self.parameters.lifecycle:
            LifecycleNodeMixin.__init__(self)
        refuse_what_raises(self)
        self._kept = {entity for kind in _KINDS for entity in getattr(self, kind)}  # in every state
        if not self.parameters.lifecycle:
            self.configure()
            self.open()

    def configure(self) -> None:
        """Make parameters that are not live read-only."""
        self.live.is_fixed = True

    def open(self) -> None:
        """Make everything; nothing runs yet. Errors as at the start."""
        self.parameters = parameters = self.live.gather({})
        self.stamps = stamps = Stamps(self.get_logger())
        compensated = Compensation(self, parameters, stamps, lambda: self.reader.link.info, self.clock)
        wrench, *others = make_measured(self, parameters, stamps)
        self.outputs = Outputs([wrench, compensated, *others])  # control loops' topics first
        self.reader = Reader(
            parameters, self.outputs, self.get_logger(), self.fail, channel=self.channel, clock=self.clock
        )
        self.reader.on_terminal = TerminalTopics(self, parameters.terminals, self.reader.client).publish
        self.live.link = link = self.reader.link
        self.compensation = CompensationControl(self, parameters, compensated, self.reader, self.live)
        self.live.apply = self._apply
        self.monitor = DiagnosticsPublisher(
            self, parameters.limits, self.reader, self.compensation.state, self.outputs, stamps, self.fail
        )
        create_services(self)
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
        self.compensation.start()
        self.is_open = True

    def start(self) -> None:
        self.reader.thread.start()
        self.monitor.thread.start()
        prepare(self.parameters.rt_priority, self.parameters.cpu, self.get_logger())

    def stop(self) -> bool:
        """Stop the threads and all that listens; False if a thread does not end in time."""
        if not self.is_open:
            return True
        ended = self.monitor.stop() & self.reader.stop()
        self.compensation.stop()
        return ended

    def close(self) -> None:
        """Go back to what it was before `open`."""
        if self.is_open:
            if not self.stop():
                self.fail("a thread did not end in time")
            self.compensation.forget_bias()
        self.is_open = False
        self.live.check = self.live.apply = lambda _: None
        self.live.link = None
        self.live.settings_changed()
        for kind, destroy in _KINDS.items():
            for entity in {*getattr(self, kind)} - self._kept:
                getattr(self, destroy)(entity)

    def clean_up(self) -> None:
        """Let all parameters be set again."""
        self.close()
        self.live.is_fixed = False

    on_configure, on_activate = _transition(configure), _transition(lambda node: (node.open(), node.start()))
    on_deactivate, on_cleanup = _transition(close), _transition(clean_up)
    on_shutdown = on_error = on_cleanup  # one that fails leaves it unconfigured

    @classmethod
    def create(cls: type[_Node], arguments: Sequence[str] | None = None) -> _Node:
        with _sentences():
            return cls(arguments)

    def set_parameters_atomically(self, parameter_list: list[Any]) -> Any:
        """As rclpy, which calls this for every request, but while no other thread sets any."""
        with self.setting:
            result = super().set_parameters_atomically(parameters := converted(parameter_list))
            if result.successful:
                self.live.after_set(parameters)
            return result

    def _apply(self, parameters: Parameters) -> None:
        self.stamps.update(parameters, self.reader.link)
        self.compensation.apply(parameters)
        self.monitor.limits = parameters.limits
        self.reader.limit_rate(parameters.publishing_frequency)
        for output in self.outputs.all:
            output.configure(parameters)

    def _on_link_change(self) -> None:
        self.stamps.update(self.compensation.parameters, self.reader.link)
        self.compensation.link_changed()
        self.live.settings_changed()

    def finish(self, exit_code: int) -> None:
        """End the node, from any thread; the first call counts."""
        if self.exit_code is None:
            self.exit_code = exit_code
        self.on_finish()
        if self.is_open:
            self.reader.link.cancel()

    def fail(self, reason: str) -> None:
        self.get_logger().error(reason)
        self.finish(1)

    def _on_supervisor(self, message: KeyValue) -> None:
        link = self.reader.link
        # All nodes are meant, or the one of this sensor or server: robots may share a domain.
        names = [name for name in (link.info.serial, link.address) if name is not None]
        keys = SUPERVISOR_KEY, *(f"{SUPERVISOR_KEY}/{name}" for name in names)
        if message.key not in keys or message.value != SUPERVISOR_STOP or self.exit_code is not None:
            return
        self.get_logger().info("the supervisor stops the force/torque sensors")
        try:
            self.get_logger().info(link.shut_server_down())
        except RequestRefusedError as error:
            self.get_logger().error(str(error))
            self.finish(SERVER_NOT_STOPPED)
        except RequestFailedError as error:
            self.get_logger().warning(str(error))
        self.finish(0)


def run(arguments: Sequence[str], signals: StopSignals | None = None) -> int:
    try:
        unknown = remove_ros_args(["bridge-client", *arguments])[1:]
        if unknown:
            return refuse(f"unknown argument {unknown[0]!r}: see --help", 2)
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # noqa: BLE001 - rclpy raises several unrelated ones, most about arguments
        text = _text_of(error)
        if "initialize logging" in text:
            text += ": set HOME, or ROS_LOG_DIR to a directory for its log, which can be written"
        elif "ROS_DOMAIN_ID" in text:
            text += ": set it to a whole number, or unset it"
        return refuse(f"ROS cannot start: {text}", 2 if is_about_arguments(error) else 1)
    try:
        node = BridgeNode.create()
        if signals is not None:
            signals.call(lambda _: node.finish(0))
        favor_stream()
        return spin(node)
    except StartError as error:
        return refuse(str(error), 2)
    finally:
        rclpy.try_shutdown()


def spin(node: BridgeNode) -> int:
    """Run the node until it is told to finish, and destroy it; returns its exit code.

    Services may block: parameters do not wait for them, nor do supervisor and orientation.
    """
    executor, beside = make_executors(node, node.live.group)
    spinner, spinners = Spinner(executor), {name: Spinner(each) for name, each in beside.items()}
    node.on_finish = spinner.stop
    workers = [Worker(name, each.run, node.fail) for name, each in spinners.items()]
    for worker in workers:
        worker.start()
    if node.is_open:
        node.start()
    try:
        if node.exit_code is not None:  # a signal came before there was a spinner
            spinner.stop()
        spinner.run()
        return node.exit_code or 0
    finally:
        for each in spinners.values():
            each.stop()
        if not all([*(worker.has_ended() for worker in workers), node.stop()]):
            node.get_logger().error("a thread did not end in time")
        else:
            for part in beside.values():
                part.shutdown()
        executor.shutdown()
        node.destroy_node()
