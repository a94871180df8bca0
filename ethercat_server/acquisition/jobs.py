"""Work on the sensors that clients asked for, in steps between two exchanges, so that no sample waits for it.

A step is one or two datagrams. It is taken when there is time for it before the next exchange is due. Each
sensor does one job at a time, in the order asked.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from bota_ethercat.control import ErrorCode
from bota_ethercat.errors import RequestError
from ethercat_server.errors import BusError, CutOffError, SdoAbortError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.slave.coe import Steps
from ethercat_server.sensor.sensor import Sensor

_STEP_NS: Final = 300_000  # a step is begun only with this much time left: an exchange and a margin
# A step is taken at least this often, even on a bus that leaves no time.
_AT_LEAST_EVERY_NS: Final = 20_000_000
_MOST_WAITING: Final = 32
_AWAY: Final = "is lost, or was taken out of OP to be set up"

log = logging.getLogger(__name__)

Done = Callable[[Any, RequestError | None], None]  # called with the job's result, or with why there is none


class _Job(NamedTuple):
    """What is to be done on the sensor `number`; whether it changes how that is set or tared."""

    number: int
    steps: Steps[Any]
    done: Done
    changes: bool


class Jobs:
    """The jobs of all sensors of the bus; `waiting` are those that are not done."""

    def __init__(self, bus: Bus, sensors: Sequence[Sensor]) -> None:
        self._bus = bus
        self._sensors = sensors
        self.waiting: list[_Job] = []
        self._turn = 0
        self._stepped_ns = 0
        self._interrupted = ""

    def start(
        self,
        number: int,
        steps: Steps[Any],
        done: Done,
        *,
        changes: bool = False,
        most: int = _MOST_WAITING,
    ) -> None:
        """Have `steps` done on the sensor `number`; `changes` is for `is_changing`.

        If the sensor is lost meanwhile, CutOffError is raised in `steps`: nothing more can be done on it.
        RequestError if it is lost already, or if `most` jobs wait for it.
        """
        self.check_present(number)
        if sum(job.number == number for job in self.waiting) >= most:
            raise RequestError(
                ErrorCode.BUSY, f"sensor {number} has {most} requests to do already: ask again later"
            )
        self.waiting.append(_Job(number, steps, done, changes))

    def interrupt(self, reason: str) -> None:
        """Raise BusError with this text in the job that is under way, if there is one; from any thread."""
        self._interrupted = reason

    def is_changing(self, number: int) -> bool:
        """Whether a job that changes the sensor `number` is under way or waits."""
        return any(job.changes for job in self.waiting if job.number == number)

    def check_present(self, number: int) -> None:
        """RequestError if the sensor `number` cannot be talked to."""
        if not self._sensors[number].streams:
            raise RequestError(ErrorCode.NOT_READY, f"sensor {number} {_AWAY}: ask again when it is back")

    def step(self, until_ns: int) -> None:
        """Take a step if there is time for one before `until_ns`. To be called only while jobs wait."""
        now = self._bus.clock.monotonic_ns()
        if until_ns - now < _STEP_NS and now - self._stepped_ns < _AT_LEAST_EVERY_NS:
            return
        self._stepped_ns = now
        numbers = sorted({job.number for job in self.waiting})
        self._turn = next((number for number in numbers if number > self._turn), numbers[0])
        self._step(next(job for job in self.waiting if job.number == self._turn))

    def _step(self, job: _Job) -> None:
        # No variable of this frame may hold what is raised in it: with its traceback, that would keep itself
        # alive, and the loop runs without a garbage collector.
        number, steps, done, _ = job
        result: Any = None
        error: RequestError | None = None
        try:
            if not self._sensors[number].streams:
                steps.throw(CutOffError(f"sensor {number} {_AWAY}"))
                raise CutOffError(f"sensor {number} {_AWAY}")
            if not (reason := self._interrupted):
                next(steps)
            else:
                self._interrupted = ""
                steps.throw(BusError(reason))
            return
        except StopIteration as stop:
            result = stop.value
        except RequestError as refused:
            error = RequestError(refused.code, str(refused), **refused.extra)
        except BusError as failed:
            error = refusal(failed)
        except Exception:  # a defect in one request must not stop the acquisition
            log.exception("a request to sensor %d failed", number)
            error = RequestError(
                ErrorCode.INTERNAL, "the request failed by a fault of this program: see its log"
            )
        steps.close()
        self.waiting.remove(job)
        done(result, error)


def refusal(error: BusError) -> RequestError:
    """The error reply for a job that failed."""
    if isinstance(error, SdoAbortError):
        return RequestError(ErrorCode.SENSOR, str(error), abort_code=error.abort_code)
    return RequestError(ErrorCode.NOT_READY, str(error))
