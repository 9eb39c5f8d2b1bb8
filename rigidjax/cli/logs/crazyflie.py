"""Read the Crazyflie's µSD log, for which there is no library; the header of a log describes its
format.
"""

import struct
from array import array
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rigidjax.cli.logs.log import Log

FIRST_BYTE = 0xBC
UNITS = {"timestamp": "us", "gyro": "deg/s", "acc": "g"}


def read_crazyflie(path: Path) -> Log:
    """Return the variables of a Crazyflie's µSD log, such as `gyro.x`; the times are the variable
    `timestamp`, µs.

    A log holds several events, each with its own variables and times. The event that has most of
    the wanted variables is read, and of two events with equally many the one with more data.
    Source: the description of the format in the documentation of the firmware, "µSD card deck",
    versions 1 and 2.
    """
    data = path.read_bytes()
    version, count = struct.unpack_from("<HH", data, 1)
    if data[0] != FIRST_BYTE or version not in (1, 2):
        raise ValueError(
            f"wanted a µSD log of version 1 or 2, got version {version}, first byte {data[0]:#x}"
        )
    at, events = 5, {}

    def text(start: int) -> tuple[str, int]:
        end = data.index(b"\0", start)
        return data[start:end].decode(), end + 1

    for _ in range(count):
        key = struct.unpack_from("<H", data, at)[0]
        _, at = text(at + 2)
        size, at = struct.unpack_from("<H", data, at)[0], at + 2
        names, kinds = ["timestamp"], "I" if version == 1 else "Q"
        for _ in range(size):
            # In the header of the log each variable of an event is one word: its name and the type
            # of its numbers, such as `gyro.x(f)`.
            word, at = text(at)
            names, kinds = [*names, word[:-3]], kinds + word[-2]
        events[key] = names, struct.Struct("<" + kinds), array("d")
    # The last four bytes of the log are a check sum, not data.
    while at < len(data) - 4:
        _, form, rows = events[struct.unpack_from("<H", data, at)[0]]
        rows.extend(form.unpack_from(data, at + 2))
        at += 2 + form.size

    def read(columns: Sequence[str]) -> dict[str, np.ndarray]:
        names, _, rows = max(events.values(), key=lambda e: (len({*columns} & {*e[0]}), len(e[2])))
        table = np.frombuffer(rows, float).reshape(-1, len(names)).T
        arrays = dict(zip(names, table, strict=True))
        arrays["timestamp"] = arrays["timestamp"] * (1e3 if version == 1 else 1.0)
        return arrays

    names = list(dict.fromkeys(name for names, *_ in events.values() for name in names))
    units = {n: u for n in names for part, u in UNITS.items() if n.partition(".")[0] == part}
    return Log(names, read, units)
