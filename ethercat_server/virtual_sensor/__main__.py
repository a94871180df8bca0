"""`python -m ethercat_server.virtual_sensor IFACE`."""

import sys

from ethercat_server.virtual_sensor.cli import main

sys.exit(main())
