"""Runs `ethercat-doctor` as the user `nobody`: `python -m tests.doctor.as_nobody arguments...`."""

from __future__ import annotations

import codecs
import sys

import pyroute2.ethtool.ioctl

from ethercat_server.doctor import bus_examination, cli, report
from tests.server.as_another_user import become_nobody

LOADED = (pyroute2.ethtool.ioctl, pyroute2.IPRoute, bus_examination, report)
"""What it would load later, from where nobody may not be able to read it."""

if __name__ == "__main__":
    codecs.lookup("ascii")
    become_nobody()
    sys.exit(cli.main(sys.argv[1:]))
