"""The sensor's settings as ROS parameters `settings.NAME`: they show what is in force; set one to change it.

They have no value (NOT_SET) while there is no server, nor where this sensor lacks the setting. The server is
asked for every change and must say that it is in force; otherwise the parameter stays as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rcl_interfaces.msg import IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from bridge.link import Link
from bridge.requests import CONFIGURE_TIMEOUT_S, RequestFailedError, Requests
from protocol.errors import SettingError
from protocol.settings import SETTINGS, Setting, SettingValue, check_settings

PREFIX: Final = "settings."


class SettingsParameters:
    """Lives in the executor's thread, but for `changed`."""

    def __init__(self, node: Node, link: Link, requests: Requests) -> None:
        self._node, self._link, self._requests = node, link, requests
        self._following = True
        for setting in SETTINGS.values():
            self._declare(setting)
        self._following = False
        node.add_on_set_parameters_callback(self._on_set)
        self._guard = node.create_guard_condition(self._follow)

    def changed(self) -> None:
        """The settings, or whether there are any, may have changed; for any thread."""
        self._guard.trigger()

    def _declare(self, setting: Setting) -> None:
        name, descriptor = PREFIX + setting.name, _descriptor(setting)
        given = self._node.declare_parameter(name, None, descriptor).value
        if given is not None:
            self._node.get_logger().warning(
                f"parameter {name} is given at start and ignored: give it to ethercat-server "
                f"(--set {setting.name}={given} or its configuration file), or set it while the node runs"
            )
            self._unset(setting)

    def _unset(self, setting: Setting) -> None:
        name = PREFIX + setting.name
        self._node.undeclare_parameter(name)
        self._node.declare_parameter(name, None, _descriptor(setting), ignore_override=True)

    def _follow(self) -> None:
        """Make the parameters what the settings are."""
        in_force = self._link.settings
        self._following = True
        try:
            for setting in SETTINGS.values():
                shown = self._node.get_parameter(PREFIX + setting.name).value
                value = in_force.get(setting.name)
                if value is None and shown is not None:
                    self._unset(setting)
                elif value is not None and (value != shown or type(value) is not type(shown)):
                    self._node.set_parameters([Parameter(PREFIX + setting.name, value=value)])
        finally:
            self._following = False

    def _on_set(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        wanted = {p.name.removeprefix(PREFIX): p.value for p in parameters if p.name.startswith(PREFIX)}
        if self._following or not wanted:
            return SetParametersResult(successful=True)
        try:
            self._configure(check_settings(wanted))
        except (SettingError, RequestFailedError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _configure(self, wanted: dict[str, SettingValue]) -> None:
        reply = self._requests.ask(
            "configure", CONFIGURE_TIMEOUT_S, sensor=self._link.sensor, settings=wanted
        )
        in_force = reply.get("settings")
        in_force = in_force if isinstance(in_force, dict) else {}
        self._link.take_settings(in_force)
        for name, value in wanted.items():
            if (held := in_force.get(name)) != value:
                self.changed()
                raise RequestFailedError(f"{name} is still {held}, says the server: it did not take {value}")


def _descriptor(setting: Setting) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=setting.meaning[0].upper() + setting.meaning[1:], dynamic_typing=True
    )
    if isinstance(setting.choices, range):
        low, high = setting.choices[0], setting.choices[-1]
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    elif setting.choices:
        descriptor.additional_constraints = "one of " + ", ".join(map(str, setting.choices))
    return descriptor
