"""The constants of the estimator, and what set each: a test, an experiment, or physics."""

from __future__ import annotations

from typing import Final

# -- statistics
# Standard deviations: beyond the first a measurement contradicts the model, beyond the second it cannot be.
CONTRADICTS: Final = 3.0
CERTAIN: Final = 5.0
IN_A_ROW: Final = 4  # contradictions in a row after which what they contradict has started anew
GAIN: Final = 1 / 64  # of running averages of single exchanges and samples
QUICK_GAIN: Final = 1 / 16  # of those that control something
BLOCK_GAIN: Final = 1 / 8  # of those of blocks of exchanges

# -- physics of crystals and of the machine
JITTER_NS: Final = 30.0  # standard deviation of a sample period
DRIFT: Final = 3e-9  # change of its relative rate from sample to sample: 1 ppm in a minute at 1600 Hz
CRYSTAL_ERROR: Final = 200e-6  # standard deviation of its rate's error: 100e-6 by data sheets, and aging
RESOLUTION_NS: Final = 3_000.0  # standard deviation of an instant that no round trip shows
MACHINE_JITTER_NS: Final = 20_000.0  # usual jitter of exchanges and wake-ups before it is measured
PATIENCE_NS: Final = 100_000.0  # an answer that is later than usual by this is overdue
WINDOW_NS: Final = 2_000_000_000  # the shortest round trip is that of the last one or two of these

# -- the sensor's sampling clock
PERIOD_ERROR: Final = 0.001  # standard deviation of its period at first, as part of it
LARGEST_ERROR: Final = 0.03  # the same at most: it is reached after contradictions
KNOWN_ERROR: Final = 4e-6  # the same below which it counts as known
LOCKED: Final = 0.125  # standard deviation of the phase, in periods, below which the clock is followed
UNLIKELY_RUN: Final = 7.0  # negative log-likelihood of a run of late reads: about one in a thousand
WRONG_BIT: Final = 0.005  # probability that a bit is meaningless: from a stall, or of another sample
LEARN_EVERY_NS: Final = 10e6  # interval at which a steady clock learns from a sample

# -- when to poll
EARLY_POLLS: Final = 0.11  # fraction of the samples whose first poll is to be early, as it tells the phase
WASTED: Final = 1.5  # factor by which an early poll costs more where events date samples: nothing is learned
LOSS_PERIODS: Final = 10.0  # cost of a lost sample, as age in periods
POLLS_UNLOCKED: Final = 4  # exchanges per sample while the clock is not followed
UNPROBED: Final = 500  # samples without an early poll after which the phase is probed

# -- event times
EVENT_ERROR_NS: Final = 10_000  # tolerance between the latched times of an event and of a frame's arrival
ASYMMETRY: Final = 1 / 24  # standard deviation of the outward part of a round trip, as part of it
TRIAL_SAMPLES: Final = 100  # in which event times are tried, and of which one may be off
TRIAL_NS: Final = 500_000_000  # time in which they are tried at least
