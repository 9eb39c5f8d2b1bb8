"""The binary logs of flight controllers and robots: columns by name, each with a kept library.

Blackbox by orangebox, PX4's ULog by pyulog, MCAP (JSON and ROS 2) by mcap, all extras; the binary
log of the Crazyflie's µSD card, which has no library, by its own description in its header.
"""

import json
import math
import struct
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidjax import _checks

# All names, and the arrays of the wanted ones.
Columns = tuple[list[str], dict[str, Any]]


class Layout(NamedTuple):
    """Names of the time and the three rate columns, the unit of the rates, that of the time."""

    columns: tuple[str, str, str, str]
    unit: str
    time_unit: str


def blackbox(path: Path, columns: Sequence[str]) -> Columns:
    """The names of all fields, and the wanted ones, of the first flight in a Blackbox log.

    Rates come in deg/s and accelerations in g by the scales in the header, as in the flight
    controllers' own viewer; other fields as logged. A log without its last mark is read to its end.
    """
    parser = _checks.library("orangebox", "blackbox", str(path)).Parser.load(str(path))
    names = parser.field_names
    wanted = {name: (names.index(name), array("d")) for name in columns if name in names}
    try:
        for frame in parser.frames():
            for place, numbers in wanted.values():
                numbers.append(float(frame.data[place]))
    except (RuntimeError, IndexError, TypeError):
        # At the end of a log without a last mark the parser raises one of these.
        if parser.reader.tell() < len(parser.reader):
            raise
    scales = _scales(parser.headers)
    return names, {
        name: np.frombuffer(numbers, float) * scales.get(name.partition("[")[0], 1.0)
        for name, (_, numbers) in wanted.items()
    }


def _scales(headers: dict[str, Any]) -> dict[str, float]:
    """The factors of the raw numbers of some fields."""
    found = {}
    if "gyro_scale" in headers:
        value = headers["gyro_scale"]
        # Written as the bits of a float, which the parser takes for a whole number.
        scale = struct.unpack("f", struct.pack("I", value))[0] if isinstance(value, int) else value
        baseflight = "baseflight" in str(headers.get("Firmware type", "")).lower()
        found["gyroADC"] = scale * (1e6 * 180 / math.pi if baseflight else 1.0)
    if "acc_1G" in headers:
        found["accSmooth"] = 1.0 / float(headers["acc_1G"])
    return found


def ulog(path: Path, columns: Sequence[str]) -> Columns:
    """`topic.field` of a ULog of PX4, as `sensor_combined.gyro_rad[0]`, `topic#1.field` of a second
    instance; times in µs.
    """
    reader, held = _checks.library("pyulog", "ulog", str(path)).ULog, {}
    # The library does not close a file that it opened itself and cannot read.
    with path.open("rb") as file:
        topics = reader(file).data_list
    for data in topics:
        topic = data.name + (f"#{data.multi_id}" if data.multi_id else "")
        held |= {f"{topic}.{name}": values for name, values in data.data.items()}
    return list(held), {name: held[name] for name in columns if name in held}


def mcap(path: Path, columns: Sequence[str]) -> Columns:
    """`topic.field.part` of the JSON and ROS 2 messages in an MCAP file, as
    `/imu.angular_velocity.x`; `topic.log_time` and `topic.stamp` (of its header), s from the first
    message of the file.
    """
    make_reader = _checks.library("mcap.reader", "mcap", str(path)).make_reader
    ros = _checks.library("mcap_ros2.decoder", "mcap", str(path)).DecoderFactory
    names: dict[str, None] = {}
    held: dict[str, array] = {name: array("d") for name in columns}
    first = None
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[_Json(), ros()])
        for number, (_, channel, message, content) in enumerate(reader.iter_decoded_messages()):
            if not columns and number == _ENOUGH:
                # Only names are asked for.
                break
            first = message.log_time if first is None else first
            fields = {"log_time": 1e-9 * (message.log_time - first)} | dict(_numbers_in(content))
            if {"header.stamp.sec", "header.stamp.nanosec"} <= set(fields):
                whole = 10**9 * int(fields["header.stamp.sec"]) - first
                fields["stamp"] = 1e-9 * (whole + int(fields["header.stamp.nanosec"]))
            for field, number in fields.items():
                name = f"{channel.topic}.{field}"
                names[name] = None
                if name in held:
                    held[name].append(number)
    return list(names), {name: np.frombuffer(a, float) for name, a in held.items() if len(a)}


# Messages in which each topic is seen once.
_ENOUGH = 2000


