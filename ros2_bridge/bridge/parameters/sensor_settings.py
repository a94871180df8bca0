"""The sensor's settings as ROS parameters `settings.NAME`: they show what is in force; set one to change it.

They have no value (NOT_SET) while there is no server, nor where this sensor lacks the setting. The server is
asked for every change and must say that it is in force; otherwise the parameter stays as it was.

Values given at start do not change the sensor by themselves: other nodes may share it. `apply` puts them, and
what was set since, in force together.
"""

from __future__ import annotations

from collections.abc import Sequence

from rcl_interfaces.msg import IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from bota_ethercat.errors import SettingError
from bota_ethercat.settings import SETTINGS, Setting, SettingValue, check_settings
from bridge.parameters.declare import SETTINGS_PREFIX as PREFIX
from bridge.parameters.row import ParameterError
from bridge.stream.link import CONFIGURE_TIMEOUT_S, Link, RequestFailedError


class SettingsParameters:
    """Lives in the executor's thread, but for `changed`."""

    def __init__(self, node: Node, link: Link) -> None:
        self._node, self._link = node, link
        self._wanted: dict[str, SettingValue] = {}
        """What this node's user gave at start or set since."""
        self._following = True
        for setting in SETTINGS.values():
            self._declare(setting)
        self._following = False
        self._say_wanted()
        node.add_on_set_parameters_callback(self._on_set)
        self._guard = node.create_guard_condition(self._follow)

    def changed(self) -> None:
        """The settings, or whether there are any, may have changed; for any thread."""
        self._guard.trigger()

    def _declare(self, setting: Setting) -> None:
        name, descriptor = PREFIX + setting.name, _descriptor(setting)
        given = self._node.declare_parameter(name, None, descriptor).value
        if given is not None:
            try:
                self._wanted[setting.name] = setting.check(given)
            except SettingError as error:
                raise ParameterError(f"parameter {name}: {error}") from None
            self._unset(setting)

    def _say_wanted(self) -> None:
        if self._wanted:
            self._node.get_logger().info(
                f"settings given at start: {', '.join(self._wanted)}; "
                "call ~/apply_settings to put them in force"
            )

    def apply(self) -> dict[str, SettingValue]:
        """Put in force what was given at start or set since, and return it.

        RequestFailedError if that is nothing or cannot be.
        """
        if not self._wanted:
            raise RequestFailedError(
                "no settings were given: give settings.NAME at start, or set one while the node runs"
            )
        try:
            self._configure(check_settings(self._wanted))
        except SettingError as error:
            raise RequestFailedError(str(error)) from None
        return dict(self._wanted)

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
        self._wanted.update(wanted)
        return SetParametersResult(successful=True)

    def _configure(self, wanted: dict[str, SettingValue]) -> None:
        reply = self._link.ask("configure", CONFIGURE_TIMEOUT_S, sensor=self._link.sensor, settings=wanted)
        in_force = reply.get("settings")
        in_force = in_force if isinstance(in_force, dict) else {}
        self._link.take_settings(reply)
        for name, value in wanted.items():
            if (held := in_force.get(name)) != value:
                self.changed()
                raise RequestFailedError(f"{name} is still {held}: the server did not apply {value}")


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
