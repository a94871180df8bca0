"""scripts/install-service below a temporary root: installs, is repeatable, keeps what was edited, leaves; and
the unit files: what systemd makes of them, and that they leave the server no more than it needs."""

from __future__ import annotations

import configparser
import os
import re
import shutil
import subprocess
import tempfile
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from bota_ethercat.settings import check_settings, start_up_defaults
from ethercat_server.daemon.options import EMPTY, SERVER_SETTINGS, parse_options, read_config
from ethercat_server.ethercat import nic
from ethercat_server.process import realtime
from tests.rights import needs_another_user

ROOT = Path(__file__).parent.parent.parent
UNITS = ROOT / "systemd"
SERVER_UNIT = UNITS / "ethercat-server@.service"
BRIDGE_UNIT = UNITS / "ethercat-bridge.service"
CAPABILITIES = ("CAP_NET_RAW", "CAP_NET_ADMIN", "CAP_SYS_NICE", "CAP_IPC_LOCK")


CONFIGURATION = "/etc/ethercat-server/default.toml"
RECORD = "/var/lib/ethercat-server/installed"


def need_systemd() -> None:
    """Skip where systemd's tools are missing; fail where everything is meant to be checked."""
    missing = [name for name in ("systemd-analyze", "systemd-escape") if shutil.which(name) is None]
    if not missing:
        return
    reason = f"{' and '.join(missing)} missing: sudo apt install systemd (it need not be running)"
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)


def values(unit: Path, key: str) -> list[str]:
    """What follows `key=` in a unit file, one entry a line."""
    lines = unit.read_text().splitlines()
    return [line.partition("=")[2] for line in lines if line.startswith(key + "=")]


def install_service(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(ROOT / "scripts" / "install-service"), *arguments], check=False, capture_output=True, text=True
    )


