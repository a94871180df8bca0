"""The object dictionary of a Bota sensor: its entries, finding them by name, reading and writing them."""
