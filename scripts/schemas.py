"""The JSON Schemas in docs/schemas of what programs print with --json: `python -m scripts.schemas`.

A document: `# file: title`, what it is, `= what its value may be`, and the objects in it. A field: name (with
`~` if it may be missing), type and "meaning". Types: `[item]`, `null?`, `one|of|these`, `this/or that`, an
object; and from the rows that all programs share (`bota_ethercat.replies`) `Row.field`, or for several fields
`*Row(field field)`. `...`: any others.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path
from typing import Any, Final, get_type_hints

from bota_ethercat import replies
from bota_ethercat.health.limits import Level

FOLDER: Final = Path(__file__).parents[1] / "docs" / "schemas"
Schema = dict[str, Any]

_VERDICT: Final = "|".join(level.key for level in (Level.GOOD, Level.LOOK, Level.TROUBLE))
_FOUND: Final = "through str, sensor int, name str, serial int, hardware str, firmware str"
_DOCUMENTS: Final = f"""
# doctor: ethercat-doctor --json
The whole examination, or the error that ended it.
= examination, error
examination: interface str, version str, time str, kernel str, root bool, seconds float,
    verdict good|not-possible|look|trouble, worst ok|skipped|note|warning|bad, findings [finding]
finding: subject str, check str, level ok|skipped|note|warning|bad, found str, why str, commands [str],
    values object
error: error str

# export-align: ethercat-export align
The server's CLOCK_MONOTONIC at a stamp of the robot's clock, and what to add to such stamps for the
server's CLOCK_REALTIME.
= alignment
alignment: stamp_ns int, monotonic_ns int, offset_ms float, interval_ms float, drift_ppm float,
    drift_interval_ppm float, bend_ms float "By how much the clocks are off a line, part of interval_ms; 0
    if noise explains that.", left_out int "Messages of the robot without finite angles or rates."

# identify-delay: ethercat-identify delay --json
How much later force and torque are than the accelerometer. `ok`: whether there is a result.
= failure, delay
failure: ok false, error str
delay: ok true, lag_ms float, interval_ms float, expected_ms float?, explained float,
    left_N float "Force left by compensation in held-out parts, rms.", left_unaligned_N float "Without."

# identify: ethercat-identify --json
SI units, in the sensor's frame. `ok`: whether there is a result.
= failure, tool
failure: ok false, error str?, poses [pose], rejected [str]
tool: ok true, tool_mass float, tool_mass_interval float, tool_center_of_gravity [float],
    tool_center_of_gravity_interval [float], tool_inertia [float], tool_inertia_interval [float],
    bias [float], bias_interval [float], confidence float,
    force_rms float, torque_rms float, force_fit fit, torque_fit fit, accelerometer accelerometer?, gravity
    float, notes [str], poses [pose], rejected [str], drift [float]?, touched int?
fit: rms float, degrees float, chi_square float?, verdict noise|small|large
accelerometer: offset [float], scale [float], offset_interval [float], scale_interval [float], undetermined
    str, model str "What was fitted of it, and why.", cross_axis [float], cross_axis_interval [float]
pose: begin_s float, seconds float, samples int, force [float], torque [float], gravity [float],
    force_spread [float], torque_spread [float], residual_force~ [float], residual_torque~ [float]

# monitor: ethercat-monitor --json
A line per second; with --once, one. SI units (counts with the calibration matrix off); null: not known.
= line
line: time float "Unix time, s.", address str, connected bool, since_s float? "Since when connected or
    not.", heard_s float? "Since the last message of the server.", reason str? "Why not connected.", replay
    str? "The recording that the server replays.", server server? "As in describe and status; null if not
    connected.", sensors [sensor], clients [client]
server: version str, *Status(uptime_s cycles missed_deadlines lost_frames), wake_us times? "Lateness of
    exchanges in the last 10 s.", exchange_us times? "Duration of exchanges in the last 10 s."
client: peer str, this bool "Whether it is this program.", rate_hz float?, sent int "Frames.", withheld int
    "Frames."
