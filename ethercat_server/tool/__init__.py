"""`ethercat-sensor`: looks at sensors and sets them up, on the bus itself or through a running server."""
