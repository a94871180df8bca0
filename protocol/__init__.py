"""The wire protocol between the server and its clients, without sockets or threads.

`pdo` the process data, `warnings_register` its warnings, `settings` the sensor's settings, `filters` and
`meaning` what they mean, `framing` bytes
to messages and back, `control` what JSON messages may carry, `errors` every exception.
"""
