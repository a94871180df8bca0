"""What a report is about: one sensor's frames, from a recording or a live stream."""
