"""Access to sensors, directly on the interface or through a running server; used by `tool` and `doctor`."""
