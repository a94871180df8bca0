"""What docs/stability.md promises: no public name appears or disappears unnoticed."""

from __future__ import annotations

from tests.public_names import listed, public_names


def test_the_public_names_are_those_listed() -> None:
    """After a change on purpose: docs/stability.md, `python -m tests.public_names`, and the changelog."""
    assert public_names() == listed(ros=False)
