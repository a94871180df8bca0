"""`ethercat-monitor`: what the server streams, seen in a terminal or printed.

`reader` feeds `model` from the server; `model` gives a `state`, which is all that the views know: `screen`,
`table` and `json_line`. `app` is the only file that knows Textual.
"""
