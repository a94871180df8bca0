"""Bias, gravity and payload of a force/torque sensor: NumPy, no ROS. Imports only `protocol`.

`compensator` subtracts, `bias` and `orientation` tell what (bias, gravity), `stationary` whether the sensor
is stationary, `store` keeps the bias, `identification` finds the payload. docs/compensation.md.
"""
