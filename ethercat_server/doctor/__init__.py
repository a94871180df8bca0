"""`ethercat-doctor`: what keeps the samples from being fresh, and what mends it."""
