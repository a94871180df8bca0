"""Listing III.1 of the design note, the network adapters: the same as `ethercat-sensor adapters`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))  # works from a checkout that is not installed
sys.exit(__import__("ethercat_server.tool.cli", fromlist=["main"]).main(["adapters", *sys.argv[1:]]))
