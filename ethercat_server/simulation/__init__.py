"""Bus and clients in memory: virtual sensors on a simulated machine, in simulated time."""
