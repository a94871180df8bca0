"""Takes the sensor's offset and the tool's weight off a wrench: the mathematics, free of ROS.

`equations` (arrays) and `compensator` (one sample, fast) are the equations IV.1 to IV.5 of the design note;
`still` tells whether the sensor was at rest; `bias` and `store` take and keep the offset; `orientation`
tells where gravity points; `payload` finds mass, centre of gravity and offset from a few poses.
docs/compensation.md.
"""
