"""The ROS 2 side: receives the server's stream and publishes it.

`client` the program, `node` the wiring, `parameters` (`parameter_row`) what can be set, `signals` SIGINT and
SIGTERM. The stream: `connection` the TCP connection, `selection` which frames are news, `reader` the thread
that does it all, `messages` the ROS messages. How things are: `link` and `watch` what the reader notes,
`poll` what the server says, `observer` and `snapshot` their sum, `health` the judgement, `monitor` the thread
that publishes it. From ROS to the sensor: `requests`, `services`, `settings_parameters`.
"""
