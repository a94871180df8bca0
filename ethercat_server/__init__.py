"""The privileged side: owns the EtherCAT bus and streams the sensor's process data over TCP."""
