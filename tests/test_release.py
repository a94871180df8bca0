"""A release: two distributions from one checkout, the same bytes from one commit, and what each installs."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from bota_ethercat.program.version import VERSION
from scripts import completions, ros_packages
from tests.ended import completed
from tests.ros_package.package_files import PACKAGES, ROOT, commands, shared_files
from tests.server.running import free_port, needs_bus

pytestmark = pytest.mark.timeout(600)  # virtual environments are made

CLIENT, BRIDGE = "bota-ethercat", "bota-ethercat-bridge"
DATED: Final = "## [0.1.0] - 2026-01-01\n"
MARKER: Final = "share/ament_index/resource_index/packages"
REPOSITORY: Final = "https://git.bota.test/ft/ethercat"
READ: Final = "from bota_ethercat.client import connect; print(next(iter(connect({}, timeout_s=30.0))).force)"


def project(path: str) -> dict[str, Any]:
    table: dict[str, Any] = tomllib.loads((ROOT / path).read_text())["project"]
    return table


def test_the_release_knows_which_lines_of_the_checkout_are_the_client_distributions() -> None:
    whole, part = project("pyproject.toml"), project("clients/pyproject.toml")
    assert part["optional-dependencies"]["client"] == whole["optional-dependencies"]["client"]
    assert "dependencies" not in part
    marked = re.findall(r'^(\S+) = "(\S+)" # of bota-ethercat$', (ROOT / "pyproject.toml").read_text(), re.M)
    assert dict(marked) == part["scripts"]
    assert part["scripts"].items() <= whole["scripts"].items()


def python(version: str) -> str | None:
    found = shutil.which(f"python{version}", path=f"/usr/bin:{os.environ['PATH']}")
    pyenv = sorted((Path.home() / ".pyenv/versions").glob(f"{version}.*/bin/python3"))
    for candidate in [found, *map(str, pyenv)]:
        with contextlib.suppress(OSError, subprocess.CalledProcessError):
            if candidate:
                subprocess.run([candidate, "-c", "import ensurepip"], check=True, capture_output=True)
                return candidate
    return None


def checkout(folder: Path, changelog: str, repository: str = REPOSITORY) -> Path:
    """This checkout as it is now, committed on one day with that line in its changelog, ready to release."""
    folder.mkdir()
    copy = 'git -C "$1" ls-files -z -co --exclude-standard | tar c -C "$1" --null -T - | tar x'
    subprocess.run(["bash", "-c", copy, "bash", ROOT], cwd=folder, check=True)
    text = (folder / "CHANGELOG.md").read_text()
    (folder / "CHANGELOG.md").write_text(text.replace("## [Unreleased]\n", changelog, 1))
    if repository:
        assert ros_packages.main([repository], folder) == 0
    who = {f"GIT_{who}_{what}": "a@b" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    on = {"GIT_AUTHOR_DATE": "2026-01-01T00:00Z", "GIT_COMMITTER_DATE": "2026-01-01T00:00Z"}
    for words in ("init --quiet", "add --all", "commit --quiet --message release"):
        subprocess.run(["git", *words.split()], cwd=folder, env=os.environ | who | on, check=True)
    return folder


def build(source: Path, into: Path) -> subprocess.CompletedProcess[str]:
    return completed(source / "scripts/release", into)


@pytest.fixture(scope="module")
def wheels() -> Iterator[Path]:
    """What pip is to take everything else from: there is no network here."""
    if (wheels := os.environ.get("TEST_WHEELS")) is None:
        pytest.skip("tools and dependencies come from PyPI: run scripts/test --long with a network")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PIP_NO_INDEX", "1")
        patch.setenv("PIP_FIND_LINKS", wheels)
        patch.setenv("PIP_DISABLE_PIP_VERSION_CHECK", "1")
        yield Path(wheels)


@pytest.fixture(scope="module")
def release(wheels: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("release")
    done = build(checkout(folder / "source", DATED), folder / "made")
    assert done.returncode == 0, done.stderr
    return folder / "made"


def install(release: Path, interpreter: str, environment: Path, distribution: str) -> set[str]:
    """Everything that installing this one brings into an environment of its own."""
    completed(interpreter, "-m", "venv", environment, check=True)
    pip = [f"{environment}/bin/python", "-m", "pip"]
    before = completed(*pip, "freeze", "--all", check=True).stdout
    completed(*pip, "install", "--quiet", "--find-links", release, distribution, check=True)
    after = completed(*pip, "freeze", "--all", check=True).stdout
    return {re.split(r"[=@ ]", line)[0].lower() for line in set(after.split("\n")) - set(before.split("\n"))}


def versions(environment: Path, programs: dict[str, str]) -> set[str]:
    return {completed(environment / "bin" / name, "--version", check=True).stdout for name in programs}


@pytest.mark.long
def test_the_same_commit_gives_the_same_bytes(release: Path, tmp_path: Path) -> None:
    done = build(checkout(tmp_path / "elsewhere", DATED), tmp_path / "again")
    assert done.returncode == 0, done.stderr
    sums = (release / "SHA256SUMS").read_text()
    assert (tmp_path / "again" / "SHA256SUMS").read_text() == sums
    completed("sha256sum", "--check", "--quiet", "SHA256SUMS", check=True, cwd=release)
    kinds = {name.split("-")[0] + name[name.index("0.1.0") + 5 :] for name in re.findall(r"\S+$", sums, re.M)}
    wheel, source = "-py3-none-any.whl", ".tar.gz"
    names = {f"bota_ethercat{part}{kind}" for part in ("", "_bridge") for kind in (wheel, source)}
    assert kinds == names | {"bota_ethercat_bridge.cdx.json"}
    whole, part = (set(zipfile.ZipFile(path).namelist()) for path in sorted(release.glob("*.whl")))
    assert not whole & part  # of bota_ethercat_bridge each has some
    bill = json.loads((release / "bota_ethercat_bridge-0.1.0.cdx.json").read_text())
    assert {"bota-ethercat", "pysoem", "pyroute2"} <= {each["name"] for each in bill["components"]}


@pytest.mark.long
@pytest.mark.parametrize(
    ("changelog", "repository", "left", "arguments", "complaint"),
    [
        ("## [Unreleased]\n", REPOSITORY, "", (), "CHANGELOG.md has no section '## [0.1.0] - DATE'"),
        (DATED, REPOSITORY, "new", (), "the checkout has changes that are not committed"),
        (DATED, "", "", (), "the packages have no repository's URL: give that of this project"),
        (DATED, REPOSITORY, "", ("https://github.com/OWNER/name",), "is no repository's URL: give that of"),
        (DATED, "", "", (REPOSITORY,), "wrote CHANGELOG.rst and URLs of the ROS packages: commit them"),
    ],
)
def test_what_is_no_release_is_refused(
    changelog: str, repository: str, left: str, arguments: tuple[str, ...], complaint: str, tmp_path: Path
) -> None:
    source = checkout(tmp_path / "source", changelog, repository)
    if left:
        (source / left).touch()
    done = completed(source / "scripts/release", tmp_path / "made", *arguments)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert complaint in done.stderr


@pytest.mark.long
@needs_bus
@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13", "3.14"])
def test_each_distribution_in_an_environment_of_its_own(release: Path, version: str, tmp_path: Path) -> None:
    if (interpreter := python(version)) is None:
        pytest.skip(f"Python {version} is not on this machine")
    client, bridge = tmp_path / "client", tmp_path / "bridge"
    assert install(release, interpreter, client, CLIENT) == {CLIENT}
    programs = project("clients/pyproject.toml")["scripts"]
    assert versions(client, programs) == {f"{name} {VERSION}\n" for name in programs}

    assert install(release, interpreter, bridge, BRIDGE) == {BRIDGE, CLIENT, "pysoem", "pyroute2"}
    programs = project("pyproject.toml")["scripts"]
    del programs["bridge-client"], programs["bridge-check-subscription"]  # need ROS
    assert versions(bridge, programs) == {f"{name} {VERSION}\n" for name in programs}
    port = free_port()
    with subprocess.Popen(
        [bridge / "bin/ethercat-server", "virtual", str(port)], stderr=subprocess.PIPE, text=True
    ) as server:
        assert server.stderr is not None
        for line in server.stderr:
            if "streaming" in line:
                break
        read = completed(client / "bin/python", "-c", READ.format(port))
        server.terminate()
        server.stderr.read()
    assert (server.returncode, read.returncode) == (0, 0), read.stderr


@pytest.mark.long
def test_each_wheel_has_what_shells_complete_and_man_shows_of_its_programs(release: Path) -> None:
    whole, part = (set(project(path)["scripts"]) for path in ("pyproject.toml", "clients/pyproject.toml"))
    for wheel, programs in (("bota_ethercat-", part), ("bota_ethercat_bridge-", whole - part)):
        (path,) = release.glob(f"{wheel}*.whl")
        with zipfile.ZipFile(path) as archive:
            names = {name.partition(".data/data/share/")[2] for name in archive.namelist()}
        for place in completions.PLACES.values():
            wanted = {place.format(name) for name in programs if not name.startswith(completions.OF_ROS)}
            assert {name for name in names if Path(name).parent == Path(place).parent} == wanted


@pytest.mark.long
def test_the_bridge_has_its_files_where_ros_looks(release: Path, tmp_path: Path) -> None:
    (wheel,) = release.glob("bota_ethercat_bridge-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = {name.partition(".data/data/")[2] for name in archive.namelist()}
    for name, package in PACKAGES.items():
        assert {f"share/{name}/{file}" for file in {"package.xml", *shared_files(package)}} <= names
        assert f"{MARKER}/{name}" in names
    assert install(release, python("3.11") or "python3", tmp_path / "bota", BRIDGE)
    (export,) = [command for command in commands("ros2-workspace.md") if command.startswith("export")]
    shell = f'{export}; cd "${{AMENT_PREFIX_PATH%%:*}}" && for each in lib/*/client; do $each --help; done'
    environment = os.environ | {"HOME": str(tmp_path)}
    used = completed("bash", "-c", shell, env=environment, check=True)
    assert used.stdout.count("usage: ros2 run bridge client") == 2
