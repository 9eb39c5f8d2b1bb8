"""Blackbox logs of flight controllers (Betaflight, INAV, Cleanflight): `.bbl` and `.bfl`."""

import math
import struct
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

SUFFIXES = (".bbl", ".bfl")
# The rates in deg/s, the time in µs.
COLUMNS = ("time", "gyroADC[0]", "gyroADC[1]", "gyroADC[2]")


def read_blackbox(path: Path, columns: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """The names of all fields, and those that are wanted, of the first flight in a file.

    Rates (`gyroADC[i]`) come in deg/s and accelerations (`accSmooth[i]`) in g, by the scales in the
    header; other fields as logged, the time in µs. A log without its last mark, as after a crash,
    is read up to its end.

    Source: the parser is that of the package orangebox; the scales are those of the flight
    controllers' own viewer: raw × gyro_scale is deg/s (Baseflight: rad/µs), raw / acc_1G is g.

    **Raises:** `ModuleNotFoundError` if orangebox is missing; orangebox's own errors for a file of
    another kind.
    """
    try:
        from orangebox import Parser
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{path}: Blackbox logs are read by orangebox, which is missing: pip install "
            "'rigidjax[blackbox]'"
        ) from error
    parser = Parser.load(str(path))
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
