"""What the hub needs of the network: sockets, or connections in memory on a clock that a test advances."""
