#!/usr/bin/env bash
# mcap 1.6.0 (Python): of a file that was cut off, a pipe gives what is there, but only without time order.
#
# One would guess: a reader yields the messages of all whole chunks and then says that the file ends early; and a file
# on disk gives at least as much as the same bytes through a pipe.
# What happens: from a file that can be sought, nothing at all, with or without order: the index at its end is read
# first, and what is there instead is taken for it. From a pipe, `iter_messages()` reads everything before its first
# message, in order to sort, so it raises with none; `log_time_order=False` yields those of all whole chunks and
# raises then, with struct.error. A user meets it with a recorder that was killed: the data are there, and `try: ...
# except` around the loop shows an empty recording.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check mcap==1.6.0
cat >"$folder/check.py" <<'END'
import io
from importlib.metadata import version

from mcap.reader import make_reader
from mcap.writer import Writer

MESSAGES = 500
file = io.BytesIO()
writer = Writer(file, chunk_size=4096)
writer.start()
channel = writer.register_channel("/wrench", "json", writer.register_schema("Wrench", "jsonschema", b"{}"))
for number in range(MESSAGES):
    writer.add_message(channel, log_time=number, publish_time=number, data=b'{"force": 5.0}')
writer.finish()
whole = file.getvalue()

class Pipe(io.BytesIO):
    def seekable(self):
        return False

def read(source, in_order):
    """How many messages are yielded, and what ends it."""
    count = 0
    try:
        for _ in make_reader(source).iter_messages(log_time_order=in_order):
            count += 1
    except Exception as error:
        return count, f"{type(error).__module__}.{type(error).__name__}"
    return count, "the end"

print("mcap", version("mcap"))
seen = {}
for what, data in (("whole", whole), ("cut off", whole[: len(whole) // 2])):
    for kind, source in (("file", io.BytesIO), ("pipe", Pipe)):
        for in_order in (True, False):
            count, end = seen[what, kind, in_order] = read(source(data), in_order)
            print(f"{what}, {kind}, {'in order' if in_order else 'as written'}: {count} messages, then {end}")
assert all(result == (MESSAGES, "the end") for (what, *_), result in seen.items() if what == "whole")
counts = {key[1:]: count for key, (count, _) in seen.items() if key[0] == "cut off"}
assert counts["pipe", False] > 100, "the behavior has changed"
assert counts["pipe", True] == counts["file", True] == counts["file", False] == 0, "the behavior has changed"
END
"$folder/venv/bin/python" "$folder/check.py"
