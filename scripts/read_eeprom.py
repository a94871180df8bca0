"""Listing III.3 of the design note, the slaves' EEPROM: the same as `ethercat-sensor eeprom`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))  # works from a checkout that is not installed
sys.exit(__import__("ethercat_server.tool.cli", fromlist=["main"]).main(["eeprom", *sys.argv[1:]]))
