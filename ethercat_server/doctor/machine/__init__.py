"""Checks of the machine: kernel, processors, network interface, other software on it."""