times: p50 float, p99 float
age: p50 float, worst float
delays: force_torque float?, acceleration float?, angular_rate float?
alert: severity {_VERDICT}, text str, remedy str
clock: *ClockStatus(mode offset_ppm uncertainty_us)
compensated: force [float] "Newest sample, N.", torque [float] "Nm.", force_bound float "95 %, N.",
    torque_bound float "95 %, Nm.", contact contact? "With contact.surface."
contact: detected bool, point [float]? "In the sensor's frame, m.", press bool? "False: a pull.", region_m
    float? "The longer semi-axis of the 95 % region."
sensor: sensor int "Position on the bus, from 0.", *SensorInfo(name serial firmware), state str "AL state,
    or LOST.", nominal_hz float?, delay_ms delays "Group delay of the filters.", units [str] "Of force and
    torque: N and Nm, or counts without the calibration matrix.", force [float?]? "Newest sample: x, y, z.",
    torque [float?]? "Newest sample: x, y, z.", force_min_max [[float?]]? "Of each axis, in this second.",
    torque_min_max [[float?]]? "Of each axis, in this second.", acceleration [float?]? "Newest sample:
    m/s².", angular_rate [float?]? "Newest sample: rad/s.", temperature float? "Newest sample: °C.",
    orientation [float?]? "Newest sample: x, y, z, w.", compensated compensated? "With --tool.",
    saturated [str] "Names of axes: Fx to Mz, ax, ωx and so on.", verdict {_VERDICT}, alerts [alert]
    "Findings of this second.", samples int "New samples since connecting.", rate_hz float? "In the last
    5 s.", age_us age? "On arrival, in the last 5 s; on the server's machine only.", jitter_us float?
    "Of the intervals between stamps, in the last 5 s.", jitter_worst_us float? "In the last 5 s.",
    missed int? "Missing frames since connecting.", gaps int? "Frames with GAP since connecting.",
    repeated int? "Frames with REPEATED since connecting.", invalid int? "Frames with INVALID since
    connecting.", silent_s float? "Since the last new sample.", lost_on_bus SensorStatus.lost_samples
    "As the server counts.", recoveries SensorStatus.recoveries "As the server counts.", clock clock?
    "As in status.", hand_out_us times? "Age when sent."

# report: ethercat-report --json
One object per sensor; nothing if there is no report.
= [report]
report: sensor int, *SensorInfo(name serial), source str, verdict good|not-possible|look|trouble, sentence
    str, remarks [str], stream stream, checks [check]
stream: verdict good|not-possible|look|trouble, sentence str
check: check str, outcome good|not-possible|look|trouble, found str, matters str, remedy str

# sensor: ethercat-sensor COMMAND --json
One object by the schema of the command's name in $defs, or the error. SI units; `through` is the interface
or server.
= error, adapters, find, eeprom, objects, apply, save, tare, snapshot, restore, filters
error: error str
adapters: adapters [adapter]
adapter: name str, kind str, address str?, up bool, carrier bool, loopback bool, held_by str?, default_route
    bool, ip_addresses [str], ...
find: interfaces [interface]
interface: name str, looked bool, found str, sensors [found], other_slaves int
found: sensor int, position~ int, name str, serial int
eeprom: slaves [unread/slave]
unread: sensor int, error str
slave: sensor int, vendor int, product int, revision int, serial int, name str, order str, group str,
    check_byte int, check_byte_right bool, mailboxes mailboxes, protocols [str], coe_details int?,
    sync_managers [sync_manager], raw str, ...
mailboxes: out [int], in [int]
sync_manager: start int, size int, control int, enabled bool, kind str
objects: through str, sensors [sensor]
read: through str, sensors [sensor]
sensor: sensor int, name str, serial int, hardware str, firmware str, objects [object_entry], error~ str
object_entry: index str, subindex int, name str, type str, access str, write_states [str], unit str, allowed
    any, default any, hex~ str, value~ any, meaning~ str, error~ str
