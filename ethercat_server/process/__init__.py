"""The process itself: scheduling, log, privileges. Imports only `ethercat_server.errors`."""
