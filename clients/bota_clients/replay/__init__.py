"""`ethercat-replay`: serves a recording over the same protocol as `ethercat-server`."""
