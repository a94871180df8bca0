"""The slave controller (ESC) of a virtual sensor: registers, memory, frames."""
