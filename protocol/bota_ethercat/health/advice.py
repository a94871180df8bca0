# SPDX-License-Identifier: Apache-2.0
"""The words of what every program advises, the server's log included."""

from __future__ import annotations

from typing import Final

CHECK_IT: Final = "check it with ethercat-doctor"  # which says something else itself
IT_TELLS: Final = "ethercat-doctor tells which"
STOOD_STILL: Final = f"computer stood still{{}}, {CHECK_IT}"
