"""What fault commands, and the words for faults of a distributed clock, have in common."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from ethercat_server.virtual_sensor.options import UsageError

PPM_LIMIT: Final = 100_000.0


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault command, or a word of a distributed clock.

    Each argument is parsed by one of `arguments`. Those in brackets in `usage` can be left out; the last one
    may be repeated where there are dots. `effect` is called with what it acts on, and the arguments.
    """

    usage: str
    meaning: str
    effect: Callable[..., Any]
    arguments: tuple[Callable[[str], Any], ...] = ()

    @property
    def name(self) -> str:
        return self.usage.split()[0]

    def parse(self, words: Sequence[str]) -> list[Any]:
        least = len(self.arguments) - self.usage.replace("[@N]", "").count("[")
        most = math.inf if "..." in self.usage else len(self.arguments)
        if not least <= len(words) <= most:
            raise UsageError(f"wrong number of arguments: {self.usage}")
        parsers = (*self.arguments, *self.arguments[-1:] * len(words))
        return [parse(word) for parse, word in zip(parsers, words, strict=False)]
