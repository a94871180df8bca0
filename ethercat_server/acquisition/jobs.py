"""Work on the sensors that clients asked for. Each sensor does one job at a time, in the order asked."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from bota_ethercat.control import ErrorCode
from bota_ethercat.errors import RequestError
from ethercat_server.acquisition.acyclic import Acyclic, Task
from ethercat_server.errors import BusError, CutOffError, SdoAbortError
from ethercat_server.ethercat.datagrams import Steps
from ethercat_server.sensor.sensor import Sensor

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

    def __init__(self, acyclic: Acyclic, sensors: Sequence[Sensor]) -> None:
        self._acyclic = acyclic
        self._sensors = sensors
        self.waiting: list[_Job] = []
        self._under_way: dict[int, Task] = {}  # by sensor
        self._cut_off: set[int] = set()  # sensors whose job knows that nothing more can be done
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
        self._begin(number)

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

    def check(self) -> None:
        """To be called while jobs wait: raise in them what has happened meanwhile."""
        for number, task in tuple(self._under_way.items()):
            if not self._sensors[number].streams and number not in self._cut_off:
                self._cut_off.add(number)
                self._acyclic.throw(task, CutOffError(f"sensor {number} {_AWAY}"))
            elif reason := self._interrupted:
                self._interrupted = ""
                self._acyclic.throw(task, BusError(reason))

    def _begin(self, number: int) -> None:
        """Begin the next job on the sensor `number`, if there is one and none is under way."""
        job = next((job for job in self.waiting if job.number == number), None)
        if job is not None and number not in self._under_way:
            self._under_way[number] = self._acyclic.start(self._do(job))

    def _do(self, job: _Job) -> Steps[None]:
        # No variable of this frame may hold what is raised in it: with its traceback, that would keep itself
        # alive, and the loop runs without a garbage collector.
        result: Any = None
        error: RequestError | None = None
        try:
            result = yield from job.steps
        except RequestError as refused:
            error = RequestError(refused.code, str(refused), **refused.extra)
        except BusError as failed:
            error = refusal(failed)
        except Exception:  # a defect in one request must not stop the acquisition
            log.exception("a request to sensor %d failed", job.number)
            error = RequestError(
                ErrorCode.INTERNAL, "the request failed by a fault of this program: see its log"
            )
        self.waiting.remove(job)
        del self._under_way[job.number]
        self._cut_off.discard(job.number)
        job.done(result, error)
        self._begin(job.number)


def refusal(error: BusError) -> RequestError:
    """The error reply for a job that failed."""
    if isinstance(error, SdoAbortError):
        return RequestError(ErrorCode.SENSOR, str(error), abort_code=error.abort_code)
    return RequestError(ErrorCode.NOT_READY, str(error))
