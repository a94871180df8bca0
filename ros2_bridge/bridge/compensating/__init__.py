"""What to subtract: gravity sources, the bias across restarts, and the control that wires them up."""
