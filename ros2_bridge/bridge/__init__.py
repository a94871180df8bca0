"""The ROS 2 side: receives the server's stream and publishes it.

`client` the program, `node` the wiring, `parameters` (`parameter_row`) what can be set, `signals` SIGINT and
SIGTERM. The stream: `connection` the TCP connection, `selection` which frames are news, `reader` the thread
that does it all, `messages` the ROS messages. How things are: `link` and `watch` what the reader notes,
`poll` what the server says, `observer` and `snapshot` their sum, `health` the judgement, `monitor` the thread
that publishes it. From ROS to the sensor: `requests`, `services` (`triggers`), `settings_parameters`.
Compensation: `compensation` the mathematics, `compensated_output` what is done with a sample by
`gravity_sources` (`orientation_listener`, `orientation_messages`); `compensation_control` what to do, from
`compensation_parameters` (`live_parameters`) and `bias_keeper` (`kept_bias`); `bias_services`,
`identify_services`, `rest`; `compensation_state` how it is.
"""
