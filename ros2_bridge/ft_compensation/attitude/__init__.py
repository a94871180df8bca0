"""How the sensor is turned: carried on by the gyroscope, leveled by the accelerometer."""
