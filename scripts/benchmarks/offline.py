"""`scripts/benchmark --offline`: what reading a recording costs, beside other libraries."""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

import numpy as np

from bota_clients.recording.file_format import RecordedDescription
from bota_clients.recording.mcap_writer import DiskFile
from bota_clients.recording.writer import RecordingWriter
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import encode
from bota_ethercat.program.arguments import number
from bota_ethercat.settings import start_up_defaults

_RATE_HZ: Final = 800
_FLUSHED: Final = 320  # frames, every 0.4 s
_ROUNDS: Final = 3
_COLUMNS: Final = """
from bota_clients.recording import reader
BEGIN
with reader.open_recording(Path(given)) as recording:
    recording.columns(0)"""
_PEERS: Final = {  # by package
    "mcap": """
from mcap.reader import make_reader
BEGIN
for schema, channel, message in make_reader(open(given, "rb")).iter_messages(): pass""",
    "mcap-ros2-support": """
from mcap_ros2.reader import read_ros2_messages
BEGIN
for message in read_ros2_messages(given): message.ros_msg""",
    "rosbags": """
from rosbags.highlevel import AnyReader
import numpy
BEGIN
with AnyReader([Path(given)]) as bag:
    chosen = [each for each in bag.connections if each.topic == "/ethercat/sensor_0/frames"]
    made = [bag.deserialize(data, each.msgtype) for each, _, data in bag.messages(chosen)]
numpy.array([each.process_data[5:17].view("<f4") for each in made])""",
}
_PROGRAM: Final = "from bota_clients.{0}.cli import main; import sys; main([given, {1}])"
_OURS: Final = {
    "`columns` of a sensor": _COLUMNS,
    "export, Parquet": _PROGRAM.format("export", "out + '.parquet', '--force'"),
    "export, npz": _PROGRAM.format("export", "out + '.npz', '--force'"),
    "export, CSV": _PROGRAM.format("export", "out + '.csv', '--force'"),
    "export, windows at 30 Hz": _PROGRAM.format("export", "out + '.npz', '--force', '--fps', '30'"),
    "report": _PROGRAM.format("report", "'-o', out + '.html', '--force'"),
    "identify": _PROGRAM.format("identify", "'--json'"),
}


def frames(minutes: float) -> Iterator[DataMessage]:
    """A still sensor with noise, in six poses of 20 s, over and over."""
    draw, begin_ns = np.random.default_rng(1), 1_700_000_000 * 10**9
    names = [
        f"{name}.{axis}" for name in ("force", "torque", "acceleration", "angular_rate") for axis in "xyz"
    ]
    sizes = [0.1] * 3 + [0.003] * 3 + [0.002] * 3 + [0.05] * 3
    for block in range(round(minutes * 3)):
        up = np.zeros(3)
        up[block % 3] = 1.0 - 2.0 * (block // 3 % 2)
        mean = np.concatenate([-9.8 * up, np.cross([0, 0, 0.05], -9.8 * up), up, np.zeros(3)])
        for row, values in enumerate((mean + sizes * draw.normal(size=(20 * _RATE_HZ, 12))).tolist()):
            number = block * 20 * _RATE_HZ + row
            data = encode(61, dict(zip(names, values, strict=True)) | {"temperature": 35.0})
            moment_ns = number * 10**9 // _RATE_HZ
            yield DataMessage(number, begin_ns + moment_ns, moment_ns, 0, 0, 3, data)


def make(path: Path, minutes: float) -> int:
    """The recording; its number of samples."""
    writer = RecordingWriter(DiskFile(path, overwrite=True), "benchmark", {})
    settings = {**start_up_defaults(), "sinc_length": 64}
    row = {"sensor": 0, "name": "BFT-SENS-ECAT-M8", "serial": 1, "rate_hz": _RATE_HZ, "settings": settings}
    writer.note(RecordedDescription(0, {"reply": "describe", "ok": True, "protocol": 1, "sensors": [row]}))
    for frame in frames(minutes):
        writer.frame(frame)
        if writer.frames % _FLUSHED == 0:
            writer.flush()
    writer.finish({})
    return writer.frames


def cost(root: Path, code: str, *arguments: str) -> tuple[float, float]:
    """CPU, s, and the most memory, MB, of a process with the packages of a checkout; CPU from BEGIN on."""
    folders = [root, *(root / name for name in ("protocol", "clients", "ros2_bridge"))]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, folders)),
        "OPENBLAS_NUM_THREADS": "1",
    }
    text = f"import sys, time; from pathlib import Path; given, out = sys.argv[1:3]; begun = 0.0\n{code}"
    text = text.replace("BEGIN", "begun = time.process_time()")
    text += "\nPath(out).write_text(str(time.process_time() - begun))"
    process = os.posix_spawn(
        sys.executable, [sys.executable, "-c", text, *arguments], environment,
        file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0), (os.POSIX_SPAWN_DUP2, 1, 2)],
    )  # fmt: skip
    _, status, used = os.wait4(process, 0)
    if status:
        raise SystemExit(f"this fails in {root}:{code}")
    return float(Path(arguments[1]).read_text()), used.ru_maxrss / 1024


def _show(cells: Sequence[str]) -> None:
    print(f"|{'|'.join(cells)}|", flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="scripts/benchmark")
    parser.add_argument("--offline", action="store_true", help="this table: what reading a recording costs")
    parser.add_argument("--minutes", type=number(1, 1000), default=10.0, help="of the recording (10)")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="another one, measured in turns")
    options = parser.parse_args(argv)
    here = Path(__file__).parents[2]
    with tempfile.TemporaryDirectory() as folder:
        path, out = f"{folder}/run.mcap", f"{folder}/out"
        samples = make(Path(path), options.minutes)
        _show(["", "samples/s of CPU", "CPU, s", "MB", "of the other checkout's CPU"])
        _show(["---"] * 5)
        for name, code in [*_PEERS.items(), *_OURS.items()]:
            title, roots = name, [here]
            if name in _PEERS:
                try:
                    title = f"{name} {version(name)}"
                except PackageNotFoundError:
                    continue
            elif options.against:
                roots.append(options.against.resolve())
            turns = [[cost(root, code, path, out) for root in roots] for _ in range(_ROUNDS)]
            cpu_s, megabytes = (statistics.median(turn[0][part] for turn in turns) for part in (0, 1))
            ratio = (
                f"{statistics.median(turn[0][0] / turn[-1][0] for turn in turns):.2f}" if roots[1:] else "-"
            )
            _show([title, f"{samples / cpu_s:,.0f}", f"{cpu_s:.2f}", f"{megabytes:.0f}", ratio])
    return 0


if __name__ == "__main__":
    sys.exit(main())
