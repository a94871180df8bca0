"""The SII taken apart: the virtual sensor's own image, and images that are nonsense."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.control import MAX_SII_WORDS
from ethercat_server.ethercat.slave.sii import decode, raw_lines, read_image
from ethercat_server.virtual_sensor.firmware.layout import sensor_device
from ethercat_server.virtual_sensor.slave.image import build_image


def reader(image: bytes) -> bytes:
    def read(word: int, words: int) -> bytes:
        assert 1 <= words <= MAX_SII_WORDS
        return image[word * 2 : (word + words) * 2].ljust(words * 2, b"\xff")

    return read_image(read)


def test_an_image_is_read_to_the_end_of_its_categories_and_no_further() -> None:
    image = build_image(sensor_device("BFT-ROKS-ECAT-M8", 7, 77))
    read = reader(image)
    assert image.startswith(read)
    assert len(read) < len(image)
    found = decode(read)
    assert (found["name"], found["serial"], found["check_byte_right"]) == ("BFT-ROKS-ECAT-M8", 7, True)
    assert list(found["categories"]) == ["strings", "general", "FMMUs", "sync managers", "TxPDOs", "RxPDOs"]


def test_a_wrong_check_byte_is_seen() -> None:
    image = bytearray(build_image(sensor_device("BFT-ROKS-ECAT-M8", 7, 77)))
    image[2] ^= 1
    assert not decode(bytes(image))["check_byte_right"]


def test_an_erased_eeprom_has_nothing() -> None:
    read = reader(b"")
    found = decode(read)
    assert (found["name"], found["sync_managers"], found["categories"]) == ("", [], {})
    assert raw_lines(read)[0] == "0000: ff|ff|ff|ff"


@given(st.binary(max_size=600))
def test_nonsense_is_taken_apart_without_complaint(tail: bytes) -> None:
    read = reader(build_image(sensor_device("BFT-ROKS-ECAT-M8", 7, 61))[:0x80] + tail)
    decode(read)
    assert len(read) <= 2 * 0x2000 + 8
