"""One row of the table of parameters: its default and what it may be. No ROS."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

Numbers = tuple[float, ...]
Texts = tuple[str, ...]
ParameterValue = bool | int | float | str | Numbers | Texts
NO_TEXTS: Final = ("",)
"""An empty list of strings: ROS cannot infer the type of []."""
_COVARIANCE_LENGTHS: Final = (3, 9)


class ParameterError(Exception):
    """A parameter has a value that it cannot have; the text is one sentence."""


class Row(NamedTuple):
    """One parameter. The default's type is the parameter's; a tuple is texts, or numbers, `lengths` how many.

    `low` and `high` bound a number, or the magnitude of each of several. `live`: can be set while the node
    runs.
    """

    name: str
    default: ParameterValue
    description: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    lengths: tuple[int, ...] = _COVARIANCE_LENGTHS
    live: bool = False

    def check(self, value: object) -> ParameterValue:
        """Return `value`, a whole number as float where one is meant; ParameterError if it cannot be."""
        if self._is_texts:
            checked: ParameterValue | None = self._texts(value)
        else:
            checked = self._numbers(value) if isinstance(self.default, tuple) else self._one(value)
        if checked is None:
            raise ParameterError(f"parameter {self.name} is {value!r}: it must be {self.allowed()}")
        return checked

    def _one(self, value: object) -> ParameterValue | None:
        wanted = type(self.default)
        if wanted is float and type(value) is int:
            value = float(value)
        if type(value) is not wanted or not isinstance(value, bool | int | float | str):
            return None
        if isinstance(value, str):
            allowed = value in self.choices if self.choices else bool(value)
        else:
            allowed = math.isfinite(value) and self._in_range(value)
        return value if allowed else None

    def _numbers(self, value: object) -> Numbers | None:
        # rclpy gives an array.array or a list, of whole numbers if all are.
        items = list(value) if hasattr(value, "__iter__") and not isinstance(value, str | bytes) else []
        if len(items) not in self.lengths or not all(type(item) in (int, float) for item in items):
            return None
        if not all(math.isfinite(item) and self._in_range(abs(item)) for item in items):
            return None
        return tuple(float(item) for item in items)

    @property
    def _is_texts(self) -> bool:
        return isinstance(self.default, tuple) and isinstance(self.default[0], str)

    @staticmethod
    def _texts(value: object) -> Texts | None:
        if value is None:  # what rclpy makes of []
            return NO_TEXTS
        items = [value] if isinstance(value, str) else value
        if not isinstance(items, list | tuple) or not all(isinstance(item, str) for item in items):
            return None
        return tuple(items) or NO_TEXTS

    def _in_range(self, value: float) -> bool:
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)

    def allowed(self) -> str:
        """The values that it may have, in words."""
        if self.choices:
            return " or ".join(self.choices)
        if isinstance(self.default, str):
            return "text that is not empty"
        if isinstance(self.default, bool):
            return "true or false"
        if self._is_texts:
            return "a list of texts"
        if isinstance(self.default, tuple):
            if self.lengths == _COVARIANCE_LENGTHS:
                return "3 numbers, the variances, or 9, the covariance row by row"
            return f"{self.lengths[0]} numbers, none beyond {self.high:g} either way"
        kind = "a whole number" if isinstance(self.default, int) else "a number"
        return f"{kind} from {self.low:g} to {self.high:g}"
