"""`ethercat-server` as it is, but for pipelining: an exchange begins when the one before is back."""

from __future__ import annotations

import sys

from ethercat_server.daemon.cli import main
from ethercat_server.ethercat.exchange import process_data

if __name__ == "__main__":
    process_data.MOST_IN_FLIGHT = 1
    sys.exit(main())
