"""Checks of the bus and its slaves, and the measurement."""
