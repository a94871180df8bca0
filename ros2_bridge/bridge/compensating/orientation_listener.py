"""Listens to a topic or to TF for the sensor's orientation.

In a callback group of its own, so that it waits for no service: a pose that is not taken in is an old one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

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
from bridge.compensating.tool_sources import Oriented
from bridge.parameters.compensation import TOPIC_SOURCES, OrientationParameters
from bridge.parameters.row import ParameterError

TF_PERIOD_S: Final = 0.005
"""Period of the TF lookups."""
_LET_GO_S: Final = 1.0
"""How long an executor may take to release the previous subscription: DDS has one type per topic."""


def check_can_listen(
    node: Node, chosen: OrientationParameters, listening: OrientationListener | None = None
) -> None:
    """ParameterError if that source is not available on this machine, or its topic's name is invalid.

    `listening` is what will be closed before.
    """
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
            if listening is not None and own is listening.subscription:
                continue
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
        group: CallbackGroup,
        open_buffer: Callable[[Node], Tf] = open_tf,
    ) -> None:
        """`chosen.source` is a key of TOPIC_KINDS, or `tf`: then `frame` is the sensor's.

        ParameterError if ROS refuses to listen there.
        """
        self.latest: Oriented | None = None
        self.problem = "nothing has come yet"
        """What was wrong with what came last; empty if nothing was."""
        self.subscription: Any = None
        """To a topic; None: to TF."""
        self._node, self._group = node, group
        self._close: Callable[[], object]
        if chosen.source == "tf":
            self._mounting = None
            self._listen_to_tf(open_buffer(node), chosen.base_frame, frame)
        else:
            self._mounting = chosen.mounting
            self._listen_to_topic(chosen)

    def _listen_to_tf(self, tf: Tf, base: str, frame: str) -> None:
        self.describe = f"TF from {base} to {frame}"
        timer = self._node.create_timer(
            TF_PERIOD_S, lambda: self._take(lambda: look_up(tf, base, frame)), self._group
        )

        def close() -> None:
            self._node.destroy_timer(timer)
            tf.close()

        self._close = close

    def _listen_to_topic(self, chosen: OrientationParameters) -> None:
        kind = TOPIC_KINDS[chosen.source]
        resolved = self._node.resolve_topic_name(chosen.topic)
        self.describe = f"topic {resolved}"
        self.problem = "nothing has come on it yet"
        profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        deadline_s = time.monotonic() + _LET_GO_S
        while self.subscription is None:
            try:
                self.subscription = self._node.create_subscription(
                    kind.type,
                    resolved,
                    lambda message: self._take(lambda: read_message(kind, message)),
                    profile,
                    callback_group=self._group,
                )
            except RuntimeError as error:
                if time.monotonic() < deadline_s:
                    time.sleep(0.01)
                    continue
                raise ParameterError(
                    f"parameter orientation.topic is {chosen.topic!r}: ROS refuses to listen there "
                    f"({error}); choose another topic"
                ) from None
        self._close = lambda: self._node.destroy_subscription(self.subscription)

    def close(self) -> None:
        """Stop listening."""
        self._close()

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
