"""A simulated Bota EtherCAT force/torque sensor with fault injection. Standard library only.

From the wire inwards: `link` (raw socket), `bus` (a chain of sensors, in memory), `sensor`, `esc` (its slave
controller), `firmware`, `measurement` (its samples), `faults` (the commands).
"""
