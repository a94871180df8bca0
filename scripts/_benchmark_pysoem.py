"""The least that pysoem needs to bring a virtual sensor to OP; for what is compared with the server."""

from __future__ import annotations

from typing import Any, Final

import pysoem

from scripts._demo import DemoError

_ATTEMPTS: Final = 500


def operational_master(ifname: str) -> Any:
    """A pysoem.Master whose slaves are all in OP."""
    master = pysoem.Master()
    master.open(ifname)
    if master.config_init() <= 0:
        raise DemoError(f"no sensor answers on {ifname}")
    master.config_map()
    master.state_check(pysoem.SAFEOP_STATE, 50_000)
    master.state = pysoem.OP_STATE
    master.write_state()
    for _ in range(_ATTEMPTS):
        master.send_processdata()
        master.receive_processdata(2000)
        if master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE:
            return master
    raise DemoError(f"the sensor on {ifname} does not reach OP")
