"""Time stamps by slave controllers: their event times, on CLOCK_MONOTONIC, once they prove right."""