class Stage:
    """A root directory to install into, with programs that do nothing in the place of the real ones."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.prefix = path / "opt" / "ethercat-server"
        for program in (
            self.prefix / "bin" / "ethercat-server",
            self.prefix / "bridge" / "bin" / "bridge-client",
        ):
            program.parent.mkdir(parents=True, exist_ok=True)
            program.write_text("#!/bin/sh\n")
            program.chmod(0o755)

    def run(self, *arguments: str) -> str:
        """What install-service says; it must succeed."""
        done = install_service("--root", str(self.path), *arguments)
        assert done.returncode == 0, done.stderr
        return done.stderr

    def install(self, *arguments: str) -> str:
        return self.run("--keep-environment", *arguments)

    def files(self) -> dict[str, str]:
        """Every installed file outside the virtual environment, with its content."""
        return {
            f"/{path.relative_to(self.path)}": path.read_text()
            for path in sorted(self.path.rglob("*"))
            if path.is_file() and self.prefix not in path.parents
        }


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    need_systemd()
    return Stage(tmp_path / "stage")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Stage, str]:
    """A whole installation, and what was said; not to be changed."""
    need_systemd()
    made = Stage(tmp_path_factory.mktemp("installed") / "stage")
    return made, made.install("--bridge", "ens5", "13000")


@pytest.fixture
def copied(installed: tuple[Stage, str], tmp_path: Path) -> Stage:
    """The same, to be changed."""
    return Stage(Path(shutil.copytree(installed[0].path, tmp_path / "stage")))


def test_everything_gets_its_place(installed: tuple[Stage, str]) -> None:
    files, said = installed[0].files(), installed[1]
    assert set(files) == {
        CONFIGURATION,
        "/etc/ethercat-server/bridge.yaml",
        "/etc/ethercat-server/ens5.env",
        "/etc/NetworkManager/conf.d/90-ethercat-server-ens5.conf",
        "/etc/systemd/network/05-ethercat-server-ens5.network",
        "/etc/systemd/system/ethercat-bridge.service",
        "/etc/systemd/system/ethercat-server@.service",
        "/etc/sysusers.d/ethercat-server.conf",
        RECORD,
    }
    assert "\nPORT=13000\n" in files["/etc/ethercat-server/ens5.env"]
    assert not [path for path in set(files) - {RECORD} if f"wrote {path}\n" not in said]


def test_network_managers_leave_the_interface_alone(installed: tuple[Stage, str]) -> None:
    files = installed[0].files()
    manager, networkd = configparser.ConfigParser(), configparser.ConfigParser()
    manager.read_string(files["/etc/NetworkManager/conf.d/90-ethercat-server-ens5.conf"])
    section = manager["device-ethercat-ens5"]
    assert (section["match-device"], section["managed"]) == ("interface-name:ens5", "0")
    networkd.read_string(files["/etc/systemd/network/05-ethercat-server-ens5.network"])
    assert (networkd["Match"]["Name"], networkd["Link"]["Unmanaged"]) == ("ens5", "yes")


def test_units_name_their_folder_and_an_interface_with_a_dash_is_escaped_for_systemd_only(
    stage: Stage,
) -> None:
    stage.prefix.rename(stage.path / "opt" / "elsewhere")
    stage.install("--prefix", "/opt/elsewhere", "--bridge", "enp3s0-1")
    files = stage.files()
    for path, text in files.items():
        assert not path.endswith(".service") or "/opt/ethercat-server" not in text, path
    unit = files["/etc/systemd/system/ethercat-bridge.service"]
    assert "Wants=ethercat-server@enp3s0\\x2d1.service\n" in unit
    assert "/etc/ethercat-server/enp3s0-1.env" in files


def test_a_second_time_changes_nothing(copied: Stage) -> None:
    before = copied.files()
    said = copied.install("--bridge", "ens5")
    after = copied.files()
    assert sorted(before.pop(RECORD).splitlines()) == sorted(after.pop(RECORD).splitlines())
    assert before == after
    assert "wrote" not in said


def test_another_port_and_a_second_interface_and_the_end_of_all(copied: Stage) -> None:
    copied.install("ens5", "13001")
    copied.install("ens6", "13002")
    files = copied.files()
    assert "\nPORT=13001\n" in files["/etc/ethercat-server/ens5.env"]
    assert "\nPORT=13002\n" in files["/etc/ethercat-server/ens6.env"]
    (copied.prefix / "pyvenv.cfg").touch()
    edited = copied.path / CONFIGURATION[1:]
    edited.write_text(edited.read_text() + "# mine\n")
    said = copied.run("--uninstall")
    assert set(copied.files()) == {CONFIGURATION}
    assert f"kept {CONFIGURATION}, which was edited" in said
    assert not copied.prefix.exists()
    assert "nothing is installed" in copied.run("--uninstall")


def test_a_dry_run_says_what_would_be_done_and_does_nothing(copied: Stage, tmp_path: Path) -> None:
    fresh = Stage(tmp_path / "fresh")
    said = fresh.run("--dry-run", "--keep-environment", "--bridge", "ens5")
    assert fresh.files() == {}
    assert "would write /etc/systemd/system/ethercat-bridge.service\n" in said
    install, start, watch = said.splitlines()[-3:]
    assert f"first: sudo {ROOT}/scripts/install-service " in install
    assert start.startswith(
        "install-service: next: systemctl enable --now 'ethercat-server@ens5' ethercat-bridge "
    )
    assert "then: journalctl -fu 'ethercat-server@ens5'" in watch
    before = copied.files()
    (copied.prefix / "pyvenv.cfg").touch()
    edited = copied.path / CONFIGURATION[1:]
    edited.write_text(before[CONFIGURATION] + "# mine\n")
    before = copied.files()
    said = copied.run("--dry-run", "--uninstall")
    assert copied.files() == before
    assert copied.prefix.exists()
    assert f"kept {CONFIGURATION}, which was edited" in said
    assert "would remove /etc/ethercat-server/ens5.env\n" in said
    assert "would remove /opt/ethercat-server\n" in said


def test_edited_configuration_is_kept_and_an_old_unit_is_not(copied: Stage) -> None:
    edited = copied.path / CONFIGURATION[1:]
    edited.write_text("[sensor]\nfir = true\n")
    unit = copied.path / "etc/systemd/system/ethercat-server@.service"
    new_unit = unit.read_text()
    unit.write_text("[Service]\n")
    assert f"{CONFIGURATION} was edited and is kept" in copied.install("ens5")
    assert edited.read_text() == "[sensor]\nfir = true\n"
    assert unit.read_text() == new_unit


def test_uninstall_leaves_nothing_that_was_not_edited_and_touches_no_folder_of_others(copied: Stage) -> None:
    (copied.prefix / "precious").touch()
    copied.run("--uninstall")
    assert not copied.files()
    assert [path.name for path in copied.path.iterdir()] == ["opt"], "no empty folders"
    assert (copied.prefix / "precious").exists()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "got 0 arguments"),
        (["ens5", "12001", "more"], "got 3 arguments"),
        (["en/s5"], "'en/s5' is not an interface name"),
        (["a-name-too-long-for-linux"], "is not an interface name"),
        (["lo"], "'lo' is not an interface name"),
        (["ens5", "port"], "port 'port' must be from 1024 to 65535"),
        (["ens5", "80"], "port '80' must be from 1024 to 65535"),
        (["ens5", "65536"], "port '65536' must be from 1024 to 65535"),
        (["--prefix", "relative", "ens5"], "--prefix takes an absolute path"),
        (["--prefix", "/usr", "ens5"], "must be a folder of its own"),
        (["--prefix"], "--prefix takes an absolute path"),
        (["--prefix", "/opt/a b", "ens5"], "only letters, digits"),
        (["--quick", "ens5"], "unknown option --quick"),
        (["--uninstall", "ens5"], "--uninstall takes no arguments"),
    ],
)
def test_wrong_arguments_are_answered_with_one_sentence(arguments: list[str], complaint: str) -> None:
    need_systemd()
    done = install_service(*arguments)
    assert done.returncode == 2
    assert complaint in done.stderr
    assert done.stderr.count("\n") == 1


@needs_another_user
def test_it_needs_root() -> None:
    need_systemd()
    with tempfile.TemporaryDirectory() as folder:  # one that anybody can read, unlike tmp_path
        scripts = Path(shutil.copytree(ROOT / "scripts", Path(folder) / "scripts"))
        Path(folder).chmod(0o755)
        done = subprocess.run(
            ["setpriv", "--reuid=nobody", "--clear-groups", scripts / "install-service", "ens5"],
            check=False, capture_output=True, text=True,
        )  # fmt: skip
    assert done.returncode == 1
    assert "needs root: sudo " in done.stderr
    assert done.stderr.count("\n") == 1


IN_A_MACHINE_OF_ITS_OWN = """
set -e
mount -t tmpfs tmpfs "$1"
mkdir "$1/etc" "$1/opt" "$1/lib"
cp -r --no-preserve=ownership /etc/. "$1/etc" 2>/dev/null || true  # what an ordinary user may read
rm -rf "$1/etc/ethercat-server"
for place in etc opt; do mount --bind "$1/$place" "/$place"; done
mount --bind "$1/lib" /var/lib
mount -t tmpfs tmpfs /run
mkdir -p /opt/ethercat-server/bin
cp /bin/true /opt/ethercat-server/bin/ethercat-server
touch /opt/ethercat-server/pyvenv.cfg
cd "$2"
refused=0
scripts/install-service --keep-environment virtual || refused=$?
scripts/install-service --no-start --dry-run --keep-environment virtual
echo "refused with $refused, files $(find /etc/ethercat-server /var/lib -type f 2>/dev/null | wc -l)"
before=$(find /etc /opt /var/lib -type d | sort)
rm -rf /etc/systemd
scripts/install-service --no-start --keep-environment virtual
getent passwd ethercat ethercat-bridge
echo "installed $(find /etc/ethercat-server /opt /var/lib -type f | wc -l)"
echo "network managers told $(find /etc -path '*etwork*ethercat*' | wc -l)"
scripts/install-service --uninstall
echo "left $(find /etc/ethercat-server /opt /var/lib -type f 2>/dev/null | wc -l)"
echo "folders $(comm -13 <(echo "$before") <(find /etc /opt /var/lib -type d | sort) | wc -l)"
[ ! -e /etc/systemd ]
"""
"""The real thing, without --root: in a mount namespace with an /etc, /opt, /var/lib and /run of its own."""


@pytest.mark.skipif(ROOT.parts[1] in {"etc", "opt", "run"}, reason="the checkout would be hidden")
def test_without_a_staging_root_it_makes_users_and_cleans_up(tmp_path: Path) -> None:
    need_systemd()
    enter = ["unshare", "--mount"]
    if subprocess.run([*enter, "mount", "-t", "tmpfs", "tmpfs", tmp_path], check=False).returncode:
        pytest.skip("no mount namespaces here: run as root")
    done = subprocess.run(
        [*enter, "bash", "-c", IN_A_MACHINE_OF_ITS_OWN, "bash", tmp_path, ROOT],
        check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    refused, *users = done.stdout.splitlines()[:3]
    files = done.stdout.splitlines()[3:]
    assert refused == "refused with 1, files 0"
    assert "systemd does not run here, so no service could start: " in done.stderr
    assert "would write /etc/systemd/system/ethercat-server@.service" in done.stderr
    assert [line.split(":")[0] for line in users] == ["ethercat", "ethercat-bridge"]
    assert all(line.endswith("nologin") for line in users)
    assert files == ["installed 5", "network managers told 0", "left 0", "folders 0"]
    assert "systemd does not run here: nothing starts it" in done.stderr


@pytest.mark.parametrize(("file", "extra"), [("requirements.txt", ""), ("requirements-bridge.txt", "ros")])
def test_the_lock_files_have_what_the_package_needs_with_hashes(file: str, extra: str) -> None:
    """scripts/lock renews them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    needed = project["build-system"]["requires"] + project["project"]["dependencies"]
    needed += project["project"]["optional-dependencies"].get(extra, [])
    pins = (UNITS / file).read_text().replace("\\\n", "").splitlines()
    locked = {pin.split("==")[0]: pin.split("==")[1].split()[0] for pin in pins}
    assert all("--hash=sha256:" in pin for pin in pins)
    for requirement in map(Requirement, needed):
        assert requirement.specifier.contains(locked[requirement.name.lower()]), requirement


