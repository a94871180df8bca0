"""As much of the packages `launch` and `launch_ros`, which PyPI does not have, as the launch files need.

Enough to list a file's arguments and to call its functions; nothing is started.
"""

from __future__ import annotations

import runpy
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock


class Entity:
    """Any action or substitution: it keeps what it is given."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self.stood_in_for = given

    def get_sub_entities(self) -> list[Any]:
        return []


class LaunchDescription(Entity):
    def get_sub_entities(self) -> list[Any]:
        return list(self.stood_in_for[0])

    @property
    def entities(self) -> list[Any]:
        return list(self.stood_in_for[0])


class DeclareLaunchArgument(Entity):
    @property
    def name(self) -> str:
        return str(self.stood_in_for[0])


class IncludeLaunchDescription(Entity):
    def get_sub_entities(self) -> list[Any]:
        path = self.stood_in_for[0].stood_in_for[0]
        return [runpy.run_path(path)["generate_launch_description"]()]


class LaunchConfiguration(Entity):
    def perform(self, context: dict[str, str]) -> str:
        return context.get(self.stood_in_for[0], "")


def _module(path: str) -> types.SimpleNamespace:
    return types.SimpleNamespace(**runpy.run_path(path))


_OURS = {
    own.__name__: own
    for own in (LaunchDescription, DeclareLaunchArgument, IncludeLaunchDescription, LaunchConfiguration)
}
_MODULES = (
    "launch", "launch.actions", "launch.conditions", "launch.event_handlers", "launch.logging",
    "launch.launch_description_sources", "launch.substitutions",
    "launch_ros", "launch_ros.actions", "launch_ros.parameter_descriptions", "launch_ros.substitutions",
)  # fmt: skip


class _Module(types.ModuleType):
    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _module if name == "load_python_launch_file_as_module" else _OURS.get(name, Entity)


@contextmanager
def stand_in() -> Iterator[None]:
    """While it lasts, launch files can be run with `runpy`."""
    with mock.patch.dict(sys.modules, {name: _Module(name) for name in _MODULES}):
        yield


def arguments_of(file: Path) -> list[str]:
    """What `ros2 launch FILE --show-args` lists."""
    names: list[str] = []

    def walk(entity: Any) -> None:
        for inner in entity.get_sub_entities():
            if isinstance(inner, DeclareLaunchArgument):
                names.append(inner.name)
            walk(inner)

    with stand_in():
        walk(runpy.run_path(str(file))["generate_launch_description"]())
    return list(dict.fromkeys(names))
