# SPDX-License-Identifier: Apache-2.0
"""Bias, tool and payload of a force/torque sensor: NumPy, no ROS.

`compensator` subtracts, `bias` and `specific_force` tell what, `stationary` whether the sensor
is at rest, `identification` finds the payload. docs/compensation.md.
"""
