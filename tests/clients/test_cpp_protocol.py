"""The C++ client decodes what the Python code does: the golden vectors, and the fuzzer's hostile messages.

Built with ASan and UBSan, which end the program at the first fault.
"""

from __future__ import annotations

import json
import math
import random
import subprocess
from collections.abc import Iterator, Sequence

import pytest

from bota_ethercat.accounting import StreamCounts
from bota_ethercat.framing import DataMessage, encode_data
from bota_ethercat.pdo import PDO_FIELDS, ImuUnits, PdoType, Sample, SampleDecoder, encode, layout_for
from bota_ethercat.sensor.warnings_register import WarningFlag
from tests.clients.cpp_programs import FAST, INCLUDE, SANITIZED, driver_program, needs_gxx, patient
from tests.golden_vectors import (
    ACCOUNTED,
    BROKEN,
    DATA,
    JSON,
    AccountedStream,
    Outcome,
    outcomes,
    same_sample,
)
from tests.hostile_bytes import FRAMED, HOSTILE_TEXTS, framed, in_chunks, mutate
from tests.protocol.test_framing import LIMIT, SEED
from tests.simulation import more_if_long

pytestmark = [needs_gxx, patient]

Decoded = tuple[Outcome, Sample | None]
Stream = Sequence[bytes]
BATCH = 2000
INSERTED = (
    b"\\ud83d\\ude00", b"\\ud83d", b"1e308", b"1e309", b"-", b"0", b".5", b'"', b"[", b"{}", b"null", b",",
    b"\xf0\x9f\x98\x80", b"\xed\xa0\x80", b"\xe2\x82", b"9" * 30, b"-0.0", b"1E+2", b'"a":', b" ", b"\\",
)  # fmt: skip


def in_cpp(
    streams: Sequence[Stream], limit: int = 65536, units: str = "g_dps", flags: Sequence[str] = SANITIZED
) -> list[list[Decoded]]:
    lines = (f"{limit} {units} {' '.join(chunk.hex() for chunk in stream)}\n" for stream in streams)
    return list(by_stream(decoded("".join(lines), flags=flags)))[: len(streams)]


