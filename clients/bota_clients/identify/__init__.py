"""`ethercat-identify`: what hangs on the sensor, from a recording in which it was held still in a few
poses."""
