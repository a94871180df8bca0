"""The model of the monitor: server, sensors, stream."""
