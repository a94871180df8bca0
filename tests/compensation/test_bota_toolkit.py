"""Side by side with Bota's own `bota-payload-utils`, on the same samples: docs/compensation.md has the table.

scripts/test --long -k bota_toolkit -s     # prints it
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from bota_clients.errors import RecordingError
from bota_clients.identify.cli import main
from bota_clients.identify.tool_file import read_bota, write_bota
from bota_ethercat.replies import SensorInfo
from bota_ethercat.settings import start_up_defaults
from bota_ethercat.stream.timeline import InForce
from bota_ft_compensation.identification.parameter_file import stream_of
from bota_ft_compensation.quantities import Payload
from tests.clients.test_identify import record_felt
from tests.compensation import motion
from tests.compensation.coverage import arrays
from tests.compensation.making import BIAS, SEED, written_parameters
from tests.compensation.motion import IMU, Array, Felt, tool_of
from tests.compensation.motion import Path as Motion
from tests.compensation.test_inertia import FORCE_NOISE, TORQUE_NOISE, rms
from tests.ended import run_here

PACKAGES: Final = "bota-payload-utils==1.0.3", "bota-tf-utils==1.0.13", "bota-control==1.0.7", "numpy<3"
SETTINGS: Final[dict[str, Any]] = start_up_defaults() | motion.settings()
RATE_HZ: Final = 800.0
# Variances of angular rate and its derivative, force, torque, acceleration: as version 1.0.3 reads its keys
# (findings/bota-estimator-noise-keys.sh).
NOISE: Final = (3e-6, 0.1, 0.03, 3e-5, 4e-4)
FROM_S: Final = 5.0

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def toolkit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment of its own."""
    folder = tmp_path_factory.mktemp("bota")
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    pip = [str(folder / "bin/pip"), "install", "-q", "--disable-pip-version-check", *PACKAGES]
    if wheels := os.environ.get("TEST_WHEELS"):
        pip += ["--no-index", "--find-links", wheels]
    if subprocess.run(pip, check=False).returncode:
        pytest.skip(
            "Bota's packages cannot be had from PyPI: run scripts/test --long on x86-64 with a network"
        )
    return folder / "bin/python"


def run(toolkit: Path, what: str, samples: dict[str, Any], *paths: Path) -> str:
    np.savez(held := paths[-1].with_suffix(".npz"), **samples)
    script = Path(__file__).parent / "bota_toolkit.py"
    command = [str(part) for part in (toolkit, script, what, held, *paths)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=held.parent)
    return done.stdout


def shown(felt: Felt, **more: Any) -> dict[str, Any]:
    return {"times": felt.times, "rows": np.hstack(felt[1:]), "imu": np.array(IMU), "noise": NOISE, **more}


def started(at_s: float, path: Motion, begin: Motion = lambda t: (np.zeros((len(t), 3)),) * 2) -> Motion:
    """`begin` until then, and `path` on top of where that is, smoothly within 2 s."""

    def both(t: Array) -> tuple[Array, Array]:
        share = np.clip((t - at_s) / 2.0, 0.0, 1.0)[:, None] ** 3
        (place, angles), (moved, turned) = begin(np.minimum(t, at_s)), path(t)
        return place + share * moved, angles + share * turned

    return both


def measured(path: Motion, tool: Payload, seconds: float, seed: int) -> Felt:
    felt = motion.filtered(path, tool, seconds, SETTINGS, seed=seed, imu=motion.imperfect(seed))
    draw, shape = np.random.default_rng([seed, 7]), felt.force.shape
    return felt._replace(
        force=felt.force + BIAS.force + draw.normal(0.0, FORCE_NOISE, shape),
        torque=felt.torque + BIAS.torque + draw.normal(0.0, TORQUE_NOISE, shape),
    )


def recorded(tool: Payload, seed: int) -> Felt:
    """Ten poses at rest, and 12 s in which the tool is turned to and fro."""
    poses = motion.waypoints(1.4, 1.6, seed, radians=5.0)
    return measured(started(30.0, motion.turned(seed), poses), tool, 42.0, seed)


def ours(felt: Felt, path: Path) -> tuple[bool, str]:
    """Whether ethercat-identify has a result, and what it says."""
    record_felt(path.with_suffix(".mcap"), felt, SETTINGS)
    ended = run_here(main, path.with_suffix(".mcap"), "--yaml", path, "--json")
    return ended.code == 0, ended.err + ended.out


def left_by_ours(felt: Felt, parameters: dict[str, Any]) -> Array:
    stream = stream_of(parameters)
    stream.configure(InForce(SensorInfo(rate_hz=RATE_HZ, settings=SETTINGS, offset=(0.0,) * 6)))
    return stream.compensate(arrays(felt))[0][felt.times >= FROM_S]