@pytest.mark.long
def test_the_program_finds_its_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """pip for real, with packages that were downloaded before: there is no network here."""
    need_systemd()
    if (wheels := os.environ.get("TEST_WHEELS")) is None:
        pytest.skip("pip needs packages to install: run scripts/test --long with a network")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", wheels)
    done = install_service("--root", str(tmp_path), "ens5")
    assert done.returncode == 0, done.stderr
    programs = tmp_path / "opt/ethercat-server/bin"
    shebang, *_ = (programs / "ethercat-server").read_text().splitlines()
    assert shebang == "#!/opt/ethercat-server/bin/python"
    version = subprocess.run(
        [programs / "python", "-I", "-m", "ethercat_server.daemon.cli", "--version"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert version.stdout.startswith("ethercat-server ")


MOST_EXPOSURE = 2.5


def analyze(*arguments: str, units: Path | None = None) -> subprocess.CompletedProcess[str]:
    # The colon adds the system's own units, of which ours need some targets.
    path = {"SYSTEMD_UNIT_PATH": f"{units}:"} if units else {}
    return subprocess.run(
        ["systemd-analyze", *arguments],
        check=False, capture_output=True, text=True, env={**os.environ, **path, "LC_ALL": "C"},
    )  # fmt: skip


def test_the_installed_units_are_without_fault(stage: Stage) -> None:
    stage.install("--bridge", "enp3s0-1")
    folder = stage.path / "etc/systemd/system"
    units = [folder / SERVER_UNIT.name, folder / BRIDGE_UNIT.name]
    for unit in units:
        unit.write_text(unit.read_text().replace("/opt/ethercat-server", str(stage.prefix)))
    checked = analyze("verify", "--man=no", "--recursive-errors=no", *map(str, units), units=folder)
    ours = [line for line in checked.stderr.splitlines() if "ethercat" in line]
    assert not ours
    assert checked.returncode == 0, checked.stderr


@pytest.mark.parametrize("unit", [SERVER_UNIT, BRIDGE_UNIT], ids=lambda unit: unit.name)
def test_little_is_exposed(unit: Path) -> None:
    need_systemd()
    checked = analyze("security", "--offline=true", f"--threshold={MOST_EXPOSURE * 10:.0f}", str(unit))
    assert checked.returncode == 0, checked.stdout + checked.stderr


@pytest.mark.parametrize(
    ("unit", "key", "expected"),
    [
        (SERVER_UNIT, "AmbientCapabilities", [" ".join(CAPABILITIES)]),
        (SERVER_UNIT, "CapabilityBoundingSet", [" ".join(CAPABILITIES)]),
        (SERVER_UNIT, "LimitRTPRIO", ["99"]),
        (SERVER_UNIT, "LimitMEMLOCK", ["infinity"]),
        (SERVER_UNIT, "RuntimeDirectory", [nic.DIRECTORY.relative_to("/run").name]),
        (SERVER_UNIT, "RuntimeDirectoryMode", ["0700"]),
        (SERVER_UNIT, "RuntimeDirectoryPreserve", ["yes"]),  # other instances use it
        (SERVER_UNIT, "Restart", ["on-failure"]),
        (BRIDGE_UNIT, "AmbientCapabilities", []),
        (BRIDGE_UNIT, "CapabilityBoundingSet", [""]),
        (BRIDGE_UNIT, "LimitMEMLOCK", ["infinity"]),
        (BRIDGE_UNIT, "Restart", ["on-failure"]),
        # The node does not depend on the server.
        *((BRIDGE_UNIT, key, []) for key in ("Requires", "BindsTo", "PartOf", "Requisite")),
    ],
)
def test_a_unit_says(unit: Path, key: str, expected: list[str]) -> None:
    assert values(unit, key) == expected


def test_the_nodes_real_time_priority_is_below_the_servers(installed: tuple[Stage, str]) -> None:
    (limit,) = values(BRIDGE_UNIT, "LimitRTPRIO")
    (node,) = re.findall(r"rt_priority: (\d+)", installed[0].files()["/etc/ethercat-server/bridge.yaml"])
    assert 0 < int(node) <= int(limit) < realtime.DEFAULT_PRIORITY


def test_a_usage_error_is_not_tried_again_and_each_service_has_a_user_of_its_own() -> None:
    for unit in (SERVER_UNIT, BRIDGE_UNIT):
        (prevented,) = values(unit, "RestartPreventExitStatus")
        assert "2" in prevented.split()
    lines = (UNITS / "ethercat-server.sysusers.conf").read_text().splitlines()[1:]
    users = [line.split()[1] for line in lines]
    assert users == values(SERVER_UNIT, "User") + values(BRIDGE_UNIT, "User")


def test_the_default_configuration_says_nothing_new() -> None:
    text = (UNITS / "default.toml").read_text()
    assert tomllib.loads(text) == {"server": {}, "sensor": {}}
    taken_out = [
        line.removeprefix("# ") for line in text.splitlines() if line.startswith("# ") and " = " in line
    ]
    servers, sensors = "\n".join(taken_out).split("calibration_matrix")
    assert tomllib.loads(servers).keys() == SERVER_SETTINGS.keys()
    for name, value in tomllib.loads(servers).items():
        setting = SERVER_SETTINGS[name]
        examples = {"control_users", "control_groups", "cpu", "terminals", "user"}
        assert setting.check(value) == setting.default or name in examples, name
    assert read_config(UNITS / "default.toml") == EMPTY
    common = tomllib.loads("calibration_matrix" + sensors.rpartition("\n")[0])
    assert check_settings(common) == start_up_defaults()


def test_the_unit_starts_the_server_as_it_wants_to_be_started(tmp_path: Path) -> None:
    (command,) = values(SERVER_UNIT, "ExecStart")
    (settings,) = values(SERVER_UNIT, "Environment")
    variables = dict(word.split("=", 1) for word in settings.split())
    variables["CONFIG"] = str(tmp_path / "empty.toml")
    Path(variables["CONFIG"]).touch()
    for model in ("", "BFT-SENS-ECAT-M8"):
        variables["SENSOR_NAME"] = model
        words = command.replace("%I", "ens5")
        for name, value in variables.items():
            words = words.replace(f"${{{name}}}", value).replace(f"${name}", value)
        options = parse_options(words.split()[1:])
        assert (options.ifname, options.port, options.sensor_name) == ("ens5", 12001, model or None)
