"""Listing III.6 of the design note, every object, decoded: the same as `ethercat-sensor objects`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))  # works from a checkout that is not installed
sys.exit(__import__("ethercat_server.tool.cli", fromlist=["main"]).main(["objects", *sys.argv[1:]]))
