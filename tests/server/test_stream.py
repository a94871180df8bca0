"""Which exchanges become frames, with which flags and numbers."""

from __future__ import annotations

from bota_ethercat.framing import DataMessage, FrameDecoder
from ethercat_server.acquisition.clock import SampleClock
from ethercat_server.acquisition.exchange_timing import ExchangeTiming
from ethercat_server.acquisition.stream import DISCARDED_AT_START, GAP, INVALID, REPEATED, SensorStream
from ethercat_server.ethercat.exchange import Exchange
from ethercat_server.simulation.machine import Machine, SimulatedClock

PERIOD_NS = 1_250_000


class Feeder:
    """Feeds a stream exchanges on a simulated clock and decodes what comes out."""

    def __init__(self) -> None:
        self.clock = clock = SimulatedClock(Machine())
        self.timing = ExchangeTiming(clock.now_ns)
        self.stream = SensorStream(0, PERIOD_NS, self.timing, clock)
        self.now = clock.now_ns
        self.sample = 0

    def exchange(
        self, *, new: bool, valid: bool = True, after_ns: int = PERIOD_NS // 4, took_ns: int = 50_000
    ) -> DataMessage | None:
        self.now += after_ns
        self.clock.advance(self.now)
        self.sample += new
        data = self.sample.to_bytes(61, "little")
        self.timing.sent_ns, self.timing.in_flight = self.now - took_ns, True
        exchange = Exchange(self.now - took_ns, self.now, b"", 3, 0)
        made = self.stream.take(data, exchange) if valid else None
        self.timing.in_flight, self.timing.unanswered = False, 0
        if self.stream.finish(exchange) or not valid:
            self.timing.took(self.now - took_ns, self.now, self.now)
            if valid:
                self.stream.clock.learn(self.now)
        if made is None and self.now >= self.stream.idle_at_ns:
            made = self.stream.idle(self.now)
        if made is None:
            return None
        decoder = FrameDecoder()
        decoder.feed(made[0])
        message = decoder.next_message()
        assert isinstance(message, DataMessage)
        assert message.flags == made[2]
        return message

    def start(self) -> Feeder:
        for _ in range(DISCARDED_AT_START):
            assert self.exchange(new=True, after_ns=PERIOD_NS) is None
        return self


def test_each_sample_makes_one_frame_and_polls_between_make_none() -> None:
    feeder = Feeder().start()
    sequences = []
    for _ in range(20):
        message = feeder.exchange(new=True)
        assert message is not None
        assert message.flags == 0
        assert message.wkc == 3
        assert message.process_data == feeder.sample.to_bytes(61, "little")
        sequences.append(message.sequence)
        assert [feeder.exchange(new=False) for _ in range(3)] == [None] * 3
    assert sequences == list(range(20))


def test_what_an_exchange_brought_that_was_held_up_is_not_dated_from_its_end() -> None:
    feeder, stall_ns = Feeder().start(), 50 * PERIOD_NS
    for _ in range(2000):  # before the clock is locked, and after
        assert feeder.exchange(new=True) is not None
        assert [feeder.exchange(new=False) for _ in range(3)] == [None] * 3
        if feeder.stream.clock.locked or feeder.sample == DISCARDED_AT_START + 2:
            held_up = feeder.exchange(new=True, after_ns=stall_ns + PERIOD_NS, took_ns=stall_ns)
            assert held_up is not None
            assert held_up.flags == GAP
            assert held_up.monotonic_ns <= feeder.now - stall_ns + PERIOD_NS
        if feeder.stream.clock.locked:
            return
    raise AssertionError("it never locked")


def test_silence_shows_as_repeated_frames_once_a_period() -> None:
    feeder = Feeder().start()
    feeder.exchange(new=True)
    made = [feeder.exchange(new=False) for _ in range(4 * 20)]
    repeats = [message for message in made if message is not None]
    assert len(repeats) in range(16, 20)
    assert {message.flags for message in repeats} == {REPEATED}
    assert [m.sequence for m in repeats] == list(range(1, len(repeats) + 1))


def test_invalid_exchanges_show_the_last_good_data() -> None:
    feeder = Feeder().start()
    good = feeder.exchange(new=True)
    assert good is not None
    made = [feeder.exchange(new=True, valid=False) for _ in range(40)]
    invalid = [message for message in made if message is not None]
    assert invalid
    assert {m.flags for m in invalid} == {INVALID}
    assert {m.process_data for m in invalid} == {good.process_data}
    assert {m.wkc for m in invalid} == {0}


def test_samples_that_are_discarded_after_a_recovery_are_not_shown_as_the_last_good_ones() -> None:
    feeder = Feeder().start()
    shown = feeder.exchange(new=True)
    assert shown is not None
    feeder.stream.recover(PERIOD_NS)
    assert feeder.exchange(new=True, after_ns=PERIOD_NS) is None
    silent = [feeder.exchange(new=False, valid=False, after_ns=PERIOD_NS) for _ in range(10)]
    frames = [frame for frame in silent if frame is not None]
    assert frames
    for frame in frames:
        assert frame.flags & INVALID
        assert frame.process_data == shown.process_data


def test_a_gap_is_flagged_and_counted() -> None:
    feeder = Feeder().start()
    for _ in range(100):
        feeder.exchange(new=True)
        for _ in range(3):
            feeder.exchange(new=False)
    feeder.sample += 4
    message = feeder.exchange(new=True, after_ns=3 * PERIOD_NS // 8 + 4 * PERIOD_NS)
    assert message is not None
    assert message.flags == GAP
    assert feeder.exchange(new=True, after_ns=PERIOD_NS) is not None
    assert feeder.stream.lost_samples == 4


def test_sequence_goes_on_after_a_recovery_and_the_first_frame_has_gap() -> None:
    feeder = Feeder().start()
    before = feeder.exchange(new=True)
    feeder.stream.recover(PERIOD_NS)
    feeder.start()
    after = feeder.exchange(new=True)
    assert before is not None
    assert after is not None
    assert after.sequence == before.sequence + 1
    assert after.flags == GAP
    assert feeder.stream.recoveries == 1


def test_after_a_recovery_three_samples_are_discarded_and_none_is_counted_as_lost() -> None:
    feeder = Feeder().start()
    feeder.exchange(new=True)
    while not feeder.exchange(new=False, valid=False):
        pass
    feeder.stream.recover(PERIOD_NS)
    early = feeder.exchange(new=False, valid=False, after_ns=PERIOD_NS)
    assert early is None, "it is not silent before it had time for its first samples"
    feeder.start()
    after = feeder.exchange(new=True)
    assert after is not None
    assert after.flags == GAP
    assert feeder.stream.lost_samples == 0


def test_frames_that_are_lost_after_a_recovery_count_as_no_lost_samples() -> None:
    feeder = Feeder().start()
    feeder.exchange(new=True)
    feeder.stream.recover(PERIOD_NS)
    silent = [feeder.exchange(new=False, valid=False) for _ in range(40)]
    assert {frame.flags for frame in silent if frame is not None} == {INVALID}
    feeder.start()
    assert feeder.exchange(new=True) is not None
    assert feeder.stream.lost_samples == 0


def test_the_first_sample_at_all_has_none_before_it() -> None:
    clock = SampleClock(PERIOD_NS, ExchangeTiming())
    clock.take(10**15, 10**15 + 50_000, None, fresh=True)
    assert clock.steps == 1
