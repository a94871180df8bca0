"""`ethercat-monitor --web`: the state and the traces in a browser, on this machine.

`points` reduces frames to what a plot shows, `message` puts a state into words, `viewer` and `hub` decide who
gets what, `access` who may: all without sockets. `server` serves them and the files in `page/`; only it uses
websockets.
"""
