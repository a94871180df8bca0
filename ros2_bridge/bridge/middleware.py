"""Gives the middleware a profile for many small messages, before ROS loads it.

Only Fast DDS 2, the default of ROS 2 Jazzy, reads it; what it says and why is in fastdds.xml.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path
from typing import Final

PROFILES: Final = Path(__file__).with_name("fastdds.xml")
_VARIABLE: Final = "FASTRTPS_DEFAULT_PROFILES_FILE"


def use_own_profiles(environment: MutableMapping[str, str]) -> None:
    """Name our file in `environment`, unless the user has named one: who tunes the middleware knows best."""
    if not environment.get(_VARIABLE):
        environment[_VARIABLE] = str(PROFILES)
