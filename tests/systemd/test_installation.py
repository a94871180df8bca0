"""scripts/install-service: its Debian packages, installed, updated and purged in a root of their own,
and the unit files: what systemd makes of them, and that they leave the server no more than it needs."""

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

from bota_ethercat.program.version import VERSION
from bota_ethercat.settings import check_settings, start_up_defaults
from ethercat_server.daemon.options import EMPTY, SERVER_SETTINGS, parse_options, read_config
from ethercat_server.ethercat import nic
from ethercat_server.process import realtime
from tests.rights import needs_another_user
from tests.server.running import Veth, on_a_bus

ROOT = Path(__file__).parent.parent.parent
UNITS = ROOT / "systemd"
SERVER_UNIT = UNITS / "ethercat-server@.service"
BRIDGE_UNIT = UNITS / "ethercat-bridge.service"
CAPABILITIES = ("CAP_NET_RAW", "CAP_NET_ADMIN", "CAP_SYS_NICE", "CAP_IPC_LOCK")


def need_systemd() -> None:
    """Skip where systemd's tools are missing; fail where everything is meant to be checked."""
    if shutil.which("systemd-analyze"):
        return
    reason = "systemd-analyze is missing: sudo apt install systemd (it need not be running)"
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


def interface_package(folder: Path, *arguments: str) -> tuple[str, dict[str, str]]:
    """The name and the files of the package for one interface, with those for dpkg."""
    done = install_service("--keep-environment", "--build", str(folder), *arguments)
    assert done.returncode == 0, done.stderr
    (package,) = folder.glob("*.deb")
    subprocess.run(["dpkg-deb", "--raw-extract", package, folder / "files"], check=True)
    paths = [path for path in (folder / "files").rglob("*") if path.is_file()]
    return package.name, {f"/{path.relative_to(folder / 'files')}": path.read_text() for path in paths}


def test_a_package_keeps_network_managers_off_its_interface(tmp_path: Path) -> None:
    name, files = interface_package(tmp_path, "ens5", "13000")
    assert name == "ethercat-server-ens5_0.1.0_all.deb"
    settings = "/etc/ethercat-server/ens5.env"
    manager_file = "/usr/lib/NetworkManager/conf.d/90-ethercat-server-ens5.conf"
    networkd_file = "/usr/lib/systemd/network/05-ethercat-server-ens5.network"
    for_dpkg = {f"/DEBIAN/{part}" for part in ("control", "conffiles", "postinst", "prerm", "postrm")}
    waiting = "/usr/lib/systemd/system/ethercat-server@ens5.service.d/interface.conf"
    assert set(files) == {settings, manager_file, networkd_file, waiting} | for_dpkg
    assert files["/DEBIAN/conffiles"] == f"{settings}\n"
    assert "\nPORT=13000\n" in files[settings]
    manager, networkd = configparser.ConfigParser(), configparser.ConfigParser()
    manager.read_string(files[manager_file])
    section = manager["device-ethercat-ens5"]
    assert (section["match-device"], section["managed"]) == ("interface-name:ens5", "0")
    networkd.read_string(files[networkd_file])
    assert (networkd["Match"]["Name"], networkd["Link"]["Unmanaged"]) == ("ens5", "yes")


def test_a_dash_is_escaped_for_systemd_only_and_a_package_has_a_name_that_dpkg_allows(tmp_path: Path) -> None:
    name, files = interface_package(tmp_path, "Enp3_s0-1")
    assert name.startswith("ethercat-server-enp3-s0-1_")
    assert "/etc/ethercat-server/Enp3_s0-1.env" in files
    assert "/usr/lib/systemd/system/ethercat-server@Enp3_s0\\x2d1.service.d/interface.conf" in files
    assert "\nservices='ethercat-server@Enp3_s0\\x2d1.service'\n" in files["/DEBIAN/prerm"]


def test_a_dry_run_says_what_would_be_done() -> None:
    done = install_service("--dry-run", "--bridge", "ens5")
    assert done.returncode == 0, done.stderr
    written = set(re.findall(r"would write (\S+)\n", done.stderr))
    assert written == {
        "/etc/ethercat-server/bridge.yaml",
        "/etc/ethercat-server/default.toml",
        "/etc/ethercat-server/ens5.env",
        "/usr/lib/NetworkManager/conf.d/90-ethercat-server-ens5.conf",
        "/usr/lib/systemd/network/05-ethercat-server-ens5.network",
        "/usr/lib/systemd/system/ethercat-bridge.service",
        "/usr/lib/systemd/system/ethercat-server@.service",
        "/usr/lib/systemd/system/ethercat-server@ens5.service.d/interface.conf",
        "/usr/lib/sysusers.d/ethercat-server.conf",
    }
    start, watch = done.stderr.splitlines()[-2:]
    assert start.startswith(
        "install-service: next: systemctl enable --now 'ethercat-server@ens5' ethercat-bridge "
    )
    assert "then: journalctl -fu 'ethercat-server@ens5'" in watch


