#!/usr/bin/env bash
# Rerun 0.41.0: of a valid MCAP file without message indexes, or without chunks, no message is converted; exit code 0.
#
# One would guess: `rerun mcap convert` reads every file that MCAP's specification allows, in which chunks and indexes
# are optional, or says what it does not read.
# What happens: the topic is there, with channel and schema, without a message and without a warning; `--recover` changes
# nothing, and `rerun mcap check` lists no topic and no issue. The reader of the Python library mcap 1.6.0 has all
# messages. A user meets it with `ros2 bag record --storage-preset-profile fastwrite`, which writes no chunks.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check rerun-sdk==0.41.0 mcap==1.6.0
cat >"$folder/check.py" <<'END'
import struct, subprocess, sys
from importlib.metadata import version
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import IndexType, Writer
from rerun.chunk import RrdReader

folder, found = Path(sys.argv[1]), {}
for name, options in {
    "with all": {}, "without message indexes": {"index_types": IndexType.NONE}, "without chunks": {"use_chunking": False},
}.items():
    path, out = folder / f"{name}.mcap", folder / f"{name}.rrd"
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="ros2", library="")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        channel = writer.register_channel("/force", "cdr", schema)
        for number in range(100):
            moment = 10**18 + number * 10**7
            writer.add_message(channel, moment, bytes((0, 1, 0, 0)) + struct.pack("<d", number), moment, number)
        writer.finish()
    with path.open("rb") as file:
        assert sum(1 for _ in make_reader(file).iter_messages()) == 100
    command = [Path(sys.executable).with_name("rerun"), "mcap", "convert", "--recover", path, "-o", out]
    code = subprocess.run(command, capture_output=True).returncode
    batches = [chunk.to_record_batch() for chunk in RrdReader(str(out)).stream()]
    rows = sum(each.num_rows for each in batches if "message_log_time" in each.schema.names)
    print(f"rerun {version('rerun-sdk')}: of 100 messages in a file {name}: {rows}, exit code {code}")
    found[name] = rows, code
expected = {"with all": (100, 0), "without message indexes": (0, 0), "without chunks": (0, 0)}
assert found == expected, "the behavior has changed"
END
"$folder/venv/bin/python" "$folder/check.py" "$folder"
