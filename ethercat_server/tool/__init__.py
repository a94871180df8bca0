"""`ethercat-sensor`: inspects and configures sensors, on the bus itself or through a running server."""
