"""`ethercat-report`: one page on how a sensor is, from a recording or a live stream."""
