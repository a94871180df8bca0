"""The exchange of process data: its frames, and what they read of the slave controllers' clocks."""
