"""Listens to a topic or to TF for the sensor's orientation, in a thread and with a hidden node of its own.

A node of its own, because the executor of `bridge` stands still while a service waits for the server or for
samples, and a pose that is not taken in is an old one. It exists only while such a source is chosen.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from bridge.compensating.gravity_sources import Oriented
from bridge.compensating.orientation_messages import (
    TOPIC_KINDS,
    Tf,
    UnusableError,
    check_tf,
    look_up,
    multiply,
    open_tf,
    read_message,
)
from bridge.parameters.compensation import TOPIC_SOURCES, OrientationParameters
from bridge.parameters.row import ParameterError
from bridge.spinning import Spinner

TF_PERIOD_S: Final = 0.005
"""How often TF is asked."""
TF_TOPICS: Final = ("/tf", "/tf_static")


def check_can_listen(node: Node, chosen: OrientationParameters) -> None:
    """ParameterError if that source cannot be had on this machine, or its topic has no possible name."""
    if chosen.source == "tf":
        check_tf()
    if chosen.source in TOPIC_SOURCES:
        try:
            resolved = node.resolve_topic_name(chosen.topic)
        except RuntimeError as error:  # rclpy has no public name for it
            reason = str(error).removeprefix("failed to resolve name: ").partition(", at /")[0]
            raise ParameterError(f"parameter orientation.topic is {chosen.topic!r}: {reason}") from None
        wanted = TOPIC_KINDS[chosen.source].type
        for own in (*node.publishers, *node.subscriptions):
            # DDS has one type for a topic in a process.
            if own.topic_name == resolved and own.msg_type is not wanted:
                raise ParameterError(
                    f"parameter orientation.topic is {chosen.topic!r}: this node itself has that topic, with "
                    f"{own.msg_type.__name__} messages and not {wanted.__name__}"
                )


class OrientationListener:
    """From construction to `close`. Read `latest` and `problem` from any thread: they are replaced."""

    def __init__(
        self,
        node: Node,
        chosen: OrientationParameters,
        frame: str,
        on_failure: Callable[[str], object],
        open_buffer: Callable[[Node], Tf] = open_tf,
    ) -> None:
        """`chosen.source` is a key of TOPIC_KINDS, or `tf`: then `frame` is the sensor's.

        ParameterError if ROS refuses to listen there.
        """
        self.latest: Oriented | None = None
        self.problem = "nothing has come yet"
        """What was wrong with what came last; empty if nothing was."""
        self._on_failure = on_failure
        self._closing = False
        self._mounting = None if chosen.source == "tf" else chosen.mounting
        name = f"_{node.get_name()}_orientation"
        self._node = rclpy.create_node(
            name,
            context=node.context,
            namespace=node.get_namespace(),
            # Topics are remapped as `bridge`'s are, but what renames that node must not rename this one.
            use_global_arguments=False,
            cli_args=[
                "--ros-args",
                *(word for tf in TF_TOPICS for word in ("-r", f"{tf}:={node.resolve_topic_name(tf)}")),
            ],
            start_parameter_services=False,
            enable_rosout=False,
        )
        try:
            self._listen(node, chosen, frame, open_buffer)
        except RuntimeError as error:
            self._node.destroy_node()
            raise ParameterError(
                f"parameter orientation.topic is {chosen.topic!r}: ROS refuses to listen there ({error}); "
                "choose another topic"
            ) from None
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(self._node)
        self._spinner = Spinner(self._executor)
        self._thread = threading.Thread(target=self._run, name="orientation", daemon=True)
        self._thread.start()

    def _listen(
        self,
        node: Node,
        chosen: OrientationParameters,
        frame: str,
        open_buffer: Callable[[Node], Tf],
    ) -> None:
        if chosen.source == "tf":
            base, tf = chosen.base_frame, open_buffer(self._node)
            self.describe = f"TF from {base} to {frame}"
            self._node.create_timer(TF_PERIOD_S, lambda: self._take(lambda: look_up(tf, base, frame)))
        else:
            kind = TOPIC_KINDS[chosen.source]
            resolved = node.resolve_topic_name(chosen.topic)
            self.describe = f"topic {resolved}"
            self.problem = "nothing has come on it yet"
            profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
            self._node.create_subscription(
                kind.type, resolved, lambda message: self._take(lambda: read_message(kind, message)), profile
            )

    def close(self, timeout_s: float = 5.0) -> bool:
        """Stop listening; False if the thread does not end in time."""
        self._closing = True
        self._spinner.stop()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            return False  # what it waits for must not be taken from under it
        self._executor.shutdown()
        self._node.destroy_node()
        return True

    def _take(self, read: Callable[[], Oriented]) -> None:
        try:
            found = read()
        except UnusableError as error:
            self.problem = str(error)
        else:
            quaternion = found.quaternion
            if self._mounting is not None:
                quaternion = multiply(quaternion, self._mounting)
            self.latest, self.problem = Oriented(quaternion, found.stamp_ns), ""

    def _run(self) -> None:
        try:
            self._spinner.run()
        except Exception as error:  # noqa: BLE001 - a thread that dies silently would leave a dead source
            if not self._closing:
                self._on_failure(f"the orientation's source failed: {type(error).__name__}: {error}")
