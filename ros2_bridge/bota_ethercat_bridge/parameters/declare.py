# SPDX-License-Identifier: Apache-2.0
"""The table's parameters and the sensor's settings on the node: declared with what was given, and set while
it runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter

from bota_ethercat.errors import SettingError
from bota_ethercat.option_types import OptionType
from bota_ethercat.settings import SETTINGS, Setting, SettingValue, check_settings, known_settings
from bota_ethercat.text.did_you_mean import did_you_mean
from bota_ethercat_bridge.parameters.table import PARAMETERS, ParameterError, Parameters, gather
from bota_ethercat_bridge.rclpy_internals import given_parameters
from bota_ethercat_bridge.stream.link import CONFIGURE_TIMEOUT_S, Link, RequestFailedError

_PREFIX: Final = "settings."
_NO_SIM_TIME: Final = "a real sensor has no simulation time"
# Prefixes of parameters that rclpy itself may declare.
_OF_OTHERS: Final = ("qos_overrides.", "use_sim_time", "start_type_description_service")
_ROWS: Final = {row.name: row for row in PARAMETERS}


def descriptor(kind: OptionType[Any], description: str, **more: Any) -> ParameterDescriptor:
    described = ParameterDescriptor(description=description, **more)
    if not kind.limits:
        described.additional_constraints = kind.allowed
        return described
    low, high = kind.limits
    if isinstance(low, int):
        described.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    else:
        described.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
    return described


def _setting_descriptor(setting: Setting) -> ParameterDescriptor:
    meaning = setting.meaning[0].upper() + setting.meaning[1:]
    return descriptor(setting.type, meaning, dynamic_typing=True)


class NodeParameters:
    """Declares all parameters, and checks and applies those that are set, in the threads that set them.

    The sensor's settings, `settings.NAME`, show what is in force, and have no value (NOT_SET) while there is
    no server, nor where this sensor lacks the setting. The server is asked for every change and must say that
    it is in force; otherwise the parameter stays as it was. Settings given at start do not change the sensor
    by themselves, as other nodes may share it: `apply_settings` puts them, and those set since, in force.

    Attributes:
        is_fixed: whether those that are not live are read-only.
        check, apply: get new values; `check` may refuse them with ParameterError.
        link: None while the node is not active.
        settings_changed: to be called, from any thread, when the settings, or whether there are any, may
            have changed.
    """

    def __init__(self, node: Node) -> None:
        """ParameterError if one is wrong."""
        self._node, self.is_fixed = node, False
        self.check: Callable[[Parameters], object] = lambda _: None
        self.apply: Callable[[Parameters], object] = lambda _: None
        self.link: Link | None = None
        self._wanted: dict[str, SettingValue] = {}  # settings given at start or set since
        self._following = False  # whether parameters are being made what the settings are
        self.given = self._declare_table()
        for setting in SETTINGS.values():
            self._declare_setting(setting)
        self._warn_of_others()
        self.group = MutuallyExclusiveCallbackGroup()  # of requests: they do not wait for other services
        for service in node.services:
            service.callback_group = self.group
            self.group.add_entity(service)
        node.add_on_set_parameters_callback(self._on_set)
        self.settings_changed: Callable[[], object] = node.create_guard_condition(self._follow).trigger

    def _declare_table(self) -> Parameters:
        node, values = self._node, dict[str, Any]()
        for row in PARAMETERS:
            # Declared loosely for what was given, whatever its type, and undeclared again.
            loose = ParameterDescriptor(dynamic_typing=True)
            values[row.name] = row.check(node.declare_parameter(row.name, row.default, loose).value)
            node.undeclare_parameter(row.name)
        parameters = gather(values)
        values["server_port"] = parameters.server_port
        for row in PARAMETERS:
            # With a lifecycle those that are not live are fixed only while it is configured: `is_fixed`.
            read_only = not row.live and (not parameters.lifecycle or row.name == "lifecycle")
            described = descriptor(row.type, row.description, read_only=read_only)
            node.declare_parameter(row.name, values[row.name], described, ignore_override=True)
        return parameters

    def _declare_setting(self, setting: Setting) -> None:
        name = _PREFIX + setting.name
        given = self._node.declare_parameter(name, None, _setting_descriptor(setting)).value
        if given is not None:
            try:
                self._wanted[setting.name] = setting.check(given)
            except SettingError as error:
                raise ParameterError(f"parameter {name}: {error}") from None
            self._unset(setting)

    def _unset(self, setting: Setting) -> None:
        name = _PREFIX + setting.name
        self._node.undeclare_parameter(name)
        self._node.declare_parameter(name, None, _setting_descriptor(setting), ignore_override=True)

    def _warn_of_others(self) -> None:
        """Warn of given parameters that the node does not have."""
        node, log = self._node, self._node.get_logger()
        if self._wanted:
            log.info(
                f"settings given at start: {', '.join(self._wanted)}; "
                "call ~/apply_settings to put them in force"
            )
        # Not the node's own list, which leaves out settings without a value.
        names = [row.name for row in PARAMETERS] + [_PREFIX + name for name in SETTINGS]
        for given in given_parameters(node):
            if not node.has_parameter(given) and not given.startswith(_OF_OTHERS):
                guess = did_you_mean(given, names) or "; ros2 param list shows the valid names"
                log.warning(f"unknown parameter {given} is ignored{guess}")
        if node.get_parameter("use_sim_time").value is True:
            log.warning(
                f"use_sim_time is true, but {_NO_SIM_TIME}: stamps are wall-clock time, and those of "
                "orientations must be too"
            )

    # -- set while the node runs

    def check_values(self, **values: Any) -> None:
        """ParameterError if one of them cannot be."""
        for name, value in values.items():
            _ROWS[name].check(value)

    def put(self, **values: Any) -> None:
        """Set parameters from within; ParameterError if that is refused."""
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        result = self._node.set_parameters_atomically(parameters)
        if not result.successful:
            raise ParameterError(result.reason)

    def gather(self, changed: dict[str, Any]) -> Parameters:
        """The values, with these changed; ParameterError if they cannot be."""
        values = {row.name: self._node.get_parameter(row.name).value for row in PARAMETERS} | changed
        return gather({row.name: row.check(values[row.name]) for row in PARAMETERS})

    def _on_set(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        values = {parameter.name: parameter.value for parameter in parameters}
        changed = {name: value for name, value in values.items() if name in _ROWS}
        settings = {n.removeprefix(_PREFIX): v for n, v in values.items() if n.startswith(_PREFIX)}
        try:
            if values.get("use_sim_time") is True:
                raise ParameterError(f"use_sim_time must be false: {_NO_SIM_TIME}")
            for name in changed:
                if self.is_fixed and not _ROWS[name].live:
                    raise ParameterError(f"parameter {name} is read-only while the node is configured")
            if changed:
                self.check(self.gather(changed))
            if settings and not self._following:  # the sensor is asked last
                self._configure(check_settings(settings))
                self._wanted.update(settings)
        except (ParameterError, SettingError, RequestFailedError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def after_set(self, parameters: Sequence[Parameter]) -> None:
        """To be called when these have been set (rclpy has a callback for it since Iron)."""
        if any(parameter.name in _ROWS for parameter in parameters):
            self.apply(self.gather({}))

    def apply_settings(self) -> dict[str, SettingValue]:
        """Put in force what was given at start or set since, and return it; RequestFailedError."""
        if not self._wanted:
            raise RequestFailedError(
                "no settings were given: give settings.NAME at start, or set one while the node runs"
            )
        try:
            self._configure(check_settings(self._wanted))
        except SettingError as error:
            raise RequestFailedError(str(error)) from None
        return dict(self._wanted)

    def _configure(self, wanted: dict[str, SettingValue]) -> None:
        if (link := self.link) is None:
            raise RequestFailedError("the node is not active: activate it first")
        reply = link.ask("configure", CONFIGURE_TIMEOUT_S, sensor=link.sensor, settings=wanted)
        in_force = known_settings(reply.get("settings"))
        for name, value in wanted.items():
            if (held := in_force.get(name)) != value:
                self.settings_changed()
                raise RequestFailedError(f"{name} is still {held}: the server did not apply {value}")

    def _follow(self) -> None:
        """Make the parameters what the settings are."""
        in_force = self.link.settings if self.link else {}
        with self._node.setting:
            self._following = True
            try:
                for setting in SETTINGS.values():
                    shown = self._node.get_parameter(_PREFIX + setting.name).value
                    value = in_force.get(setting.name)
                    if value is None and shown is not None:
                        self._unset(setting)
                    elif value is not None and (value != shown or type(value) is not type(shown)):
                        self._node.set_parameters([Parameter(_PREFIX + setting.name, value=value)])
            finally:
                self._following = False


def converted(parameters: Sequence[Parameter]) -> list[Parameter]:
    """Whole numbers as the floats that are meant: `ros2 param set /bridge tool_mass 1`."""
    result = []
    for parameter in parameters:
        try:
            value: Any = _ROWS[parameter.name].check(parameter.value)
        except (KeyError, ParameterError):  # of others, or refused soon, with a sentence
            result.append(parameter)
        else:
            value = [*value] if isinstance(value, tuple) else value
            result.append(Parameter(parameter.name, value=value))
    return result
