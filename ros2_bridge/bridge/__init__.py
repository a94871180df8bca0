"""The ROS 2 side: receives the server's stream and publishes it.

`client` the program, `node` the wiring, `parameters` what can be set, `connection` the TCP connection,
`selection` which frames are news, `reader` the thread that does it all, `messages` the ROS messages,
`signals` SIGINT and SIGTERM.
"""
