"""What a virtual sensor measures: its clock, signals, and process data."""
