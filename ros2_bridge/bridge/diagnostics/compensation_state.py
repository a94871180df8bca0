"""How the compensation is at one moment, as the diagnostics tell it. No ROS, no threads."""

from __future__ import annotations

import math
from typing import NamedTuple

from ft_compensation.quantities import NO_WRENCH, Payload, Wrench


class CompensationState(NamedTuple):
    """What is known at one moment."""

    has_subscribers: bool = False
    published: int = 0
    withheld: int = 0
    """Samples since the node started that were compensated, and that could not be."""
    why_stopped: str | None = None
    """Why the latest sample was not compensated, or would not be with a subscriber; None: it was."""
    why_partly: str = ""
    """Why single topics have stopped, a sentence; empty if none has."""
    source: str = "none"
    age_s: float = math.inf
    """Of the orientation."""
    bound: float | None = None
    """N: in 95 % of cases the accelerometer's own errors are a smaller force; None where it is not used."""
    payload: Payload = Payload()
    bias: Wrench = NO_WRENCH
    origin: str = "parameter"
    """Where the bias comes from."""
    is_ramping: bool = False
    keep: bool = False
    """Whether the bias is to survive a restart."""
    stops_on_saturation: bool = False
    problem: str = ""
    """What is not as it should be, a sentence."""

    @property
    def good(self) -> str:
        """What to say when all is well."""
        parts = ["bias"] if self.bias != NO_WRENCH else []
        if self.payload.mass:
            parts += ["weight and inertia of the tool"] if self.source == "imu" else ["weight of the tool"]
        if not parts:
            text = "nothing is subtracted: there is no bias and no tool_mass"
        else:
            text = f"subtracted: {', '.join(parts)}"
        return text if self.has_subscribers else f"{text}; nobody has subscribed"

    @property
    def values(self) -> dict[str, object]:
        """By name."""
        uses_source = bool(self.payload.mass) and self.has_subscribers
        return {
            "gravity_source": self.source,
            "orientation_age_s": round(self.age_s, 4) if uses_source and math.isfinite(self.age_s) else "",
            "accelerometer_force": "" if self.bound is None else round(self.bound, 3),
            "tool_mass": round(self.payload.mass, 4),
            "tool_center_of_gravity": _numbers(self.payload.center),
            "tared": self.bias != NO_WRENCH,
            "bias": _numbers(self.bias.values),
            "bias_from": self.origin,
            "bias_ramping": self.is_ramping,
            "bias_keep": self.keep,
            "subscribed": self.has_subscribers,
            "compensated": self.published,
            "withheld": self.withheld,
        }


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.4f}" for value in values)
