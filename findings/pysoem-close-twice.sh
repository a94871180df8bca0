#!/usr/bin/env bash
# pysoem 1.1.13: a second Master.close() closes a descriptor that belongs to something else by then.
#
# One would guess: close() may be called again, as with Python's files and sockets, so `finally: master.close()`
# beside a close() in the program's own way out does no harm.
# What happens: the master keeps the number of its socket, and the second call closes whatever has that number by
# then: a log, a socket, a recording. The call raises nothing; the next write to that file fails with EBADF. A user
# meets it in a program that closes the bus after a fault and again when it ends. Seen with Linux 6.18, CPython 3.11.
# Needs root (a network namespace); 77 without.
set -euo pipefail
[ "$(id -u)" = 0 ] || { echo "needs root for a network namespace"; exit 77; }
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pysoem==1.1.13
cat >"$folder/check.py" <<'END'
import os, sys
from importlib.metadata import version
from pathlib import Path

import pysoem

def written_after(closes: int) -> str:
    master = pysoem.Master()
    master.open("left")
    master.close()
    with open(sys.argv[1], "wb", buffering=0) as log:
        for _ in range(closes - 1):
            master.close()
        try:
            log.write(b"the sensor is lost\n")
        except OSError as error:
            os.open("/dev/null", os.O_RDONLY)  # takes the number, for `with` closes it again
            return f"fails: {error.strerror}"
    return Path(sys.argv[1]).read_text().strip()

print("pysoem", version("pysoem"))
seen = {closes: written_after(closes) for closes in (1, 2)}
for closes, what in seen.items():
    print(f"close() {closes} time(s), then a line in a log that was opened after the first: {what}")
assert seen == {1: "the sensor is lost", 2: "fails: Bad file descriptor"}, "the behavior has changed"
END
# shellcheck disable=SC2016
unshare --net bash -euc '
    ip link add left type veth peer name right
    ip link set left up
    ip link set right up
    "$0/venv/bin/python" "$0/check.py" "$0/log"' "$folder"