change: name str, now any, then any, meaning str, preop_only bool
apply: {_FOUND}, changes [change], saved bool, settings object, rate_hz float, meaning object
save: {_FOUND}, saved bool
tare: {_FOUND}, old_offset [float], new_offset [float], residual [float], deviation [float], ...
snapshot: {_FOUND}, file str, objects int
restore: {_FOUND}, changes [change], objects [restored], left_alone [str], saved bool
restored: index str, subindex int, name str, now str, then str
filters: loop_hz float, bandwidth_hz float, recommended recommended, settings [choice]
recommended: sinc_length int, fir bool, why str
choice: sinc_length int, fir bool, rate_hz int, cutoff_hz float, noise float, noise_limit_n float?,
    margin_deg float, delay_ms float, delay_source str, phase_deg phases
phases: 5 float, 10 float, 20 float, 50 float
"""
_TYPES: Final[dict[object, Schema]] = {
    "any": {},
    "object": {"type": "object"},
    "true": {"enum": [True]},
    "false": {"enum": [False]},
    "str": {"type": "string"},
    "int": {"type": "integer"},
    "float": {"type": "number"},
    "bool": {"type": "boolean"},
    str: {"type": "string"},
    int | None: {"type": ["integer", "null"]},
    float | None: {"type": ["number", "null"]},
}
_PART: Final = re.compile(
    r"\*(?P<row>\w+)\((?P<fields>[\w ]*)\)|"
    r'(?P<name>\w+)(?P<free>~?) (?P<kind>[^\s,"]+)(?: "(?P<text>[^"]*)")?'
)


def _of_row(row: str, field: str) -> Schema:
    return dict(_TYPES[get_type_hints(getattr(replies, row))[field]])


def _type(text: str) -> Schema:
    if text.endswith("?"):
        found = _type(text[:-1])
        if "$ref" in found:
            return {"anyOf": [found, {"type": "null"}]}
        return found | {"type": [found["type"], "null"]}
    if text.startswith("["):
        return {"type": "array", "items": _type(text[1:-1])}
    if "|" in text:
        return {"enum": text.split("|")}
    if "/" in text:
        return {"anyOf": [_type(each) for each in text.split("/")]}
    if "." in text:
        return _of_row(*text.split("."))
    return dict(_TYPES[text]) if text in _TYPES else {"$ref": f"#/$defs/{text}"}


def _object(text: str) -> Schema:
    properties, free = dict[str, Schema](), set[str]()
    for part in _PART.finditer(text):
        if part["row"]:
            properties |= {field: _of_row(part["row"], field) for field in part["fields"].split()}
            continue
        meaning = {"description": part["text"]} if part["text"] else {}
        properties[part["name"]] = meaning | _type(part["kind"])
        free |= {part["name"]} if part["free"] else set()
    required = [name for name in properties if name not in free]
    found: Schema = {"type": "object", "properties": properties, "required": required}
    return found if text.endswith("...") else found | {"additionalProperties": False}


def generate() -> dict[str, Schema]:
    """The schemas by the names of their files."""
    found = {}
    for document in re.split(r"^# ", _DOCUMENTS, flags=re.MULTILINE)[1:]:
        about, values, objects = re.split(r"^= (.*)$", document, maxsplit=1, flags=re.MULTILINE)
        name, title, text = re.split(r": |\n", about.rstrip(), maxsplit=2)
        options = [_type(value) for value in values.split(", ")]
        found[name] = {
            "$schema": "https://json-schema.org/draft/2020-12/schema", "title": title,
            "description": text.replace("\n", " "),
            **(options[0] if len(options) == 1 else {"anyOf": options}),
            "$defs": {
                each[1]: _object(each[2].replace("\n   ", ""))
                for each in re.finditer(r"^(\w+): ((?:.|\n {4})*)", objects, re.MULTILINE)
            },
        }  # fmt: skip
    return found


def text_of(schema: Schema) -> str:
    """The content of its file."""
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    argparse.ArgumentParser(prog="scripts.schemas", description=__doc__).parse_args()
    for name, schema in generate().items():
        (FOLDER / f"{name}.json").write_text(text_of(schema), encoding="utf-8")
