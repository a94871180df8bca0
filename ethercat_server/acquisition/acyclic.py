"""Register and mailbox access while sensors stream: one datagram at a time, between two exchanges.

Each task is `Steps`, which never wait: what one asks for is sent as a frame of its own when there is time for
it before the next exchange is due; the loop receives the answer as it does any other frame, and resumes the
task with it. At most one such frame is on its way.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.datagrams import Answer, RegisterAccess, Steps

_FRAME_NS: Final = 100_000  # a frame is sent only with this much time left: it is usually back by then
# One is sent at least this often, even on a bus that leaves no time.
_AT_LEAST_EVERY_NS: Final = 20_000_000
_NEVER_NS: Final = 1 << 62


class Task:
    """Steps, and where they have got to."""

    def __init__(self, steps: Steps[None]) -> None:
        self.steps = steps
        self.access: RegisterAccess | None = None  # what is to be sent
        self.turn = -1  # value of `Acyclic.turn` when the task yielded None: it waits for another
        self.resume_at_ns = 0
        self.begun = self.finished = False


class Acyclic:
    """The tasks of a bus.

    Attributes:
        due_ns: `run` need not be called before.
        awaiting: the task whose answer is awaited; None if none is.
    """

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self.due_ns = 0
        self.awaiting: Task | None = None
        self._tasks: list[Task] = []
        self._answer: Answer | None = None
        self._sent_ns = self._until_ns = 0
        self._silent_turn = -1  # in which an answer was lost

    @property
    def turn(self) -> int:
        """Number of frames that are back: after a lost answer no datagram is sent until it grows."""
        return self._bus.process_data.answered

    def start(self, steps: Steps[None]) -> Task:
        """Have `steps` done."""
        task = Task(steps)
        self._tasks.append(task)
        self.due_ns = 0
        return task

    def throw(self, task: Task, error: Exception) -> None:
        """Raise `error` in a task, at what it waits for."""
        if not task.begun:
            self._resume(task, task.steps.send, None)
        if self.awaiting is task:
            self._end_awaiting()
        if not task.finished:
            self._resume(task, task.steps.throw, error)
            self.due_ns = 0

    def receive(self, frame: bytes) -> None:
        """A frame arrived that answers no exchange: it may be the awaited answer."""
        self._answer = self._bus.match(frame) or self._answer

    def run(self, due_ns: float, now_ns: int) -> None:
        """Resume what has its answer or has waited; send the next frame if there is time before `due_ns`."""
        if self.awaiting is not None:
            if self._answer is None and now_ns < self._until_ns:
                return
            task, answer = self.awaiting, self._answer
            if answer is None:
                self._silent_turn = self.turn
            self._end_awaiting()
            self._resume(task, task.steps.send, answer)
        may_send = self.turn != self._silent_turn and (
            due_ns - now_ns >= _FRAME_NS or now_ns - self._sent_ns >= _AT_LEAST_EVERY_NS
        )
        for task in tuple(self._tasks):
            if task.finished or task.turn == self.turn or now_ns < task.resume_at_ns:
                continue
            if task.access is None:
                self._resume(task, task.steps.send, None)
            if task.access is not None and may_send:
                self._ask(task, task.access, now_ns)
                return
        self.due_ns = min((task.resume_at_ns for task in self._tasks), default=_NEVER_NS)

    def _ask(self, task: Task, access: RegisterAccess, now_ns: int) -> None:
        self._tasks.remove(task)
        self._tasks.append(task)  # round robin
        task.access = None
        self.awaiting, self._sent_ns = task, now_ns
        self._until_ns = self._bus.send(access)

    def _end_awaiting(self) -> None:
        self._bus.give_up()
        self.awaiting = self._answer = None

    def _resume(self, task: Task, resume: Callable[[Any], RegisterAccess | float | None], value: Any) -> None:
        task.begun, task.access, task.resume_at_ns = True, None, 0
        try:
            wanted = resume(value)
        except StopIteration:
            task.finished = True
            self._tasks.remove(task)
            return
        if isinstance(wanted, RegisterAccess):
            task.access = wanted
        elif wanted:
            task.resume_at_ns = self._bus.clock.raw_ns() + int(wanted * 1e9)
        else:
            task.turn = self.turn
