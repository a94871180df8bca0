"""What holds for all tests: two run at a time, and their ROS nodes do not hear each other."""

from __future__ import annotations

import os
import random

from hypothesis import settings

_DOMAINS = 101
"""Those whose ports every system leaves free."""


def _choose_domain() -> None:
    """A ROS domain for each of pytest's workers, whatever the run's is."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    base = int(os.environ.get("ROS_DOMAIN_ID") or random.randrange(_DOMAINS))
    os.environ["ROS_DOMAIN_ID"] = str((base + worker * (_DOMAINS // 3)) % _DOMAINS)


_choose_domain()
# How long an example takes is no property of the code: the machine may be busy.
settings.register_profile("without deadline", deadline=None)
settings.load_profile("without deadline")
