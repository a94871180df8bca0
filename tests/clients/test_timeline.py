"""When a replayed frame goes out, under which number and stamps."""

from __future__ import annotations

from bota_clients.replay.player import Timeline
from tests.clients.recordings import PERIOD_NS, START_NS, frame

NOW_NS = 50 * 10**9
REAL_NS = 1_800_000_000 * 10**9


class Clock:
    """Both clocks of this machine, as a test sets them."""

    def __init__(self) -> None:
        self.passed_ns = 0

    def monotonic_ns(self) -> int:
        return NOW_NS + self.passed_ns

    def realtime_ns(self) -> int:
        return REAL_NS + self.passed_ns


def timeline(speed: float = 1.0, *, original: bool = False, clock: Clock | None = None) -> Timeline:
    clock = clock or Clock()
    return Timeline(speed, original=original, monotonic_ns=clock.monotonic_ns, realtime_ns=clock.realtime_ns)


def test_moved_stamps_keep_every_nanosecond_between_frames() -> None:
    line = timeline()
    frames = [
        frame(n)._replace(stamp_ns=START_NS + n * 1_250_001 + n % 3, monotonic_ns=n * 1_249_999)
        for n in range(9)
    ]
    due = [line.due(item) for item in frames]
    assert due[0].frame.stamp_ns == REAL_NS
    assert due[0].frame.monotonic_ns == due[0].at_ns == NOW_NS
    for item, (at_ns, moved) in zip(frames, due, strict=True):
        assert moved.stamp_ns - REAL_NS == item.stamp_ns - START_NS
        assert moved.monotonic_ns - NOW_NS == item.monotonic_ns == at_ns - NOW_NS
        assert moved._replace(stamp_ns=0, monotonic_ns=0) == item._replace(stamp_ns=0, monotonic_ns=0)


def test_original_stamps_leave_the_frame_alone() -> None:
    line = timeline(original=True)
    frames = [frame(n + 7) for n in range(3)]
    due = [line.due(item) for item in frames]
    assert [item.frame for item in due] == frames
    assert [item.at_ns - NOW_NS for item in due] == [0, PERIOD_NS, 2 * PERIOD_NS]
    assert line.now(frames[0]) == frames[0]


def test_speed_divides_all_times() -> None:
    line = timeline(speed=4)
    first, second = line.due(frame(0)), line.due(frame(4))
    assert second.at_ns - first.at_ns == PERIOD_NS
    assert second.frame.stamp_ns - first.frame.stamp_ns == PERIOD_NS


def test_a_frame_before_its_turn_is_not_held_back_and_holds_none_back() -> None:
    line = timeline()
    late = frame(1)._replace(monotonic_ns=5 * PERIOD_NS)  # an INVALID one has the time of the exchange
    due = [line.due(item).at_ns - NOW_NS for item in (frame(0), late, frame(2), frame(6))]
    assert due == [0, 5 * PERIOD_NS, 5 * PERIOD_NS, 6 * PERIOD_NS]


def test_again_numbers_go_on_and_there_is_one_period_between() -> None:
    clock = Clock()
    line = timeline(clock=clock)
    for number in range(10, 13):
        last = line.due(frame(number))
    clock.passed_ns = 2 * PERIOD_NS
    line.begin_again()
    first = line.due(frame(10))
    assert first.frame.sequence == last.frame.sequence + 1 == 13
    assert first.at_ns - last.at_ns == PERIOD_NS
    assert first.frame.stamp_ns - last.frame.stamp_ns == PERIOD_NS
    assert line.due(frame(12)).frame.sequence == 15


def test_a_jump_of_the_numbers_is_kept_when_it_begins_again() -> None:
    line = timeline()
    line.due(frame(10))
    line.due(frame(15))
    line.begin_again()
    assert [line.due(frame(n)).frame.sequence for n in (10, 15)] == [16, 21]


def test_across_a_restart_of_the_machine_the_pause_is_that_of_the_stamps() -> None:
    line = timeline()
    line.due(frame(0)._replace(monotonic_ns=900 * 10**9))
    line.reconnected()
    after = frame(0)._replace(monotonic_ns=10**9, stamp_ns=START_NS + 3 * 10**9)
    assert line.due(after).at_ns - NOW_NS == 3 * 10**9
    later = after._replace(monotonic_ns=10**9 + PERIOD_NS, stamp_ns=after.stamp_ns + PERIOD_NS)
    assert line.due(later).at_ns - NOW_NS == 3 * 10**9 + PERIOD_NS


def test_numbers_and_times_stay_in_their_fields() -> None:
    line = timeline()
    line.due(frame(0)._replace(monotonic_ns=2**64 - 1, stamp_ns=2**64 - 1, sequence=2**64 - 1))
    line.begin_again()
    moved = line.due(frame(5)._replace(monotonic_ns=0, stamp_ns=0)).frame
    assert all(0 <= value < 2**64 for value in moved[:3])
    low = line.due(frame(6)._replace(monotonic_ns=2**64 - 1, stamp_ns=2**64 - 1)).frame
    assert low.stamp_ns == low.monotonic_ns == 2**64 - 1
