"""A Bota sensor: its objects, settings, offset. May import `ethercat` and `protocol`."""
