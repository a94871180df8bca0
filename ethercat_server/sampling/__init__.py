"""Which sample is it, when did it come to be, when to look next: pure, without a bus, a socket or a clock.

`SampleClock` is all of it for one sensor: `observe` says what an exchange brought, `learn` learns from it,
and `next_poll_ns` when the next one is wanted. docs/sample-clock.md has the model. Times are CLOCK_MONOTONIC
in ns where nothing else is said, variances in ns².
"""
