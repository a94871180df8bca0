"""The loop that reads the sensors, and what keeps it going. May import `ethercat`, `sensor`, `protocol`."""
