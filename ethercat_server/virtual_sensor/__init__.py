"""A simulated Bota EtherCAT force/torque sensor with fault injection. Standard library only.

From the wire inwards: `link` (raw socket), `bus` (a chain of slaves, in memory), `esc` and
`distributed_clock` (slave controller), `application` and `mailbox` (what every slave has behind it),
`sensor` with its `dictionary`, `sampler`, `signals`, `world`, `foreign` (other slaves), `faults`.
"""
