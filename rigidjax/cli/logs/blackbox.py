"""Blackbox logs of flight controllers, read by orangebox (an extra)."""

import math
import struct
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rigidjax import _checks
from rigidjax.cli.logs.columns import Columns


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
