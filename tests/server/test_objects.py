"""The object dictionary as data: what the note lists is there, with what its values mean."""

from __future__ import annotations

from bota_ethercat.settings import SETTINGS
from ethercat_server.sensor.objects.dictionary import (
    BY_SETTING,
    FACTORY_CALIBRATION,
    OBJECTS,
    Access,
    ObjectType,
)
from ethercat_server.sensor.objects.search import (
    BY_ADDRESS,
    KNOWN_OBJECTS,
    NOTE_NAMES,
    find_objects,
    full_name,
    similar_names,
)

TABLE_III_1 = (
    (0x2000, 0), (0x6000, 0), (0x8000, 0), (0x8001, 0), (0x8002, 0), (0x8003, 0), (0x8004, 0), (0x8005, 0),
    (0x8006, 1), (0x8006, 2), (0x8006, 3), (0x8006, 4), (0x8007, 0), (0x8008, 0),
    (0x8010, 1), (0x8010, 2), (0x8010, 3), (0x8011, 0), (0x8030, 1), (0x8030, 2),
)  # fmt: skip
LISTING_III_6 = ((0x7000, 0), (0x8006, 0), (0x8010, 0), (0x8010, 4), (0x8010, 5), (0x8010, 6), (0x8030, 0))


def test_everything_the_note_lists_is_there() -> None:
    assert set(TABLE_III_1 + LISTING_III_6) <= set(BY_ADDRESS)


def test_values_and_defaults_are_the_notes() -> None:
    assert BY_ADDRESS[0x8004, 0].allowed == {0: "±2 g", 1: "±4 g", 2: "±8 g", 3: "±16 g"}
    assert BY_ADDRESS[0x8005, 0].allowed == {0: "±250 °/s", 1: "±500 °/s", 2: "±1000 °/s", 3: "±2000 °/s"}
    assert BY_ADDRESS[0x8006, 2].allowed == {0: "FIR on: lower cut-off, more delay", 1: "FIR off"}
    assert BY_ADDRESS[0x8006, 1].allowed == range(32, 2049)
    assert BY_ADDRESS[0x8030, 1].allowed == {1: "save the parameters"}
    assert BY_ADDRESS[0x8000, 1].allowed is None
    defaults = {(0x8006, 1): 0x40, (0x8006, 2): 1, (0x8006, 3): 0, (0x8006, 4): 0, (0x8011, 0): 0x320}
    assert {address: BY_ADDRESS[address].default for address in defaults} == defaults


def test_what_may_be_written_in_which_state() -> None:
    assert BY_ADDRESS[0x8006, 1].access.write_states == ("PREOP",)
    assert BY_ADDRESS[0x8000, 1].access.write_states == ("PREOP", "SAFEOP", "OP")
    assert BY_ADDRESS[0x8011, 0].access.write_states == ()
    for name, row in BY_SETTING.items():
        assert SETTINGS[name].preop_only == (row.access is Access.RW_PREOP), name


def test_no_setting_is_held_by_the_factory_calibration() -> None:
    assert not [row for row in OBJECTS if row.index == FACTORY_CALIBRATION and row.setting]


def test_objects_have_every_name_that_people_know_them_by() -> None:
    for index, subindex, name in NOTE_NAMES:
        found = [row.address for row in find_objects(name)]
        assert (index, subindex) in found, name
        assert find_objects(name.upper().replace(" ", "_")) == find_objects(name)
    for name, row in BY_SETTING.items():
        assert find_objects(name) == [row]
    assert [row.subindex for row in find_objects("Force/Torque Offset")] == list(range(7))
    assert [row.address for row in find_objects("Status")] == [(0x6000, 1), (0x8030, 2)], "two are called so"
    for row in KNOWN_OBJECTS:
        assert find_objects(full_name(row)) == [row]
        assert find_objects(f"0x{row.index:04X}:{row.subindex}") == [row]


def test_what_no_object_is_called() -> None:
    assert find_objects("colour") == find_objects("") == find_objects("0x8006:256") == []
    assert similar_names("sampling rte") == ["Sampling rate"]
    (unknown,) = find_objects("0x1C12:1")
    assert (unknown.address, unknown.type) == ((0x1C12, 1), ObjectType.OCTETS)
