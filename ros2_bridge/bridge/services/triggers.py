"""Services of the type `std_srvs/Trigger`: an act that returns what it did, or raises why it did not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger


def create_triggers(node: Node, acts: Mapping[str, Callable[[], str]], *failures: type[Exception]) -> None:
    """A service `~/NAME` for each act. An error of `failures` says why it was not done, and is the answer."""
    for name, act in acts.items():
        node.create_service(Trigger, f"~/{name}", _answering(node, name, act, failures))


def _answering(
    node: Node, name: str, act: Callable[[], str], failures: tuple[type[Exception], ...]
) -> Callable[[Any, Any], Any]:
    def answer(_request: Any, response: Any) -> Any:
        try:
            response.message = act()
            response.success = True
        except failures as error:
            response.message = str(error)
            response.success = False
            node.get_logger().warning(f"{name} failed: {error}")
        return response

    return answer
