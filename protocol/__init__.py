"""The wire protocol between the server and its clients; standard library only, no threads.

`pdo` the process data, `warnings_register` its warnings, `settings` the sensor's settings, `filters` and
`meaning` what they mean, `framing` bytes to messages and back, `bare_json` the same for bare JSON
connections, `json_text` the texts of both, `control` what JSON messages may carry, `errors` every exception,
`address` HOST:PORT as people write it.
None of these opens a socket. `client` does, over `connection`: the small blocking client for programs that
are not on ROS, which nothing else here loads.
"""
