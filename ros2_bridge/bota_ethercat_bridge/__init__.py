# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node: receives the server's stream and publishes it.

Imports `bota_ethercat` and `bota_ft_compensation`, never the server. `client` is the program, `node` wires.
A sample goes one way: `stream` decodes it; `publishing` makes the topics of what was measured;
`compensating` takes bias and tool off, for the other topics of `publishing`.
"""
