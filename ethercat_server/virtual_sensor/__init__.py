"""A simulated Bota EtherCAT force/torque sensor with fault injection. Standard library only.

From the wire inwards: `link` (raw socket), `bus` (a chain of slaves, in memory), `sensor`, `esc` (slave
controller), `slave` (what every slave has behind it), `firmware`, `measurement` (the sensor's samples),
`foreign` (slaves of other vendors), `faults` (the commands).
"""
