"""`ethercat-export --at`: each frame has what was measured before it, and nothing that was not measured."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import struct
import sys
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bota_clients.errors import RecordingError
from bota_clients.export.cli import main, parse_options
from bota_clients.export.dataset import Stamped, messages, read_stamps, windows_of
from bota_clients.export.windows import Array, Arrays, Windows
from bota_clients.recording.columns import columns
from bota_clients.recording.reader import open_recording
from bota_ethercat import client
from bota_ethercat.framing import DataMessage
from bota_ethercat.replies import SensorInfo
from bota_ethercat.settings import SettingValue
from bota_ethercat.stream.timeline import InForce
from bota_ft_compensation.identification.parameter_file import write_payload
from bota_ft_compensation.quantities import Payload
from ethercat_server.simulation.server import MemoryChannel, Simulation
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.clients.bags import imu, write_bag
from tests.clients.recordings import PERIOD_NS, START_NS, describe, frame, record, write
from tests.ended import run_here

SETTINGS: dict[str, Any] = {"fir": False, "acceleration_filter": 1, "angular_rate_filter": 3}
TOOL: dict[str, Any] = {
    "tool_mass": 0.8,
    "tool_center_of_gravity": [0.004, -0.006, 0.055],
    "tool_inertia": [1e-3, 2e-3, 3e-3, 1e-4, 0.0, 0.0],
    "bias": [3.0, -1.5, 7.25, 0.2, -0.05, 0.125],
    "accelerometer.offset": [0.1, -0.2, 0.3],
}


def windows(
    path: Path, frames: Iterable[DataMessage], times: Array, length: int = 4, **options: Any
) -> Arrays:
    """Of a recording of these frames."""
    record(path, frames, **SETTINGS)
    with open_recording(path) as recording:
        return joined(windows_of(recording, Stamped(times), Windows(length, **options)))


def joined(blocks: Iterable[Arrays]) -> Arrays:
    made = [*blocks]
    return {name: np.concatenate([block[name] for block in made]) for name in made[0]}


def stamps(*samples: float) -> Array:
    """Frames at these instants, in periods of the sensor."""
    return np.array([START_NS + round(sample * PERIOD_NS) for sample in samples])


def newest(made: Arrays) -> list[list[float]]:
    """The numbers of the samples, which are their force x; -1: empty."""
    found: list[list[float]] = np.nan_to_num(made["force_torque"][:, :, 0], nan=-1.0).tolist()
    return found


@pytest.mark.parametrize("step_s", [-0.3, 0.3, -3600.0])
def test_a_step_of_the_wall_clock_in_the_middle_bends_nothing(tmp_path: Path, step_s: float) -> None:
    def stamp(instant: float) -> int:
        return START_NS + round(instant) + (round(step_s * 1e9) if instant >= 1000.4 * PERIOD_NS else 0)

    frames = [frame(number)._replace(stamp_ns=stamp(number * PERIOD_NS)) for number in range(2000)]
    instants = np.arange(0.1e9, 2.4e9, 1e9 / 30)
    times = np.array([stamp(instant) for instant in instants])
    made = windows(tmp_path / "run.mcap", frames, times)
    assert made["monotonic_ns"] == pytest.approx(instants, abs=PERIOD_NS if step_s > 0 else 1)
    assert made["stamp_ns"].tolist() == times.tolist()


def tared(path: Path, told: Sequence[Any], steps: Sequence[float], *between: Any) -> Path:
    """A second at each of these forces along x, of which the sensor tells that its own offset is so.

    `between` is what follows each frame.
    """
    row = describe(0, **SETTINGS)
    row["sensors"][0] |= {} if told[0] is None else {"offset": [told[0], 0, 0, 0, 0, 0]}
    items: list[Any] = [row]
    for part, (offset, force) in enumerate(zip(told, steps, strict=True)):
        if part:
            six = None if offset is None else [offset, 0, 0, 0, 0, 0]
            items.append({"event": "offset_changed", "sensor": 0, "offset": six})
        values: Any = {"force.x": force}
        for number in range(800 * part, 800 * (part + 1)):
            items += [frame(number, **values), *between]
    write(path, items)
    return path


def test_where_batches_end_changes_no_window(tmp_path: Path) -> None:
    """Each frame is one; none has a sample that a change puts in doubt, which is told only later."""
    tool = {"tool_mass": 0.0, "tool_center_of_gravity": [0, 0, 0], "bias": [1.0, 0, 0, 0, 0, 0]}
    path = tared(tmp_path / "run.mcap", (1.0, 2.0), (5.0, 6.0), {"event": "told"})
    at = np.arange(600, 900) + 0.5
    with open_recording(path) as recording:
        windows = Windows(1, tool=tool | {"sensor_offset": [1.0, 0, 0, 0, 0, 0]})
        made = joined(windows_of(recording, Stamped(stamps(*at)), windows))
    assert made["monotonic_ns"] == pytest.approx(at * PERIOD_NS, abs=1)
    assert made["force_torque_valid"].all()
    doubted = at[~made["force_torque_compensated_valid"][:, 0]]
    assert doubted.tolist() == [*np.arange(717, 800) + 0.5]


@pytest.mark.parametrize(
    ("fir", "announced", "doubted"), [(0, 0, [75, 101]), (1, 0, [75, 101]), (1, 5, [95, 101])]
)
def test_a_changed_offset_puts_the_samples_before_in_doubt_whatever_the_filters_delay(
    fir: bool, announced: int, doubted: list[int]
) -> None:
    """At 100 Hz: 24 samples, where force is late by 1.5 or 12, and two after the change was told. If it was
    announced, by an offset that is not known, only those since then.
    """
    tool = {"tool_mass": 0.0, "tool_center_of_gravity": [0, 0, 0], "bias": [1.0, 0, 0, 0, 0, 0]}
    live = Windows(200, tool=tool | {"sensor_offset": [1.0, 0, 0, 0, 0, 0]})
    settings: dict[str, SettingValue] = {"sinc_length": 512, **SETTINGS, "fir": bool(fir)}
    for begin, end, offset in ((0, 100 - announced, 1.0), (100 - announced, 100, None), (100, 200, 2.0)):
        if begin == end:
            continue
        six = None if offset is None else (offset, 0.0, 0.0, 0.0, 0.0, 0.0)
        live.configure(InForce(SensorInfo(rate_hz=100.0, settings=settings, offset=six)))
        frames = (frame(number) for number in range(begin, end))
        live.add(columns(each._replace(monotonic_ns=each.sequence * 10_000_000) for each in frames))
    valid = live.at(np.array([live.until_ns]))["force_torque_compensated_valid"][0]
    samples = np.arange(len(valid)) + 200 - len(valid)
    found = samples[(~valid) & (samples < 190)]
    assert [found.min(), found.max(), len(found)] == [*doubted, doubted[1] - doubted[0] + 1]


def test_a_bias_is_not_guessed(tmp_path: Path) -> None:
    run, path, frames = tmp_path / "run.mcap", tmp_path / "tool.yaml", tmp_path / "frames.csv"
    frames.write_text(f"timestamp\n{START_NS + 10**8}\n")
    bias, offset = "bias: [3, 0, 0, 0, 0, 0]", "sensor_offset: [0, 0, 0, 0, 0, 0]"

    def said(told: float | None, *parameters: str) -> str:
        tared(run, [told], [3.0])
        rows = ("tool_mass: 0", "tool_center_of_gravity: [0, 0, 0]", *parameters)
        path.write_text("\n".join(["/**:", " ros__parameters:", *(f"  {row}" for row in rows)]))
        ended = run_here(main, run, tmp_path / "out.npz", "--at", frames, "--tool", path, "--force")
        assert ended.code == int("out.npz: " not in ended.err)
        return ended.err

    assert f"{path} does not say with which offset of the sensor its bias was measured" in said(0.0, bias)
    assert f"{run} does not have the sensor's own offset" in said(None, bias, offset)
    assert "does not have a tool's parameters" in said(0.0, bias, "sensor_offset: [1, 2]")
    for wrong, why in (
        ("tool_mass: -0.8", "parameter tool_mass is -0.8: it must be a number from 0 to"),
        ("tool_mass: .nan", "parameter tool_mass is nan: it must be"),
        (
            "tool_center_of_gravity: [4, -6, 55]",
            "parameter tool_center_of_gravity is [4, -6, 55]: it must be",
        ),
        ("tool_center_of_gravity: [0, 0]", "it must be 3 numbers"),
    ):
        assert why in said(None, wrong)
    for fine in ([0.0, bias, offset], [None], [None, "accelerometer: {offset: [0, 0, 0]}"]):
        assert "out.npz: windows" in said(*fine)
    path.write_text(path.read_text().replace("/**", "/bridge"))
    assert run_here(main, run, tmp_path / "out.npz", "--at", frames, "--tool", path, "--force").code == 0
    for text in (
        "",
        "a, b",
        "a: 1",
        "/a: {ros__parameters: 1}",
        "/a: {ros__parameters: {}}\n/b: {ros__parameters: {}}",
    ):
        path.write_text(text)
        ended = run_here(main, run, tmp_path / "out.npz", "--at", frames, "--tool", path, "--force")
        assert "it has no ros__parameters, or those of several nodes" in ended.err


@pytest.mark.parametrize("way", ["stamps", "latency", "clock", "clock set back"])
def test_frames_outside_of_the_recording_have_windows_that_are_not_valid(tmp_path: Path, way: str) -> None:
    """One before the first sample, two within, one after the last, one before this was measured."""
    run, path, out = tmp_path / "run.mcap", tmp_path / "frames.csv", tmp_path / "out.npz"
    frames = [frame(number) for number in range(100, 2000)]
    if way == "clock set back":  # to before the first sample
        frames[900:] = [each._replace(stamp_ns=each.stamp_ns - 10**9) for each in frames[900:]]
    record(run, frames, **SETTINGS)
    at, more = np.array([-50, 500, 1200, 1998.5, 2010]), list[Any]()
    wanted = stamps(*at)
    if way == "latency":
        wanted, more = wanted + 10**8, ["--latency", 0.1]
    elif way == "clock":
        clock = tmp_path / "clock.json"
        clock.write_text(f'{{"stamp_ns": {START_NS}, "monotonic_ns": 0, "drift_ppm": 0}}')
        more = ["--clock", clock]
    elif way == "clock set back":
        wanted[2:] -= 10**9
        wanted[0] -= 10**9
    path.write_text("\n".join(["timestamp", *map(str, wanted)]))
    said = run_here(main, run, out, "--at", path, "--window", 4, *more).err
    assert (
        "windows of 4 samples; those of 3 of 5 frames are not valid: the frames are before or after" in said
    )
    assert said.count("\n") == 1
    made = dict(np.load(out))
    valid = made["force_torque_valid"]
    assert valid.tolist() == [[each] * 4 for each in (False, True, True, False, False)]
    assert (np.isnan(made["force_torque"]).all(axis=2) == ~valid).all()
    assert newest(made)[1:3] == [[498, 499, 500, 501], [1198, 1199, 1200, 1201]]
    if way != "clock set back":
        assert made["monotonic_ns"] == pytest.approx(at * PERIOD_NS, abs=1)
    assert made["stamp_ns"].tolist() == wanted.tolist()
    refused = run_here(main, run, out, "--at", path, "--force", "--strict", *more)
    assert (refused.code, "row 0 of" in refused.err) == (1, True)


def test_every_format_has_the_same(tmp_path: Path) -> None:
    zarr, parquet = pytest.importorskip("zarr"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "run.mcap"
    record(path, (frame(number) for number in range(3000)), **SETTINGS)
    for suffix in ("npz", "parquet", "zarr"):
        given = path, tmp_path / f"run.{suffix}", "--fps", 30, "--window", 8
        assert run_here(main, *given).code == 0
        assert "exists" in run_here(main, *given).err
        assert run_here(main, *given, "--force").code == 0
    table = parquet.read_table(tmp_path / "run.parquet")
    group = zarr.open_group(tmp_path / "run.zarr", mode="r")
    npz = np.load(tmp_path / "run.npz")
    texts = table.schema.metadata[b"bota_ethercat"], str(npz["attributes"])
    for found in (group.attrs["bota_ethercat"], *map(json.loads, texts)):
        first = found["settings"][0]
        assert (first["serial"], found["options"]["window"]) == (100, 8)
        assert first["delay_ms"]["acceleration"] == 1.94
    assert {*table.column_names, "attributes"} == {*group, "attributes"} == {*npz}
    assert len(npz["stamp_ns"]) == 113
    for name in group:
        array, flat = npz[name], np.stack(table[name].to_numpy())
        assert group[name][:].tobytes() == flat.tobytes() == array.tobytes(), name
        assert (group[name].shape, group[name].dtype, flat.dtype) == (array.shape, array.dtype, array.dtype)
        if array.ndim > 1:  # as in a data set of LeRobot v3
            assert table.schema.field(name).type.list_size == array[0].size


def test_a_chunk_of_zarr_that_was_not_copied_is_not_a_force_of_zero(tmp_path: Path) -> None:
    zarr = pytest.importorskip("zarr")
    path, made = tmp_path / "run.mcap", tmp_path / "run.zarr"
    record(path, (frame(number) for number in range(1000)), **SETTINGS)
    assert run_here(main, path, made, "--fps", 30, "--window", 8).code == 0
    chunks = [each for each in (made / "force_torque" / "c").rglob("*") if each.is_file()]
    assert chunks
    for chunk in chunks:
        chunk.unlink()
    assert np.isnan(zarr.open_group(made, mode="r")["force_torque"][:]).all()


DOCS = Path(__file__).parents[2] / "docs"
PAGES = (DOCS / "datasets.md").read_text() + (DOCS / "recording.md").read_text()


@pytest.mark.timeout(600)  # a cluster of Ray begins
@pytest.mark.filterwarnings("ignore:::ray")
@pytest.mark.parametrize("code", re.findall(r"```python\n(.*?)```", PAGES, re.DOTALL))
def test_the_code_of_the_pages_runs(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    for package in re.findall(r"^(?:import|from) (\w+)", code, re.MULTILINE):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    record(Path("run.mcap"), (frame(number) for number in range(1000)), **SETTINGS)
    for suffix in ("npz", "parquet", "zarr"):
        run_here(main, "run.mcap", f"run.{suffix}", "--fps", 30)
    for made in ("samples.parquet", "whole.mcap"):
        run_here(main, "run.mcap", made)
    run_here(main, "run.mcap", "data/")
    shutil.make_archive("run", "zip", "run.zarr")
    Path("runs").mkdir()
    shutil.copy("run.mcap", "runs")
    if "import ray" in code:  # a cluster of two workers
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
        monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
        ray = importlib.import_module("ray")
        ray.init(num_cpus=2, include_dashboard=False)
        request.addfinalizer(ray.shutdown)
    if "lerobot" in code:
        datasets = importlib.import_module("lerobot.datasets.lerobot_dataset")
        features = {name: {"dtype": kind, "shape": (size,), "names": None}
                    for name, kind, size in (("state", "float32", 2), ("stamp_ns", "int64", 1))}  # fmt: skip
        made = datasets.LeRobotDataset.create("me/run", 30, features, "run", use_videos=False)
        stamps = np.load("run.npz")["stamp_ns"]
        for number, stamp in enumerate(stamps):
            row = {"state": np.array([number, 0], np.float32), "stamp_ns": np.array([stamp])}
            made.add_frame(row | {"task": "none"})
            if number in (9, 29, len(stamps) - 1):
                made.save_episode()
        made.finalize()
        data = Path("run/data/chunk-000/file-000.parquet")
        np.testing.assert_array_equal(read_stamps(data, "stamp_ns"), stamps)
    found: dict[str, Any] = {}
    if "LiveWindows" in code:
        _run_live(code, monkeypatch)
    else:
        exec(code, found)
    if zipped := re.search(r"# zipped: (.*)$", code, re.MULTILINE):
        other = found["zarr"].open_group(eval(zipped[1], found), mode="r")
        np.testing.assert_array_equal(other["force_torque"][:], found["force_torque"])
    assert len(found.get("force", range(1000))) == 1000
    assert np.shape(found.get("force_torque", np.zeros((38, 32, 6)))) == (38, 32, 6)
    if "lerobot" in code:
        _check_lerobot(found, np.load("run.npz"))


def _run_live(code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a simulated server, for three images."""
    server, acted = Simulation(SensorOptions(signal="scene")), list[Any]()
    monkeypatch.setattr(
        client, "connect", lambda port: client.Client(port, channel=MemoryChannel(server)).connect()
    )
    write_payload(Path("tool.yaml"), Payload(0.8, (0.004, -0.006, 0.055)), "", ())

    def read() -> tuple[str, int]:
        if len(acted) == 3:
            raise EOFError
        server.run(0.1)
        return "image", server.clock.time_ns()

    camera = SimpleNamespace(read=read)
    with pytest.raises(EOFError):
        exec(code, {"camera": camera, "policy": lambda *given: given, "act": acted.append})
    assert {(image, wrench.shape) for image, wrench, _ in acted} == {("image", (64, 6))}
    assert [int(valid.sum()) > 50 for *_, valid in acted] == [True] * 3


