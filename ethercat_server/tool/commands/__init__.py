"""The subcommands of `ethercat-sensor`."""