def test_a_dry_run_says_too_that_there_is_no_such_interface() -> None:
    said = "there is no interface nosuch yet: check its name with 'ip link'"
    assert said in install_service("--dry-run", "nosuch").stderr
    assert "there is no interface" not in install_service("--dry-run", "virtual").stderr


@on_a_bus
def test_an_alternative_name_is_installed_as_the_interfaces_own() -> None:
    with Veth() as veth:
        for other in ("short1", "a-name-too-long-for-linux"):
            veth.ip("link", "property", "add", "dev", veth.near, "altname", other)
            done = install_service("--dry-run", "--keep-environment", other)
            assert f"'ethercat-server@{veth.near}'" in done.stderr
            assert other not in done.stderr


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
        (["--build"], "--build takes a folder"),
        (["--bridge", "--keep-environment", "ens5"], "--bridge installs programs, --keep-environment none"),
        (["--quick", "ens5"], "unknown option --quick"),
        (["--uninstall", "ens5"], "--uninstall takes no arguments"),
    ],
)
def test_wrong_arguments_are_answered_with_one_sentence(arguments: list[str], complaint: str) -> None:
    done = install_service(*arguments)
    assert done.returncode == 2
    assert complaint in done.stderr
    assert done.stderr.count("\n") == 1


@needs_another_user
def test_it_needs_root() -> None:
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


IN_A_ROOT_OF_ITS_OWN = """
set -e
mount -t tmpfs tmpfs "$1"
mkdir "$1/upper" "$1/work" "$1/root"
mount -t overlay overlay -o "lowerdir=/,upperdir=$1/upper,workdir=$1/work" "$1/root"
for each in dev proc sys; do mount --rbind "/$each" "$1/root/$each"; done
mount -t tmpfs tmpfs "$1/root/run"
for each in "$2" "$3"; do  # which may be of other file systems
    mkdir -p "$1/root$each"
    mount --bind "$each" "$1/root$each"
done
exec chroot "$1/root" bash -c "$4" bash "$2"
"""
"""This machine as it is, in a mount namespace: what is written there is written to memory."""

INSTALLED_AND_PURGED = """
set -e
cd "$1"
config=/etc/ethercat-server
everything() { find /etc /opt /usr/bin /usr/lib /var/lib /run ! -path '*/lib/dpkg/*' ! -name '*-' | sort; }
# systemd-sysusers writes a password in its own way.
accounts() { cut -d: -f 1,3,4 /etc/passwd; cut -d: -f 1,3 /etc/group; }
before=$(everything; accounts)
scripts/install-service ens5 13000
echo "users $(getent passwd ethercat ethercat-bridge | grep -c nologin)"
[ /opt/ethercat-server/bin/python -ef /usr/bin/python3 ]  # gets its updates
cd /usr/share
folders=$(echo {bash-completion/completions,zsh/vendor-completions,fish/vendor_completions.d,man/man1})
for each in $folders; do ls $each/*ethercat-server*; done | wc -l
cd "$1"
setpriv --reuid=ethercat --regid=ethercat --clear-groups ethercat-server --version
mkdir /var/lib/ethercat-sensors  # as the service does
echo "# mine" >>$config/ens5.env
scripts/install-service --keep-environment ens5 14000
scripts/install-service --keep-environment ens6
scripts/install-service --keep-environment ens6 15000
grep -H ^PORT $config/*.env
systemctl enable --quiet ethercat-server@ens5 ethercat-server@ens6
echo "enabled $(ls /etc/systemd/system/multi-user.target.wants | grep -c ethercat)"
scripts/install-service --uninstall
echo "enabled $(ls /etc/systemd/system/multi-user.target.wants | grep -c ethercat)"
[ ! -e /opt/ethercat-server ] && [ ! -e /usr/bin/ethercat-server ]
tail -n 1 $config/ens5.env
dpkg --purge ethercat-server ethercat-server-ens5 ethercat-server-ens6 >/dev/null
scripts/install-service --uninstall
echo "left <$(comm -13 <(sort <<<"$before") <({ everything; accounts; } | sort))>"
"""


