"""How terminals are named in the configuration: by vendor and product, position on the wire, or both."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

CHOICE: Final = re.compile(r"(?!$)(?:(0x[0-9a-fA-F]+):(0x[0-9a-fA-F]+)(?:@(?=[0-9])|$))?([0-9]{1,5})?")


def named_positions(choices: Sequence[str]) -> dict[int, tuple[int, int] | None]:
    """The positions on the wire that are named, and the vendor and product that each must have, if any."""
    return {int(position): kind for kind, position in map(parsed, choices) if position}


def parsed(choice: str) -> tuple[tuple[int, int] | None, str]:
    """Vendor and product, if they are named; position, or ""."""
    vendor, product, position = CHOICE.findall(choice)[0]
    return (int(vendor, 0), int(product, 0)) if vendor else None, position
