# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node: receives the server's stream and publishes it.

Imports `bota_ethercat` and `ft_compensation`, never the server. `client` is the program, `node` the wiring.
A sample's way: `stream`, `compensating`, `publishing`.
"""
