"""The AL status as people read it."""

from __future__ import annotations

import pytest

from ethercat_server.ethercat.slave.al import AL_STATUS_CODES, AlStatus


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x001B, "sync manager watchdog"),
        (0x0035, "distributed clock: invalid sync cycle time"),
        (0x0050, "no access to its EEPROM"),
        (0x8001, "the vendor's own code"),
        (0x0FFF, "reserved"),
    ],
)
def test_an_error_is_said_in_words(code: int, words: str) -> None:
    text = str(AlStatus.of(0x14, code))
    assert text.startswith(f"SAFEOP with AL status 0x{code:04X} ({words}")


def test_no_two_codes_have_the_same_words() -> None:
    assert len(set(AL_STATUS_CODES.values())) == len(AL_STATUS_CODES)
