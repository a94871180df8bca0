"""The bus in memory: virtual sensors on a simulated machine, in simulated time. No sockets, no processes."""
