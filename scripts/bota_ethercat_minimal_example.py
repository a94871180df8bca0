"""The listings of the design note by their names there, links to this file: `ethercat-sensor COMMAND`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # works from a checkout that is not installed
from ethercat_server.tool.cli import main

COMMANDS = {
    "find_ethernet_adapters": ("adapters",),  # III.1
    "read_eeprom": ("eeprom",),  # III.3
    "bota_ethercat_minimal_example": ("read", "0x6000"),  # III.5; stream: ethercat-monitor
    "sensor_configuration_SDO_reader": ("objects",),  # III.6
}
command, *names = COMMANDS[Path(__file__).stem]
sys.exit(main([command, *sys.argv[1:], *names]))
