"""What docs/stability.md promises: no public name appears or disappears unnoticed."""

from __future__ import annotations

import importlib
import sys
from operator import attrgetter

import pytest

from tests.ended import completed
from tests.public_names import listed, public_names


def test_the_public_names_are_those_listed() -> None:
    """After a change on purpose: docs/stability.md, `python -m tests.public_names`, and the changelog."""
    assert public_names() == listed(ros=False)


@pytest.mark.parametrize(
    ("old", "new", "submodules"),
    [
        # The table is loaded already, by its new name; others are loaded by their old one.
        ("bridge", "bota_ethercat_bridge", ("process", "parameters.table")),
        ("ft_compensation", "bota_ft_compensation", ("bias", "identification.delay")),
        ("bota_ethercat_bridge.ft_compensation", "bota_ft_compensation", ("contact",)),
    ],
)
def test_an_old_package_name_gives_the_modules_of_the_new_one(
    old: str, new: str, submodules: tuple[str, ...]
) -> None:
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=f"^the package {old} is now {new}, .*: import {new}$") as by:
        __import__(old)
    assert [each.filename for each in by] == [__file__]
    for each in submodules:
        __import__(f"{old}.{each}")
        real = importlib.import_module(f"{new}.{each}")
        assert real is sys.modules[f"{old}.{each}"] is attrgetter(each)(sys.modules[old])
        assert attrgetter("__name__", "__spec__.name")(real) == (f"{new}.{each}",) * 2
    with pytest.raises(ModuleNotFoundError, match=rf"^No module named '{old}\.absent'$"):
        __import__(f"{old}.absent")


def test_an_old_package_name_runs_a_program() -> None:
    command = [sys.executable, "-m", "bridge.client", "--help"]
    done = completed(*command, check=True)
    assert "\nusage: ros2 run bridge client" in done.stdout
