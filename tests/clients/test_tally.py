"""What the recorder says of losses."""

from __future__ import annotations

import pytest

from bota_clients.record.recorder import Tally
from bota_ethercat.framing import DataFlag, DataMessage
from tests.clients.recordings import frame


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ([frame(1), frame(2), frame(1, 1)], "nothing lost"),
        ([frame(1), frame(2, 0, DataFlag.GAP), frame(3, 0, DataFlag.GAP), frame(1, 1)], "2+0 gaps"),
        ([frame(1), frame(5, 0, DataFlag.GAP), frame(1, 1, DataFlag.INVALID)], "3 lost, 0+1 invalid"),
    ],
)
def test_the_line_says_nothing_lost_only_if_the_end_would(frames: list[DataMessage], words: str) -> None:
    tally = Tally()
    for each in frames:
        tally.count(each)
    assert tally.brief() == words
    assert (words == "nothing lost") == (not tally.losses())
