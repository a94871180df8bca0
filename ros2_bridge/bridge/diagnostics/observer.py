"""Sums up what reader and server know into snapshots, and keeps what "since the last report" means."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Final

from bridge.diagnostics.compensation_state import CompensationState
from bridge.diagnostics.server_status import ServerStatus
from bridge.diagnostics.snapshot import ServerCounts, Snapshot
from bridge.stream.frame_selector import FrameCounts
from bridge.stream.reader import Reader
from bridge.stream.watch import Flags
from protocol.health.observer import p99

_SHORTEST_RATE_S: Final = 0.8
"""A rate measured over less time than this says little."""


class Observer:
    """Call `look` often; after a regular report call `begin_interval`."""

    def __init__(self, reader: Reader, compensation: Callable[[], CompensationState]) -> None:
        """`compensation` tells how it is."""
        self._reader, self._link, self._compensation = reader, reader.link, compensation
        self._poll = ServerStatus()
        self._flags = Flags()
        self._age_us: tuple[float, float] | None = None
        self._rate_hz: float | None = None
        self._fresh, self._fresh_s, self._epoch = 0, self._link.clock.monotonic(), -1
        """The last number of fresh samples, when it changed, and the link's epoch."""
        self._rate_fresh, self._rate_s, self._rate_ns = 0, self._fresh_s, -1
        """Where the rate is measured from: samples, time here, and the newest one's stamp."""
        self._then, self._then_not_finite = FrameCounts(), 0
        self._then_connects = self._then_withheld = self._then_saturated = 0
        self._then_server: ServerCounts | None = None

    def look(self, now_s: float) -> Snapshot:
        """How things are now."""
        link, reader = self._link, self._reader
        described = self._poll.collect(link)
        if described is not None:
            link.described(described)
        counts = dataclasses.replace(reader.counts)
        if link.epoch != self._epoch:
            self._epoch, self._rate_hz = link.epoch, None
            self._rate_fresh, self._rate_s, self._rate_ns = counts.new, now_s, reader.newest_ns
        if counts.new != self._fresh:
            self._fresh, self._fresh_s = counts.new, now_s
        self._flags = self._flags.merge(reader.watch.take_flags())
        status = self._poll.status
        counted = ServerCounts.of(status, link.sensor).since(self._then_server) if status else ServerCounts()
        silent_since_s = max(self._fresh_s, link.since_s)
        sample, compensation = reader.watch.sample, self._compensation()
        return Snapshot(
            sensor=link.sensor,
            address=link.address,
            connected=link.is_connected,
            problem=link.problem,
            is_reachable=link.is_reachable,
            connection_s=now_s - link.since_s,
            connects=link.connects,
            new_connects=link.connects - self._then_connects,
            info=link.info,
            lost=link.lost,
            silent_s=max(now_s - silent_since_s, 0.0),
            rate_hz=self._rate_hz,
            expected_hz=link.rate_hz,
            age_us=self._age_us,
            counts=counts,
            new=_difference(counts, self._then),
            not_finite=reader.not_finite,
            new_not_finite=reader.not_finite - self._then_not_finite,
            flags=self._flags,
            temperature=None if sample is None else sample.temperature,
            server=status,
            new_server=counted,
            answer_s=self._poll.owed_s(now_s),
            settings=link.settings,
            saturated=reader.watch.saturated,
            new_saturated=reader.watch.saturated - self._then_saturated,
            compensation=compensation,
            new_withheld=compensation.withheld - self._then_withheld,
        )

    def measure(self, now_s: float) -> None:
        """Work out rate and ages of the interval that ends; before `look`."""
        ages = self._reader.watch.take_ages()
        self._age_us = None
        if ages and self._link.is_connected and self._link.client.session.same_machine:
            self._age_us = ages[len(ages) // 2] / 1e3, (p99(ages) or 0) / 1e3
        if self._link.epoch != self._epoch:
            return
        fresh, elapsed_s, newest_ns = self._reader.counts.new, now_s - self._rate_s, self._reader.newest_ns
        # By the stamps, as a delay here is none of the sensor's; by the clock if it has become silent.
        span_s = (newest_ns - self._rate_ns) * 1e-9 if self._rate_ns >= 0 else 0.0
        span_s = span_s if span_s >= _SHORTEST_RATE_S else elapsed_s
        self._rate_hz = (fresh - self._rate_fresh) / span_s if elapsed_s >= _SHORTEST_RATE_S else None
        self._rate_fresh, self._rate_s, self._rate_ns = fresh, now_s, newest_ns

    def begin_interval(self, reported: Snapshot, now_s: float) -> None:
        """`reported` was a regular report: what is new counts from there on. Asks the server again."""
        self._flags = Flags()
        self._then, self._then_not_finite = reported.counts, reported.not_finite
        self._then_connects, self._then_withheld = reported.connects, reported.compensation.withheld
        self._then_saturated = reported.saturated
        if reported.server:
            self._then_server = ServerCounts.of(reported.server, self._link.sensor)
        elif not reported.connected:
            self._then_server = None  # the next server counts from 0
        self._poll.ask(now_s)


def _difference(now: FrameCounts, then: FrameCounts) -> FrameCounts:
    return FrameCounts(
        **{
            field.name: getattr(now, field.name) - getattr(then, field.name)
            for field in dataclasses.fields(FrameCounts)
        }
    )