@pytest.mark.long
@pytest.mark.timeout(600)
def test_packages_are_installed_updated_and_purged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """dpkg and pip for real, with packages that were downloaded before: there is no network here."""
    need_systemd()
    if (wheels := os.environ.get("TEST_WHEELS")) is None:
        pytest.skip("pip needs packages to install: run scripts/test --long with a network")
    overlay = f"mount -t tmpfs tmpfs {tmp_path} && cd {tmp_path} && mkdir a b c"
    overlay += " && mount -t overlay overlay -o lowerdir=/,upperdir=a,workdir=b c"
    if subprocess.run(["unshare", "--mount", "sh", "-c", overlay], check=False).returncode:
        pytest.skip("no overlay of this machine's root: run as root")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", wheels)
    script = [IN_A_ROOT_OF_ITS_OWN, "bash", str(tmp_path), str(ROOT), wheels, INSTALLED_AND_PURGED]
    done = subprocess.run(
        ["unshare", "--mount", "bash", "-c", *script], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    settings = "/etc/ethercat-server/ens{}.env:PORT={}"
    assert done.stdout.splitlines() == [
        "users 2",
        "4",
        f"ethercat-server {VERSION}",
        settings.format(5, 13000),
        settings.format(6, 15000),
        "enabled 2",
        "enabled 0",
        "# mine",
        "left <>",
    ]
    assert "systemd does not run here: nothing starts it" in done.stderr
    assert done.stderr.endswith("install-service: nothing is installed\n")


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


MOST_EXPOSURE = 2.5


def analyze(*arguments: str, units: Path | None = None) -> subprocess.CompletedProcess[str]:
    need_systemd()
    # The colon adds the system's own units, of which ours need some targets.
    path = {"SYSTEMD_UNIT_PATH": f"{units}:"} if units else {}
    return subprocess.run(
        ["systemd-analyze", *arguments],
        check=False, capture_output=True, text=True, env={**os.environ, **path, "LC_ALL": "C"},
    )  # fmt: skip


def test_the_units_are_without_fault(tmp_path: Path) -> None:
    for program in ("bin/ethercat-server", "bridge/bin/bridge-client"):
        path = tmp_path / program
        path.parent.mkdir(parents=True)
        path.write_text("#!/bin/sh\n")
        path.chmod(0o755)
    units = [tmp_path / SERVER_UNIT.name, tmp_path / BRIDGE_UNIT.name]
    for unit in units:
        unit.write_text((UNITS / unit.name).read_text().replace("/opt/ethercat-server", str(tmp_path)))
    checked = analyze("verify", "--man=no", "--recursive-errors=no", *map(str, units), units=tmp_path)
    ours = [line for line in checked.stderr.splitlines() if "ethercat" in line]
    assert not ours
    assert checked.returncode == 0, checked.stderr


@pytest.mark.parametrize("unit", [SERVER_UNIT, BRIDGE_UNIT], ids=lambda unit: unit.name)
def test_little_is_exposed(unit: Path) -> None:
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
        (SERVER_UNIT, "RestartPreventExitStatus", ["2"]),  # a usage error
        (BRIDGE_UNIT, "AmbientCapabilities", []),
        (BRIDGE_UNIT, "CapabilityBoundingSet", [""]),
        (BRIDGE_UNIT, "LimitMEMLOCK", ["infinity"]),
        (BRIDGE_UNIT, "Restart", ["on-failure"]),
        (BRIDGE_UNIT, "RestartPreventExitStatus", ["2 3"]),
        # The node does not depend on the server.
        *((BRIDGE_UNIT, key, []) for key in ("Requires", "BindsTo", "PartOf", "Requisite")),
    ],
)
def test_a_unit_says(unit: Path, key: str, expected: list[str]) -> None:
    assert values(unit, key) == expected


def test_the_nodes_real_time_priority_is_below_the_servers() -> None:
    (limit,) = values(BRIDGE_UNIT, "LimitRTPRIO")
    installer = (ROOT / "scripts/install-service").read_text()
    (default, node) = re.findall(r"rt_priority: (\d+)", installer)
    assert f"rt_priority: {default}\n" in (ROOT / "ros2_bridge/config/client.yaml").read_text()
    assert 0 < int(node) <= int(limit) < realtime.DEFAULT_PRIORITY


def test_each_service_has_a_user_of_its_own() -> None:
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
