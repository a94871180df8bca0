"""Which sample an exchange brought, its instant, when to poll next: without a bus, a socket or a clock.

`SampleClock` does it for one sensor: `observe` says what an exchange brought, `learn` learns from it, and
`next_poll_ns` says when the next one is due. docs/sample-clock.md has the model. Times are
CLOCK_MONOTONIC_RAW in ns where nothing else is said, variances in ns². Words:

- instant: when the sensor made a sample, in the time of this computer
- outward part: of the shortest round trip, until the frame is at the slave; half of it, as nothing tells more
- excess: time that a round trip takes beyond the shortest recent one
- hit, early: a first poll that found the new sample, or came before it
- event: when the sensor had written a sample (PDI buffer change), as its slave controller latches it
"""
