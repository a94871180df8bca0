"""Listing III.5 of the design note, live values without a server: the same as `ethercat-sensor watch`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))  # works from a checkout that is not installed
sys.exit(__import__("ethercat_server.tool.cli", fromlist=["main"]).main(["watch", *sys.argv[1:]]))