@pytest.fixture(scope="module")
def seed() -> int:
    return 41 + 1000 * SEED


@pytest.fixture(scope="module")
def recordings(seed: int) -> dict[str, Felt]:
    """A right one, and others that show no tool, or not this one."""
    felt = recorded(tool_of(seed), seed)
    push = (felt.times % 5.0 < 2.0)[:, None] * np.array([4.0, 0.0, 0.0])
    return {
        "right": felt,
        "sign of the force": felt._replace(force=-felt.force, torque=-felt.torque),
        "angular rate in degrees": felt._replace(rate=np.degrees(felt.rate)),
        "pushed with 4 N in 2 s of 5": felt._replace(force=felt.force + push),
    }


@pytest.fixture(scope="module")
def estimated(
    toolkit: Path, recordings: dict[str, Felt], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, tuple[str, Path]]:
    """By Bota's, with its verdict, of every second sample: its own speed."""
    folder = tmp_path_factory.mktemp("estimated")

    def estimate(name: str) -> tuple[str, Path]:
        path = folder / f"{name}.json"
        every_second = Felt(*(part[::2] for part in recordings[name]))
        return run(toolkit, "estimate", shown(every_second), path).split()[-1], path

    with ThreadPoolExecutor(len(recordings)) as executor:
        return dict(zip(recordings, executor.map(estimate, recordings), strict=True))


def test_both_find_the_tool_and_what_each_refuses(
    recordings: dict[str, Felt], estimated: dict[str, tuple[str, Path]], seed: int, tmp_path: Path
) -> None:
    tool = tool_of(seed)
    assert {verdict for verdict, _ in estimated.values()} == {"successful"}
    theirs, _ = read_bota(estimated["right"][1])
    assert theirs.mass == pytest.approx(tool.mass, rel=0.02)
    assert theirs.center == pytest.approx(tool.center, abs=0.02)
    with pytest.raises(RecordingError, match="which no tool has"):
        read_bota(estimated["sign of the force"][1])
    said = {name: ours(felt, tmp_path / f"{name}.yaml") for name, felt in recordings.items()}
    assert [is_found for is_found, _ in said.values()] == [True, False, False, True]
    assert "the mass would be negative" in said["sign of the force"][1]
    assert "times what the noise explains" in said["pushed with 4 N in 2 s of 5"][1]
    # Of the pushed one, whose poses are touched, how near is a draw: it is told by what is left.
    for name, share, away in (("right", 0.002, 0.0005), ("pushed with 4 N in 2 s of 5", 0.02, 0.005)):
        found = written_parameters(tmp_path / f"{name}.yaml")
        assert found["tool_mass"] == pytest.approx(tool.mass, rel=share)
        assert found["tool_center_of_gravity"] == pytest.approx(tool.center, abs=away)


def test_force_and_torque_left_by_both(
    toolkit: Path,
    recordings: dict[str, Felt],
    estimated: dict[str, tuple[str, Path]],
    seed: int,
    tmp_path: Path,
) -> None:
    """And by Bota's with our tool in its file, whose inertia it takes as it is meant."""
    assert ours(recordings["right"], tmp_path / "ours.yaml")[0]
    parameters = written_parameters(tmp_path / "ours.yaml")
    center, inertia = (tuple(parameters[f"tool_{name}"]) for name in ("center_of_gravity", "inertia"))
    write_bota(tmp_path / "written.json", Payload(parameters["tool_mass"], center, inertia))
    theirs = json.loads(estimated["right"][1].read_text())
    theirs["payload_compensator_config"]["enable_dynamic_compensation"] = True
    (tmp_path / "theirs.json").write_text(json.dumps(theirs))
    tool, left = tool_of(seed), {}
    for name, path in {"turned": motion.turned(seed + 50)}.items():
        felt = measured(started(2.0, path), tool, 10.0, seed)
        for file in ("theirs", "written"):
            run(
                toolkit,
                "compensate",
                shown(felt, tare_s=1.0),
                tmp_path / f"{file}.json",
                tmp_path / "left.npy",
            )
            left[name, file] = np.load(tmp_path / "left.npy")[felt.times >= FROM_S]
        left[name, "ours"] = left_by_ours(felt, parameters)
        figures = {key: (rms(rows[:, :3]), rms(rows[:, 3:])) for key, rows in left.items()}
        print(name, {file: figures[name, file] for file in ("theirs", "written", "ours")})
        for part in (0, 1):
            assert figures[name, "ours"][part] < figures[name, "written"][part]
            assert figures[name, "ours"][part] < figures[name, "theirs"][part]
        assert figures[name, "written"][1] < 1.1 * figures[name, "theirs"][1]
