"""The ROS 2 node: receives the server's stream and publishes it.

Imports `protocol`, `protocol.client` and `ft_compensation`, never the server. `client` is the program, `node`
the wiring. A sample's way: `stream`, `compensating`, `publishing`.
"""
