"""What the sensor measures: its newest sample as process data at any time, with the faults of it.

Samples come to be on the sensor's own clock. Only those that somebody asks for are made.
"""

from __future__ import annotations

from ethercat_server.virtual_sensor.clock import SampleClock
from ethercat_server.virtual_sensor.dictionary import Dictionary
from ethercat_server.virtual_sensor.disturbance import NO_SATURATION, Disturbances
from ethercat_server.virtual_sensor.measurement import Measurement
from ethercat_server.virtual_sensor.motion import MOTIONS
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.scene import Scene
from ethercat_server.virtual_sensor.signals import FORMULAS, Signal
from protocol.pdo import layout_for


def make_signal(options: SensorOptions) -> Signal:
    """The signal that `options` name."""
    if options.signal in MOTIONS:
        return Scene(options.seed, options.noise, MOTIONS[options.signal]())
    return FORMULAS[options.signal]()


class Sampler:
    """Makes the samples of one life of a sensor, with the settings that its dictionary has.

    All times are CLOCK_MONOTONIC in ns, `now` that of the frame that is answered.

    Attributes:
        clock: when the samples come to be.
        made: how many were made.
        disturbances: what is wrong with its channels; call `disturbed` after changing them.
    """

    def __init__(self, options: SensorOptions, dictionary: Dictionary, now: int) -> None:
        self._dictionary = dictionary
        self._layout = layout_for(options.pdo_size)
        self._signal, self._signal_start = make_signal(options), now
        self.clock = SampleClock(now, int(dictionary.settings()["sinc_length"]), options.ppm)
        self.made = 0
        self.disturbances = Disturbances(options.seed)
        self._warnings, self._warnings_until = 0, -1
        self._stuck = b""
        self._number, self._data = -1, b""
        self._prepared_number, self._prepared = -1, b""
        self.settings_changed(now)

    def newest(self, now: int) -> bytes:
        """The newest process data."""
        if self._stuck:
            return self._stuck
        number = self.disturbances.newest_given(self.clock.number_at(now))
        if number != self._number:
            if number == self._prepared_number:
                self._data = self._prepared
            else:
                self._data = self._make(number)
            self._number = number
        return self._data

    def prepare(self, expected: int) -> None:
        """Make the sample that a frame at the time `expected` will ask for, while there is time."""
        number = self.disturbances.newest_given(self.clock.number_at(expected))
        if number not in (self._number, self._prepared_number) and not self._stuck:
            self._prepared = self._make(number)
            self._prepared_number = number

    def _make(self, number: int) -> bytes:
        self.made += 1
        instant = self.clock.instant(number)
        reading = self._signal.reading(number, instant, (instant - self._signal_start) * 1e-9)
        saturated = NO_SATURATION
        if not self._signal.exact:
            reading, saturated = self.disturbances.apply(reading)
        warnings = self._warnings if number < self._warnings_until else 0
        return self._measurement.pack(reading, warnings, saturated)

    def settings_changed(self, now: int) -> None:
        """The dictionary has other settings or offsets."""
        settings = self._dictionary.settings()
        sinc_length = int(settings["sinc_length"])
        if sinc_length != self.clock.sinc_length:
            self.clock.change(now, sinc_length=sinc_length)
        if isinstance(self._signal, Scene):
            self._signal.set_sinc_length(sinc_length)
        self._measurement = Measurement(
            self._layout,
            settings,
            self._dictionary.offsets(0x8000),
            self._dictionary.offsets(0x8001)[:3],
            self._dictionary.offsets(0x8002)[:3],
            self._signal.exact,
        )
        # The newest sample stays what it is: the change shows from the next one on.
        self._prepared_number = -1

    # Faults.

    def set_warnings(self, bits: int, samples: int | None, now: int) -> None:
        """OR `bits` into the warnings of the next `samples` samples, or of all."""
        self._warnings = bits
        # The newest sample stays as it is: it may have been given away already.
        self._warnings_until = 2**63 if samples is None else self.clock.number_at(now) + 1 + samples
        self._prepared_number = -1

    def stick(self, now: int) -> None:
        """Give the process data of `now` for ever."""
        self._stuck = self.newest(now)

    def unstick(self) -> None:
        """Give the newest again."""
        self._stuck = b""

    def set_signal(self, options: SensorOptions, now: int) -> None:
        """Measure the signal that `options` name, which begins with the next sample."""
        self._signal = make_signal(options)
        self._signal_start = self.clock.instant(self.clock.number_at(now) + 1)
        self.settings_changed(now)

    @property
    def exact(self) -> bool:
        """Whether it measures a signal that nothing may change."""
        return self._signal.exact

    def disturbed(self) -> None:
        """The disturbances were changed: they show from the next sample on."""
        self._prepared_number = -1

    def set_skip(self, percent: float, now: int) -> None:
        """Withhold this share of the samples after the newest one."""
        self.disturbances.set_skip(percent, self.clock.number_at(now))
        self.disturbed()

    def set_ppm(self, ppm: float, now: int) -> None:
        """Another error of the clock, from the newest sample on."""
        self.clock.change(now, ppm=ppm)
        self._prepared_number = -1
