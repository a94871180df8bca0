"""What the node knows of rclpy beyond its documentation: all of it is here, and each has a fallback.

Executors and parameters are so for the versions of `RIGHT_FOR` only. A message that is serialized here must
be read by rclpy as the one that is meant, whatever its version.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from operator import setitem
from struct import Struct
from typing import Any, Final

from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message

from bota_ethercat.cdr import StampedNumbers

RIGHT_FOR: Final = ("7.1.", "9.1.")  # Jazzy, Kilted
_THREADS: Final = 4  # of the documented executor: a service, the supervisor, an orientation, TF
_TYPES: Final = {type_.value for type_ in Parameter.Type}


def is_known() -> bool:
    """Whether rclpy's version is one of RIGHT_FOR."""
    with suppress(PackageNotFoundError):
        return version("rclpy").startswith(RIGHT_FOR)
    return False


def is_about_arguments(error: Exception) -> bool:
    """Whether `rclpy.init` refused the arguments; it has no public names for these."""
    return type(error).__name__ in {"RCLInvalidROSArgsError", "UnknownROSArgsError"}


# Serialized messages.


def packer(message: Any, count: int) -> Callable[..., Any]:
    """What makes of `count` float64, and of a stamp (ns since 1970) before them if there is a header, what
    `publish` takes.

    That is serialized here if rclpy reads it as it should, but for bytes of padding; else it is `message`.
    """
    fill, numbers = filling(message), [*map(float, range(count))]
    if not hasattr(message, "header"):
        layout, pack = serialize_message(message)[: -8 * count], Struct(f"<{count}d").pack
        return fill if not _is_read(layout + pack(*numbers), fill(*numbers)) else lambda *v: layout + pack(*v)
    packed, stamp = StampedNumbers(message.header.frame_id, count).pack, message.header.stamp

    def filled(stamp_ns: int, *values: float) -> Any:
        stamp.sec, stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        return fill(*values)

    example_ns = 1_234_567_890_123_456_789
    return packed if _is_read(packed(example_ns, *numbers), filled(example_ns, *numbers)) else filled


def _is_read(serialized: bytes, message: Any) -> bool:
    with suppress(Exception):  # the middleware's
        return bool(deserialize_message(serialized, type(message)) == message)
    return False


def filling(message: Any) -> Callable[..., Any]:
    """The documented way: the message, its float64 filled in one by one, in order; always the same object."""
    puts = [*_puts(message)]

    def fill(*values: float) -> Any:
        for put, value in zip(puts, values, strict=True):
            put(value)
        return message

    return fill


def _puts(part: Any) -> Iterator[Callable[[float], object]]:
    for name, kind in part.get_fields_and_field_types().items():
        value = getattr(part, name)
        if kind == "double":
            yield partial(setattr, part, name)
        elif kind.startswith(("double[", "sequence<double")):
            yield from (partial(setitem, value, index) for index in range(len(value)))
        elif hasattr(value, "get_fields_and_field_types"):
            yield from _puts(value)


# Executors.


def make_executors(node: Node) -> tuple[Executor, Executor]:
    """One for the ordinary callbacks of the node, which may block, and one for the prompt ones.

    Prompt are those in a callback group of their own: they wait for no others. rclpy has
    `MultiThreadedExecutor` for that, which hands every callback to a pool and waits for all of the node's
    services anew each time: too much beside the reader, for an orientation 500 times a second. It is what an
    unknown version gets, and nothing is left for the second then.
    """
    if is_known():
        prompt = _PartExecutor(node)
        return _PartExecutor(node, prompt), prompt
    executor = MultiThreadedExecutor(_THREADS, context=node.context)
    executor.add_node(node)
    return executor, SingleThreadedExecutor(context=node.context)


class _PartExecutor(SingleThreadedExecutor):  # type: ignore[misc]  # rclpy has no types
    """For some of a node's callbacks."""

    def __init__(self, node: Node, prompt: _PartExecutor | None = None) -> None:
        """Without `prompt` it is the prompt one; with it, the ordinary one, which the node knows."""
        self._prompt = prompt
        super().__init__(context=node.context)
        self._part = _Part(node, is_default=prompt is not None)
        if prompt is not None:
            self.add_node(node)

    def get_nodes(self) -> list[Any]:
        """The node's entities that are for this executor."""
        return [self._part]

    def wake(self) -> None:
        """Wake both: the node has another entity, or one less."""
        super().wake()
        if self._prompt is not None:
            self._prompt.wake()


class _Part:
    """A node as an executor sees it, with the entities that are in its default callback group, or not."""

    def __init__(self, node: Node, *, is_default: bool) -> None:
        self._node, self._is_default = node, is_default

    def __getattr__(self, kind: str) -> Any:
        """`subscriptions`, `timers`, `clients`, `services`, `guards` or `waitables`."""
        default, wanted = self._node.default_callback_group, self._is_default
        entities = getattr(self._node, kind)
        return [entity for entity in entities if (entity.callback_group is default) is wanted]


# Parameters.


def given_parameters(node: Node) -> list[str]:
    """The names of all that were given to the node, declared or not; of an unknown version, none."""
    return [*node._parameter_overrides] if is_known() else []


def refuse_unknown_types(node: Node) -> None:
    """Where anybody sets a parameter of a type that there is not, rclpy's callback would end the node."""
    for service in node.services if is_known() else ():
        if service.srv_type in (SetParameters, SetParametersAtomically):
            service.callback = partial(_set_known_types, service.callback)


def _set_known_types(set_parameters: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
    is_known_type = {parameter.value.type for parameter in request.parameters} <= _TYPES
    return set_parameters(request, response) if is_known_type else response  # nothing was set
