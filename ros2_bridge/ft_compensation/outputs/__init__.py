"""What is made of a compensated wrench: another frame, a filter."""
