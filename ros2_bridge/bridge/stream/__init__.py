"""The stream from the server: connection, reader, frame selection. No ROS; imports only `parameters`."""
