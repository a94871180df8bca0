# SPDX-License-Identifier: Apache-2.0
"""Where a sensor's frames are, from the drawings in Bota's URDFs; no rotation between them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

IMU_HEIGHTS: Final[Mapping[str, float]] = {
    "SENS": 0.0093 - 0.035,
    "ROKS": 0.0098 - 0.032,
    "ROKA": 0.0098 - 0.032,
    "MEDS": 0.0098 - 0.032,
    "MEDA": 0.0098 - 0.032,
    "LAXS": 0.01195 - 0.0445,
    "MEGS": 0.0134 - 0.059,
}
"""By the model's letters, as in BFT-SENS-ECAT-M8: z of the IMU from the wrench origin, m."""
