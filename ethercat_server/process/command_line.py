"""Start and end of the command-line programs besides the server: signals, messages, exit codes."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable
from typing import Final

from bota_ethercat.errors import ProtocolError
from bota_ethercat.program.output import is_of_output
from bota_ethercat.program.signals import interrupt_on_signals
from ethercat_server.errors import ServerError
from ethercat_server.process.logs import OneLine

FAILED: Final = 1


def begin(program: str) -> None:
    """What is logged appears as `PROGRAM: message`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(OneLine(program))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])


def run(program: str, work: Callable[[], int], *, as_json: bool) -> int:
    """The exit code: what `work` returns, or that of the error it raises, which is printed as one sentence.

    SIGINT, SIGTERM and SIGHUP raise KeyboardInterrupt in `work`; before, they end the program at once.
    With `as_json` the sentence is on standard output too, as {"error": ...}.
    """
    try:
        interrupt_on_signals()
        return work()
    except (ServerError, ProtocolError) as error:
        text, exit_code = str(error), getattr(error, "exit_code", FAILED)
    except OSError as error:
        if is_of_output(error):  # for `ends_with_its_reader`
            raise
        text = f"{error.filename or 'the operating system'}: {error.strerror or error}"
        exit_code = FAILED
    except KeyboardInterrupt:
        text, exit_code = "stopped", FAILED
    if as_json:
        sys.stdout.write(json.dumps({"error": text}) + "\n")
    sys.stderr.write(f"{program}: {text}\n")
    return exit_code
