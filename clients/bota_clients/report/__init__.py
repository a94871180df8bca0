"""`ethercat-report`: one-page sensor health report (HTML), from a recording or a live stream."""
