"""The sensor's newest sample as process data at any time, with its measurement faults.

Samples follow the sensor's own clock. Only those that are read are computed.
"""

from __future__ import annotations

from collections.abc import Callable

from bota_ethercat.pdo import layout_for
from ethercat_server.virtual_sensor.firmware.dictionary import Dictionary
from ethercat_server.virtual_sensor.measurement.clock import SampleClock
from ethercat_server.virtual_sensor.measurement.disturbance import NO_SATURATION, Disturbances
from ethercat_server.virtual_sensor.measurement.measurement import Measurement
from ethercat_server.virtual_sensor.measurement.motion import MOTIONS
from ethercat_server.virtual_sensor.measurement.scene import Scene
from ethercat_server.virtual_sensor.measurement.signals import FORMULAS, Signal
from ethercat_server.virtual_sensor.options import SensorOptions


def make_signal(options: SensorOptions) -> Signal:
    """The signal in `options`."""
    if options.signal in MOTIONS:
        return Scene(options.seed, options.noise, MOTIONS[options.signal]())
    return FORMULAS[options.signal]


class Sampler:
    """Computes samples from power-on to power-off, with the settings in the dictionary.

    `now` gives the time in ns.

    Attributes:
        clock: instants of the samples.
        made: number of samples computed.
        disturbances: channel faults; call `disturbed` after changing them.
    """

    def __init__(self, options: SensorOptions, dictionary: Dictionary, now: Callable[[], int]) -> None:
        self._dictionary = dictionary
        self._now = now
        self._layout = layout_for(options.pdo_size)
        self._signal, self._signal_start = make_signal(options), now()
        self.clock = SampleClock(now(), dictionary.sinc_in_effect, options.ppm)
        self.made = 0
        self.disturbances = Disturbances(options.seed)
        self._warnings, self._warnings_until = 0, -1
        self._stuck = b""
        self._number, self._data = -1, b""
        self._prepared_number, self._prepared = -1, b""
        self.settings_changed()

    def number_at(self, instant: int) -> int:
        """Number of the newest sample at an instant that is not skipped."""
        return self.disturbances.newest_given(self.clock.number_at(instant))

    def completed(self, number: int) -> int:
        """Instant of a sample: it is in the controller's buffer."""
        return self.clock.instant(number)

    def newest(self, later: int = 0) -> bytes:
        """The newest process data, `later` ns from now."""
        if self._stuck:
            return self._stuck
        number = self.number_at(self._now() + later)
        if number != self._number:
            if number == self._prepared_number:
                self._data = self._prepared
            else:
                self._data = self._make(number)
            self._number = number
        return self._data

    def prepare(self, expected: int) -> None:
        """Compute the sample that a frame at the time `expected` will read, while there is time."""
        number = self.number_at(expected)
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

    def settings_changed(self) -> None:
        """Settings or offsets in the dictionary have changed."""
        settings = self._dictionary.settings()
        sinc_length = self._dictionary.sinc_in_effect
        if sinc_length != self.clock.sinc_length:
            self.clock.change(self._now(), sinc_length=sinc_length)
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
        # The newest sample may have been read already: the change takes effect from the next one on.
        self._prepared_number = -1

    # Faults.

    def set_warnings(self, bits: int, samples: int | None) -> None:
        """OR `bits` into the warnings of the next `samples` samples, or of all."""
        self._warnings = bits
        # The newest sample may have been read already.
        self._warnings_until = 2**63 if samples is None else self.clock.number_at(self._now()) + 1 + samples
        self._prepared_number = -1

    def stick(self) -> None:
        """Repeat the present process data until `unstick`."""
        self._stuck = self.newest()

    def unstick(self) -> None:
        """End `stick`."""
        self._stuck = b""

    def set_signal(self, options: SensorOptions) -> None:
        """Measure the signal in `options`, which begins with the next sample."""
        self._signal = make_signal(options)
        self._signal_start = self.clock.instant(self.clock.number_at(self._now()) + 1)
        self.settings_changed()

    @property
    def exact(self) -> bool:
        """Whether the signal is unaffected by settings, offsets and noise."""
        return self._signal.exact

    def disturbed(self) -> None:
        """The disturbances have changed: they take effect from the next sample on."""
        self._prepared_number = -1

    def set_skip(self, percent: float) -> None:
        """Skip this percentage of the samples after the newest one."""
        self.disturbances.set_skip(percent, self.clock.number_at(self._now()))
        self.disturbed()

    def set_ppm(self, ppm: float) -> None:
        """Set the error of the clock from the newest sample on."""
        self.clock.change(self._now(), ppm=ppm)
        self._prepared_number = -1