def _check_lerobot(found: dict[str, Any], arrays: Any) -> None:
    """A frame; statistics without empty slots, after LeRobot's tools, too; a batch normalized with them."""
    key, tools = "observation.force_torque", importlib.import_module("lerobot.datasets.dataset_tools")
    wrench, valid = arrays["force_torque"], arrays["force_torque_valid"]
    assert not valid.all(), "or there is nothing to leave out"

    def opened(root: str) -> Any:
        return found["LeRobotDataset"](f"me/{root}", root=root)

    def is_right(root: str, rows: list[int]) -> bool:
        stats, measured = found["load_stats"](Path(root)), wrench[rows][valid[rows]]
        quantiles = {
            name: np.quantile(measured, part, axis=0) for name, part in (("q01", 0.01), ("q90", 0.9))
        }
        return {*stats.get(key, ())} == {*stats["state"]} and all(
            np.allclose(stats[key][name], np.tile(value, 32), atol=1.0) for name, value in quantiles.items()
        )

    dataset, rows = opened("with_force"), [*range(len(valid))]
    assert is_right("with_force", rows)
    frame_20 = dataset[20]
    assert frame_20[key].reshape(32, 6)[-1, 0] == 20 * 800 // 30 + 1
    shutil.copytree("with_force", "again")
    changes: dict[str, tuple[list[int], Any]] = {
        "deleted": (rows[10:], lambda: tools.delete_episodes(dataset, [0], "deleted", "me/deleted")),
        "split/a": (rows[:30], lambda: tools.split_dataset(dataset, {"a": [0, 1]}, "split")),
        "merged": (
            rows + rows[10:],
            lambda: tools.merge_datasets([dataset, opened("deleted")], "m", "merged"),
        ),
        "again": (rows, lambda: tools.recompute_stats(opened("again"))),
    }
    for root, (its_rows, change) in changes.items():
        change()
        assert not is_right(root, its_rows), f"{root}: this is no longer needed"
        found["write_wrench_stats"](Path(root))
        assert is_right(root, its_rows), root
    measured = wrench[valid]
    types = importlib.import_module("lerobot.configs.types")
    step = importlib.import_module("lerobot.processor.normalize_processor").NormalizerProcessorStep
    state, mode = types.FeatureType.STATE, types.NormalizationMode.MEAN_STD
    features = {key: types.PolicyFeature(state, (192,))}
    normalize = step.from_lerobot_dataset(dataset, features, {state: mode})
    observation = normalize({"observation": {key: frame_20[key]}})["observation"][key].reshape(32, 6)
    wanted = (20 * 800 // 30 + 1 - measured[:, 0].mean()) / measured[:, 0].std()
    assert observation[-1, 0] == pytest.approx(wanted, rel=1e-4)


STAMPS = [START_NS + 123_456_789, START_NS + 223_456_000]


def test_a_bag_that_defines_a_type_in_two_ways_is_refused(tmp_path: Path) -> None:
    writing = pytest.importorskip("mcap.writer")
    header = "builtin_interfaces/Time stamp\nstring frame_id"
    nested = f"{'=' * 80}\nMSG: std_msgs/Header\n{header}\n{'=' * 80}\nMSG: builtin_interfaces/Time\n"
    fields = "std_msgs/Header header\nfloat64 force\nfloat64 torque\n"
    swapped = "std_msgs/Header header\nfloat64 torque\nfloat64 force\n"
    for other, refused in ((fields + "# newtons\n", False), (swapped, True)):
        bag = tmp_path / "bag.mcap"
        with bag.open("wb") as file:
            writer = writing.Writer(file)
            writer.start("ros2", "")
            for topic, text in (("/left", fields), ("/right", other)):
                definition = text + nested + "int32 sec\nuint32 nanosec\n"
                schema = writer.register_schema("a_msgs/msg/Load", "ros2msg", definition.encode())
                channel = writer.register_channel(topic, "cdr", schema)
                body = struct.pack("<4BiIIB3xdd", 0, 1, 0, 0, 5, 7, 1, 0, 1.0, 2.0)
                writer.add_message(channel, 1, body, 1)
            writer.finish()
        if refused:
            with pytest.raises(
                RecordingError, match="defines a_msgs/msg/Load in two ways, for /left and /right"
            ):
                list(messages(bag, "/left"))
        else:
            ((stamp_ns, message),) = messages(bag, "/left")
            assert (stamp_ns, message.force, message.torque) == (5_000_000_007, 1.0, 2.0)


def test_stamps_are_read_from_tables_and_bags(tmp_path: Path) -> None:
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "frames.csv"
    for texts in (STAMPS, ["2023-11-14T22:13:20.123456789Z", "2023-11-14T22:13:20.223456000Z"]):
        path.write_text("\n".join(["frame,timestamp", *(f"{n},{text}" for n, text in enumerate(texts))]))
        assert read_stamps(path).tolist() == STAMPS
    path, exact = tmp_path / "frames.parquet", pa.array(STAMPS, pa.timestamp("ns"))
    seconds = pa.array([stamp * 1e-9 for stamp in STAMPS])
    for column in (pa.array(STAMPS), exact, exact.cast(pa.timestamp("us"), safe=False), seconds):
        parquet.write_table(pa.table({"exposed": column}), path)
        assert abs(read_stamps(path, "exposed") - STAMPS).max() < 1000
    bag = write_bag(tmp_path / "bag", "/camera", [imu(stamp) for stamp in STAMPS])
    assert read_stamps(bag, "/camera").tolist() == STAMPS
    (bag.parent / "metadata.yaml").unlink()  # as a recorder leaves it that was killed
    assert read_stamps(bag.parent, "/camera").tolist() == STAMPS
    bag.write_bytes(bag.read_bytes()[:-100])
    with pytest.raises(RecordingError, match=f"^{bag} cannot be read as a bag: .* try 'mcap recover'$"):
        read_stamps(bag.parent, "/camera")
    unset = write_bag(tmp_path / "unset", "/camera", [imu(0), imu(0)])
    with pytest.raises(RecordingError, match=r"times of /camera in .* are all 0"):
        read_stamps(unset, "/camera")


def columns_of_times() -> Iterator[tuple[str, Any, list[Any], bool | None]]:
    """Name, type or none for a CSV file, cells, and whether they are two times; None: nearly STAMPS."""
    pa = pytest.importorskip("pyarrow")
    cells: list[Any]
    exact = [datetime.fromtimestamp(stamp // 10**9, UTC) for stamp in STAMPS]
    one_by_one = [START_NS, START_NS + 10**9]
    for unit, per_unit in {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}.items():
        cells = [stamp // per_unit for stamp in one_by_one]
        for zone in (None, "UTC", "Europe/Zurich"):
            yield f"{unit} {zone}", pa.timestamp(unit, zone), cells, True
        yield f"duration {unit}", pa.duration(unit), cells, False
        whole = [stamp // per_unit for stamp in STAMPS]
        yield f"too coarse {unit}", pa.timestamp(unit), whole, None if per_unit < 10**9 else False
    for kind in (pa.int64(), pa.uint64()):
        yield str(kind), kind, STAMPS, None
    for kind in (pa.int8(), pa.uint8(), pa.int16(), pa.uint16(), pa.int32(), pa.uint32()):
        yield str(kind), kind, [1, 1], False
    for kind in (pa.float64(), pa.decimal128(28, 9), pa.decimal256(60, 9)):
        cells = [Decimal(stamp).scaleb(-9) for stamp in STAMPS]
        yield str(kind), kind, [*map(float, cells)] if pa.types.is_floating(kind) else cells, None
    for kind in (pa.float16(), pa.float32()):
        yield str(kind), kind, [np.float16(1e4) if kind == pa.float16() else 1.7e9, 0.0], False
    texts = [f"{moment:%Y-%m-%dT%H:%M:%S}" for moment in exact]
    for kind in (pa.string(), pa.large_string(), pa.string_view()):
        yield str(kind), kind, ["2023-11-14T22:13:20.123456789Z", "2023-11-14T23:13:20.223456+01:00"], None
    yield "dates", pa.date32(), [each.date() for each in exact], False
    yield "dates in ms", pa.date64(), [each.date() for each in exact], False
    yield "texts of dates", pa.string(), ["2023-11-14", "2023-11-15"], False
    for kind in (pa.time32("s"), pa.time32("ms"), pa.time64("us"), pa.time64("ns")):
        yield str(kind), kind, [each.time() for each in exact], False
    for kind in (pa.list_(pa.int64()), pa.large_list(pa.int64()), pa.list_(pa.int64(), 1)):
        yield str(kind), kind, [[stamp] for stamp in STAMPS], False
    yield "struct", pa.struct([("sec", pa.int64())]), [{"sec": 1}, {"sec": 2}], False
    yield "map", pa.map_(pa.string(), pa.int64()), [[("sec", 1)], [("sec", 2)]], False
    yield "dictionary", pa.dictionary(pa.int32(), pa.int64()), STAMPS, None
    yield "dictionary of texts", pa.dictionary(pa.int32(), pa.string()), texts, False  # the same second
    for kind in (pa.binary(), pa.large_binary(), pa.binary(1)):
        yield str(kind), kind, [b"1", b"2"], False
    yield "bool", pa.bool_(), [True, False], False
    yield "null", pa.null(), [None, None], False
    for cells in (
        ["22:13:20", "22:13:21"], ["2023-11-14", "2023-11-15"], ["true", "false"], ["", ""], ["nan", "nan"],
        ["1.7e12", "1.8e12"], ["1.7e18", "1.8e18"], ["99999999999999999999"] * 2, ["1;2", "3;4"],
        ["NaT", "NaT"], ["now", "today"], ["-9223372036854775808", "1"], ["inf", "1"], ["0", "0"],
    ):  # fmt: skip
        yield f"CSV {cells[0]}", None, cells, False
    yield "CSV s", None, [f"{stamp * 1e-9:.6f}" for stamp in STAMPS], None


@pytest.mark.parametrize("empty", [None, 1, 0])
def test_every_type_that_a_table_can_hold(tmp_path: Path, empty: int | None) -> None:
    """It is read, or refused in a sentence; a cell that is empty is refused by its own row."""
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    for name, kind, given, good in columns_of_times():
        cells = [None if row == empty else cell for row, cell in enumerate(given)]
        path = tmp_path / ("frames.csv" if kind is None else "frames.parquet")
        if kind is None:
            lines = ["timestamp,frame", *(f"{'' if cell is None else cell},1" for cell in cells)]
            path.write_text("\n".join(lines))
        else:
            parquet.write_table(pa.table({"timestamp": pa.array(cells, kind)}), path)
        if good is not False and empty is None:
            wanted = np.array([START_NS, START_NS + 10**9] if good else STAMPS)
            assert abs(read_stamps(path) - wanted).max() <= (0 if good else 10**6), name
            continue
        with pytest.raises(RecordingError) as refused:
            read_stamps(path)
        said = str(refused.value)
        assert str(path) in said, name
        assert "\n" not in said, name
        assert good is False or f"row {empty} (counted from 0) is empty" in said, name


def test_a_sample_whose_time_has_no_date_is_no_warning() -> None:
    refused = str(Stamped(np.array([START_NS])).refusal(0, 1 << 63, 1 << 64))
    assert "the first sample was measured at 2262-04-11T23:47:16.854775807Z" in refused


@pytest.mark.parametrize(
    ("rows", "arguments", "said"),
    [
        ([1.0, 0.9], (), "row 1 of {} (counted from 0) is before the row above it"),
        ([-0.5, 1.0], ("--strict",), "row 0 of {} (counted from 0) is of 2023-11-14T22:13:19.500"),
        ([1.0, 2.0, 2.6, 2.7], ("--strict",), "row 2 of {} (counted from 0) is of 2023-11-14T22:13:22.600"),
        ([-0.5, -0.1], (), "row 0 of {} (counted from 0) is of 2023-11-14T22:13:19.500"),
        ([2.6, 2.7], (), "row 0 of {} (counted from 0) is of 2023-11-14T22:13:22.600"),
        ([1.0, 2.6, 2.55], (), "row 1 of {} (counted from 0) is of 2023-11-14T22:13:22.600"),
        ([-0.1, -0.2, 1.0], (), "row 1 of {} (counted from 0) is before the row above it"),
        ([0.5, 1.5], ("--latency", 1, "--strict"), "row 0 of {} (counted from 0) is of 2023-11-14T22"),
        ([0.5], ("--latency", 1), "row 0 of {} (counted from 0) is of 2023-11-14T22:13:20.500"),
        ([-1.7e9], (), "is of 1970-01-01T00:00:00.000000000Z, and the first sample was measured at 2023-11-"),
        (["0.1", "soon"], (), "{} has no times in a column timestamp (choose one with --column"),
        ([], (), "{} has no times in a column timestamp "),
        ([1.0, 2.0, 2.0], (), "row 2 of {} (counted from 0) has the time of the row above it"),
        (["1700000000", "1700000001"], (), "row 0 of {} (counted from 0) is of 1970-01-01T00:00:01.7"),
        (["1700000000", "1700000001"], (), "it seems to be s since 1970: give integers in ns"),
        (["1700000000100"], (), "it seems to be ms since 1970: give integers in ns"),
        (["1700000000100000"], (), "it seems to be us since 1970: give integers in ns"),
        (["0", "0"], (), "the times of timestamp in {} are all 0: what wrote them, a camera's driver or"),
        (["0", f"{START_NS + 10**8}"], (), "its time was not set (0): leave the row out"),
        (["0.0", "0.033"], (), "its times are of no clock (LeRobot's are frame_index / fps): keep the"),
        ([0.1, ""], (), "row 1 (counted from 0) is empty"),
        ([1.0], ("--column", "t"), "{} has no times in a column t (choose"),
        ([1.0], ("--tool", "{}"), "{} does not have a tool's parameters"),
        ([1.0], ("--tool", "/no/tool.yaml"), "/no/tool.yaml cannot be read: No such file"),
        ([1.0], ("--clock", "{}"), "{} is not what 'ethercat-export align' prints"),
    ],
)  # fmt: skip
def test_what_cannot_be_done_is_said_and_leaves_nothing(
    tmp_path: Path, rows: Sequence[Any], arguments: tuple[Any, ...], said: str
) -> None:
    run, path = tmp_path / "run.mcap", tmp_path / "frames.csv"
    record(run, (frame(number) for number in range(2000)), **SETTINGS)
    texts = [row if isinstance(row, str) else f"{START_NS * 1e-9 + row:.3f}" for row in rows]
    path.write_text("\n".join(["timestamp,exposure", *(f"{text},1" for text in texts)]))
    given = [str(argument).format(path) for argument in arguments]
    ended = run_here(main, run, tmp_path / "out.npz", "--at", path, *given)
    assert ended.code == 1
    assert ended.err.count("\n") == 1
    assert said.format(path) in ended.err
    assert sorted(tmp_path.iterdir()) == [path, run]


@pytest.mark.parametrize(
    "arguments",
    [
        "out.csv --fps 30",
        "out.zarr",
        "out.npz --all",
        "out.csv --tool x",
        "out.npz --fps 30 --at x",
        "out.npz --fps 30 --window 0",
        "out.xlsx",
    ],
)
def test_wrong_usage(arguments: str) -> None:
    assert run_here(main, "run.mcap", *arguments.split()).code == 2


@pytest.mark.parametrize("arguments", ["run.mcap --fps 10 OUT.NPZ", "--fps 10 run.mcap OUT.NPZ"])
def test_options_may_stand_between_the_files(arguments: str) -> None:
    options = parse_options(arguments.split())
    assert (options.recording, options.output, options.suffix) == (Path("run.mcap"), Path("OUT.NPZ"), ".npz")
