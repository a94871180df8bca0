"""A virtual Bota EtherCAT force/torque sensor: answers real EtherCAT frames, with faults on command.

Standard library only. From the wire inwards: `link` (raw socket), `wire` (frames), `bus` (a chain of
sensors), `sensor` (one sensor), `esc` (its EtherCAT controller), `al`, `sii`, `mailbox`, `coe`,
`dictionary` (its firmware), `signals` and `scene` (what it measures), `faults` (what goes wrong).
"""