class _Json:
    """mcap's interface of a decoder, for messages in JSON."""

    def decoder_for(self, encoding: str, schema: Any) -> Callable[[bytes], Any] | None:
        return json.loads if encoding == "json" else None


def _numbers_in(content: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """The numbers in a message, with the names of their places."""
    if isinstance(content, bool | int | float | np.number):
        yield name, float(content)
    elif isinstance(content, list | tuple | np.ndarray):
        for index, one in enumerate(content):
            yield from _numbers_in(one, f"{name}[{index}]")
    elif not isinstance(content, str | bytes):
        named = isinstance(content, Mapping)
        for part in content if named else getattr(content, "__slots__", ()):
            inside = content[part] if named else getattr(content, part)
            yield from _numbers_in(inside, f"{name}.{part}" if name else str(part))


_CRAZYFLIE = 0xBC


def crazyflie(path: Path, columns: Sequence[str]) -> Columns:
    """The variables of a Crazyflie's µSD log by name, as `gyro.x`, and their `timestamp`, µs.

    They are those of the event with most of the wanted names. Source: the format's description in
    the firmware's documentation, "µSD card deck", versions 1 and 2.
    """
    data = path.read_bytes()
    version, count = struct.unpack_from("<HH", data, 1)
    if data[0] != _CRAZYFLIE or version not in (1, 2):
        raise ValueError(f"wanted a µSD log of version 1 or 2, got {data[0]:#x}, {version}")
    at, events = 5, {}

    def text(at: int) -> tuple[str, int]:
        end = data.index(b"\0", at)
        return data[at:end].decode(), end + 1

    for _ in range(count):
        key = struct.unpack_from("<H", data, at)[0]
        _, at = text(at + 2)
        size, at = struct.unpack_from("<H", data, at)[0], at + 2
        names, kinds = ["timestamp"], "I" if version == 1 else "Q"
        for _ in range(size):
            # A name and the kind of its number, as `gyro.x(f)`.
            word, at = text(at)
            names, kinds = [*names, word[:-3]], kinds + word[-2]
        events[key] = names, struct.Struct("<" + kinds), array("d")
    # The last four bytes are a check sum.
    while at < len(data) - 4:
        _, form, rows = events[struct.unpack_from("<H", data, at)[0]]
        rows.extend(form.unpack_from(data, at + 2))
        at += 2 + form.size
    names, _, rows = max(events.values(), key=lambda e: (len({*columns} & {*e[0]}), len(e[2])))
    table = np.frombuffer(rows, float).reshape(-1, len(names)).T
    held = dict(zip(names, table, strict=True))
    held["timestamp"] = held["timestamp"] * (1e3 if version == 1 else 1.0)
    every = [name for names, *_ in events.values() for name in names]
    return list(dict.fromkeys(every)), {name: held[name] for name in columns if name in held}


READERS = {".bbl": blackbox, ".bfl": blackbox, ".ulg": ulog, ".mcap": mcap, ".usd": crazyflie}


def kind_of(path: Path) -> str:
    """The ending of a log, in small letters; `.usd` for a Crazyflie's, which has none."""
    if path.suffix or not path.is_file():
        return path.suffix.lower()
    with path.open("rb") as file:
        return ".usd" if file.read(1) == bytes([_CRAZYFLIE]) else ""


def usual(path: Path) -> Layout | None:
    """The time and the rates that such a log has; `None` if it has no rates."""
    kind = kind_of(path)
    if kind in (".bbl", ".bfl"):
        return Layout(("time", "gyroADC[0]", "gyroADC[1]", "gyroADC[2]"), "deg/s", "us")
    if kind == ".usd":
        return Layout(("timestamp", "gyro.x", "gyro.y", "gyro.z"), "deg/s", "us")
    names, _ = READERS[kind](path, [])
    for stem, parts in (
        ("gyro_rad", ("[0]", "[1]", "[2]")),
        ("xyz", ("[0]", "[1]", "[2]")),
        ("angular_velocity", (".x", ".y", ".z")),
    ):
        for name in names:
            topic, _, field = name.rpartition(f".{stem}{parts[0]}")
            if topic and not field and (stem != "xyz" or topic == "vehicle_angular_velocity"):
                times = ("timestamp",) if kind == ".ulg" else ("stamp", "log_time")
                time = next(f"{topic}.{t}" for t in times if f"{topic}.{t}" in names)
                x, y, z = (f"{topic}.{stem}{part}" for part in parts)
                return Layout((time, x, y, z), "rad/s", "us" if kind == ".ulg" else "s")
    return None
