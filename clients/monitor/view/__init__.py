"""The views of the monitor: screen, table, JSON."""
