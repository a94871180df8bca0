"""The constants of the estimator, and the test or the physics that set each, where one does.

The names of tests are those in tests/server/test_sample_clock.py if no other file is said.
"""

from __future__ import annotations

from typing import Final

# -- statistics
# Standard deviations: beyond the first a measurement contradicts the model, beyond the second it cannot be.
CONTRADICTS: Final = 3.0
CERTAIN: Final = 5.0
# Contradictions in a row after which what they contradict has started anew. With 3, and with 6,
# `test_wrong_event_times_are_refused_and_polling_goes_on` fails.
IN_A_ROW: Final = 4
GAIN: Final = 1 / 64  # of running averages of single exchanges and samples
# Of those that control something. With 1/32 `test_follows_a_simulated_sensor_that_sleeps_between_its_samples`
# fails, with 1/8 `test_event_times_that_are_worse_than_polling_are_not_used`.
QUICK_GAIN: Final = 1 / 16

# -- physics of crystals, slave controllers and machines
JITTER_NS: Final = 30.0  # standard deviation of a sample period: sensors seen had less
DRIFT: Final = 3e-9  # change of the relative rate from sample to sample: 1 ppm in a minute at 1600 Hz
RESOLUTION_NS: Final = 3_000.0  # standard deviation of an instant that no round trip shows: PDI reads, events
MACHINE_JITTER_NS: Final = 20_000.0  # usual jitter of exchanges and wake-ups before it is measured
PATIENCE_NS: Final = 100_000.0  # an answer that is later than usual by this is overdue
WINDOW_NS: Final = 2_000_000_000  # the shortest round trip is that of the last one or two of these

# -- the sensor's sampling clock
PERIOD_ERROR: Final = 0.001  # standard deviation of its period at first, as part of it: oscillators have half
# The same at most, after contradictions. With 0.01
# `test_follows_a_simulated_sensor_that_sleeps_between_its_samples` fails.
LARGEST_ERROR: Final = 0.03
KNOWN_ERROR: Final = 4e-6  # the same below which the period counts as known
# Standard deviation of the phase, in periods, below which the clock is followed. With 0.1
# `test_follows_a_simulated_sensor_that_sleeps_between_its_samples` fails.
LOCKED: Final = 0.125
# Probability that a bit is meaningless, from a stall or of another sample. With 0.01
# `test_a_clock_that_restarts_is_found_again` fails.
WRONG_BIT: Final = 0.005
# Negative log-likelihood of a run of late reads that raises the noise: about one run in a thousand. No test
# fails without it.
UNLIKELY_RUN: Final = 7.0
# Interval at which a steady clock learns from a sample. With 5 ms
# `test_event_times_that_are_worse_than_polling_are_not_used` fails.
LEARN_EVERY_NS: Final = 10e6

# -- when to poll
EARLY_POLLS: Final = 0.11  # fraction of the samples whose first poll is to be early, as early ones tell most
# Factor by which an early poll costs more where events date samples, as nothing is learned from it. With 1
# `test_events_date_samples_with_one_exchange_each` fails.
WASTED: Final = 1.4
# Cost of a lost sample, as age in periods. With 3 `test_no_lie_costs_a_sample_on_a_slow_card` fails.
LOSS_PERIODS: Final = 10.0
# Exchanges per sample while the clock is not followed; twice as many per period while a sample is overdue.
POLLS_UNLOCKED: Final = 4
OVERDUE: Final = 2.0  # standard deviations after which a sample should have come
UNPROBED: Final = 500  # samples without an early poll after which the phase is probed

# -- event times
TRIAL_SAMPLES: Final = 100  # in which event times are tried, and of which one may be off
TRIAL_NS: Final = 500_000_000  # time in which they are tried at least
