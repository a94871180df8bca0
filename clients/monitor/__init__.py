"""`ethercat-monitor`: the stream of the server, live in a terminal or printed.

`reader` feeds `model` from the server; `model` gives a `state`, which the views show: `screen`, `table` and
`json_line`, and `web` in a browser. Only `app` uses Textual.
"""
