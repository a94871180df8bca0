"""The process itself: signals, scheduling, log, systemd. Imports only `ethercat_server.errors`."""
