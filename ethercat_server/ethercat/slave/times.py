"""How long a slave may take: one table, for the start, for a sensor that comes back and for requests in OP.

Real devices are slow: firmware that starts, an EEPROM behind a busy bus, a change of state that initializes
filters. Nothing waits this long for a slave that answers in time.
"""

from __future__ import annotations

from typing import Final

from ethercat_server.ethercat.slave.al import AlState

STATE_S: Final = {AlState.INIT: 5.0, AlState.PREOP: 10.0, AlState.SAFEOP: 10.0, AlState.OP: 10.0}
"""To reach an AL state after it was requested."""
ACKNOWLEDGE_S: Final = 5.0
"""To leave the error of its AL status after it was acknowledged."""
SDO_ANSWER_S: Final = 0.7
"""To answer an SDO request, before the request is sent again."""
SDO_S: Final = 2.1
"""For an SDO transfer in all: frames lost for a moment are no refusal."""
SII_WORD_S: Final = 1.5
"""To read one word of its EEPROM."""
