"""When samples come to be, and when to poll for them: round trips, the sensors' clocks, the schedule."""
