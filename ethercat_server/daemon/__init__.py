"""`ethercat-server`: command line, configuration, one run. May import everything but the programs."""
