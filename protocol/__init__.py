"""The wire protocol between server and clients, sans-IO: standard library only, no sockets, no threads.

`framing` bytes to messages and back, `control` requests and replies, `accounting` what frames are and what is
missing, `pdo` the process data, `settings` the sensor's settings, `sensor_choice` how a sensor is named,
`address` HOST:PORT, `errors` every exception. `text` has JSON and untrusted text, `sensor` what the sensor's
values mean, `program` what programs do alike. Only `client`, which nothing else here loads, opens sockets.
"""