def decoded(lines: str, *what: str, flags: Sequence[str] = SANITIZED) -> str:
    done = subprocess.run(
        [driver_program(flags), "decode", *what],
        input=lines, capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def by_stream(output: str) -> Iterator[list[Decoded]]:
    found: list[Decoded] = []
    for line in output.splitlines():
        if not line:
            yield found
            found = []
        else:
            found.append(outcome(line))


def outcome(line: str) -> Decoded:
    kind, _, rest = line.partition(" ")
    if kind == "J":
        return json.loads(rest), None
    if kind != "D":
        return {"B": "refused", "X": "broken"}[kind], None
    words = rest.split()
    sequence, stamp, monotonic, sensor, flags, wkc, size, status, warnings, ft, a, r = map(int, words[:12])
    values = [float.fromhex(word) for word in words[12:-1] if word != "-"]
    force, torque, acceleration, rate = ((values[k], values[k + 1], values[k + 2]) for k in (0, 3, 6, 9))
    x, y, z, w = values[13:] or (0.0, 0.0, 0.0, 0.0)
    orientation = (x, y, z, w) if len(values) > 13 else None
    sample = Sample(
        force, torque, acceleration, rate, values[12], orientation, status, warnings, ft, a, r
    )  # fmt: skip
    assert sample.is_finite == (words[-1] == "finite")
    return DataMessage(sequence, stamp, monotonic, sensor, flags, wkc, bytes(size)), sample


def in_python(stream: Stream, limit: int = 65536, units: ImuUnits = ImuUnits.G_DPS) -> list[Decoded]:
    decoders = {size: SampleDecoder(size, units) for size in (61, 77)}
    return [
        (without_process_data(message), decoders[len(message.process_data)].decode(message.process_data))
        if isinstance(message, DataMessage)
        else (message, None)
        for message in outcomes(stream, limit)
    ]


def assert_same(cpp: Sequence[Decoded], python: Sequence[Decoded], stream: Stream) -> None:
    """The bytes of the process data are compared as what they decode to."""
    told = [b"".join(stream).hex()[:400], cpp[-3:], python[-3:]]
    assert [message for message, _ in cpp] == [message for message, _ in python], told
    for (_, one), (_, other) in zip(cpp, python, strict=True):
        assert (one is None) == (other is None), told
        if one is not None and other is not None:
            assert same_sample(one, other), told


# -- golden vectors


def test_golden_vectors_one_by_one() -> None:
    vectors = [*DATA, *JSON, *BROKEN]
    found = in_cpp([[vector.wire] for vector in vectors])
    for vector, ((message, sample),) in zip(vectors, found, strict=True):
        assert message == without_process_data(vector.outcome), vector.name
        assert (sample is None) == (vector.sample is None)
        assert sample is None or vector.sample is None or same_sample(sample, vector.sample), vector.name
    for vector, ((_, sample),) in zip(DATA, in_cpp([[each.wire] for each in DATA], units="si"), strict=True):
        assert sample is not None
        assert vector.sample_si is not None
        assert same_sample(sample, vector.sample_si), vector.name


def without_process_data(outcome: Outcome) -> Outcome:
    if isinstance(outcome, DataMessage):
        return outcome._replace(process_data=bytes(len(outcome.process_data)))
    return outcome


def test_a_program_of_fast_math_sees_what_is_not_finite() -> None:
    """As many controllers are built: what the compiler assumes then must not hide a NaN."""
    names = [field.name for field in PDO_FIELDS if field.type is PdoType.REAL]
    samples = [encode(77, {name: value}) for name in names for value in (math.nan, math.inf, -math.inf, 1.0)]
    streams = [[encode_data(1, 2, 3, 0, 0, 3, data)] for data in samples]
    for stream, cpp in zip(streams, in_cpp(streams, flags=FAST), strict=True):
        assert_same(cpp, in_python(stream), stream)


def accounted_in_cpp(streams: Sequence[AccountedStream]) -> list[tuple[list[str], StreamCounts]]:
    """The kind of each frame and the counts that the C++ header makes of each stream."""
    lines = []
    for stream in streams:
        steps = [step if step == "begin" else ",".join(map(str, step[:3])) for step in stream.frames]
        options = (stream.every, int(stream.fresh_only), stream.rate_hz)
        lines.append(" ".join([*map(str, options), *steps]))
    rows = [line.split() for line in decoded("\n".join(lines), "accounting").splitlines()]
    fields = len(StreamCounts.__slots__)
    return [(row[:-fields], StreamCounts(*map(int, row[-fields:]))) for row in rows]


def test_golden_accounting() -> None:
    for stream, (kinds, counts) in zip(ACCOUNTED, accounted_in_cpp(ACCOUNTED), strict=True):
        wanted = {**dict.fromkeys(StreamCounts.__slots__, 0), **stream.counts}
        assert kinds == [step[3] for step in stream.frames if step != "begin"], stream.name
        assert counts == StreamCounts(**wanted), stream.name


# -- the same as Python, whatever comes


def hostile_streams(rng: random.Random, count: int) -> list[Stream]:
    """`count` messages and more, in streams as the fuzzer of the Python code makes them."""
    streams, done = list[Stream](), 0
    while done < count:
        pieces = rng.choices(FRAMED, k=rng.randint(0, 3))
        for _ in range(rng.randint(1, 6)):
            piece = rng.choice(FRAMED)
            if rng.random() < 0.05:
                piece = framed(rng.choice(HOSTILE_TEXTS))
            elif rng.random() < 0.4:
                piece = framed(broken_text(rng))
            pieces.append(mutate(rng, piece, FRAMED) if rng.random() < 0.5 else piece)
        done += len(pieces)
        streams.append(in_chunks(rng, b"".join(pieces)))
    return streams


def broken_text(rng: random.Random) -> bytes:
    """A JSON text with a fault inside, whose framing is sound: what the JSON reader alone must catch."""
    text = bytearray(rng.choice(FRAMED[:-2])[5:])
    for _ in range(rng.randint(0, 3)):
        at = rng.randrange(len(text) + 1)
        if rng.random() < 0.5 and at < len(text):
            text[at] = rng.choice(b'{}[]",:\\u0123456789.eE+-tfn \n\x00\x1f\x7f\x80\xc3\xed\xf4')
        else:
            text[at:at] = rng.choice(INSERTED)
    return bytes(text[: rng.randrange(len(text))]) if text and rng.random() < 0.2 else bytes(text)


def compare(seed: int, count: int) -> None:
    rng, done = random.Random(seed), 0
    kinds: dict[str, int] = {}
    while done < count:
        streams = hostile_streams(rng, min(BATCH, count - done))
        units = rng.choice(list(ImuUnits))
        for stream, cpp in zip(streams, in_cpp(streams, LIMIT, units.value), strict=True):
            python = in_python(stream, LIMIT, units)
            assert_same(cpp, python, stream)
            for message, _ in python:
                kind = message if isinstance(message, str) else type(message).__name__
                kinds[kind] = kinds.get(kind, 0) + 1
        done += BATCH
    assert min(kinds[kind] for kind in ("refused", "broken", "dict", "DataMessage")) > count // 50, kinds


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("count", more_if_long([4_000], [4_000, 500_000]))
def test_hostile_messages_come_out_as_in_python(count: int) -> None:
    print(f"FUZZ_SEED={SEED}")
    compare(SEED, count)


WHOLE = '{"a\\u00e9\\ud83d\\ude00":[true,false,null,-1.5e-3,{"é€😀":"\\n\\\\"}],"b":0}'.encode()
NUMBERS = (
    "1e308", "1.7976931348623157e308", "1.7976931348623158e308", "1.7976931348623159e308", "1e309", "-1e309",
    "1e-400", "0e999999999999", "0.0e99999", "0." + "0" * 400 + "1e700", "0." + "0" * 400 + "1e800",
    "1" + "0" * 400 + "e-100", "1" + "0" * 400 + "e-92", "1" + "0" * 400 + ".0", "9" * 4300, "9" * 4301,
    "-" + "9" * 4300, "-" + "9" * 4301, "1e99999999999999999999", "1e-99999999999999999999", "4.9e-324",
)  # fmt: skip


def test_each_hostile_text_one_that_ends_anywhere_and_numbers_at_the_edge() -> None:
    cut = [framed(WHOLE[:end]) for end in range(len(WHOLE) + 1)]
    wires = [*map(framed, HOSTILE_TEXTS), *(framed(b'{"a":' + number.encode() + b"}") for number in NUMBERS)]
    streams = [stream for wire in wires for stream in ([wire], [wire[:9], wire[9:]], [wire, *FRAMED[:2]])]
    found = in_cpp([*([wire] for wire in cut), *streams])
    for stream, cpp in zip([*([wire] for wire in cut), *streams], found, strict=True):
        assert_same(cpp, in_python(stream), stream)
    assert [decoded[0][0] for decoded in found[: len(WHOLE)]] == ["refused"] * len(WHOLE)


# -- the header's own tables


def test_offsets_and_names_are_those_of_the_python_tables() -> None:
    header = (INCLUDE / "bota_ethercat" / "protocol.hpp").read_text()
    offsets = layout_for(77).offsets
    for field in PDO_FIELDS:
        name, _, part = field.name.partition(".")
        if part in {"", "x"}:
            constant = "k" + name.title().replace("_", "") + "At"
            assert f"{constant} = {offsets[field.name]}," in header, constant
    for flag in WarningFlag:
        constant = "k" + str(flag.name).title().replace("_", "")
        assert f"{constant} = 1u << {flag.value.bit_length() - 1};" in header, constant
