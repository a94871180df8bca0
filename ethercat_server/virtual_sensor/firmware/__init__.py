"""Firmware of the sensor: object dictionary, flash, process data."""
