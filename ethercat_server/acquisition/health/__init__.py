"""What the sensors say of themselves, and what their samples show: counted, logged, told to the clients."""
