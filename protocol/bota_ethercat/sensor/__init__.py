"""What the sensor's values mean: warnings, filters, settings, data types. Tables only."""
