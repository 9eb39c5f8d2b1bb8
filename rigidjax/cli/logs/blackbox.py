"""Blackbox logs of flight controllers, whose fields are decoded by orangebox (an extra).

The library hands on frames that stand on no I frame (a P frame holds differences), so that the
order of frames is followed here, as the flight controllers' own decoder does.
"""

import math
import re
import struct
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rigidjax import _checks
from rigidjax.cli.logs.columns import Columns
from rigidjax.cli.logs.errors import LogError, warn

# The bounds of the flight controllers' own decoder; times in µs, both counters have 32 bits.
_LONGEST_FRAME, _ITERATION_JUMP, _TIME_JUMP, _WRAP = 256, 5_000, 10_000_000, 2**32
# How many numbers of variable length follow each kind of event.
_EVENT_NUMBERS = {0: 1, 14: 2, 15: 1, 30: 2}
_RESUME, _ADJUSTMENT, _LOG_END = 14, 13, 255
_END_MARK = b"End of log\0"
_ERASED = re.compile(rb"[\xff\0]*\Z")


def blackbox(path: Path, columns: Sequence[str], flight: int | None = None) -> Columns:
    """Return the names of all fields, and the wanted ones, of one flight in a Blackbox log.

    Rates come in deg/s and accelerations in g by the scales in the header, as in the flight
    controllers' own viewer; other fields as logged. A log without its last mark is read to its end.
    P frames before the first I frame, and frames from a hurt one to the next I frame, are left out
    with a warning. **Raises** `LogError` where there are several flights and none is chosen.
    """
    library = _checks.library("orangebox.reader", "blackbox", str(path))
    pointers = library.Reader(str(path)).log_pointers
    if flight is None and len(pointers) > 1 and columns:
        ends = [*pointers[1:], path.stat().st_size]
        sizes = ", ".join(f"{(b - a) / 1e3:.3g}" for a, b in zip(pointers, ends, strict=True))
        raise LogError(
            f"{path}: {len(pointers)} flights are in this log, of {sizes} kB; choose one: "
            f"--flight 1 to {len(pointers)} (flight= in Python)"
        )
    if flight is not None and not 1 <= flight <= len(pointers):
        raise LogError(f"{path}: no flight {flight}; it holds {len(pointers)}")
    index = flight or 1
    data = path.read_bytes()[pointers[index - 1] : (*pointers, None)[index]]
    log = _Flight(library.Reader(str(path), index), data)
    scales, wanted = _scales(log.headers), [name for name in columns if name in log.names]
    rows, groups = {name: array("d") for name in wanted}, array("q")
    for group, frame in log.frames():
        groups.append(group)
        for name, numbers in rows.items():
            numbers.append(frame[name])
    keep = ~np.isin(np.frombuffer(groups, np.int64), log.order.incomplete_groups())
    log.left_out += int((~keep).sum())
    if log.left_out:
        warn(
            f"{path}: {log.left_out} of {log.count} frames are left out: they stand on no whole I "
            "frame (the first one is missing, or a frame is hurt)"
        )
    return log.names, {
        name: log.wrapped(name, np.frombuffer(numbers, float)[keep])
        * scales.get(name.partition("[")[0], 1.0)
        for name, numbers in rows.items()
    }


class _Bytes:
    """Iterate over bytes, as the library's decoders read them; `place` is that of the next one."""

    def __init__(self, data: bytes, place: int):
        self.data, self.place = data, place

    def __next__(self) -> int:
        self.place += 1
        # An `IndexError` says that the data end within a frame.
        return self.data[self.place - 1]


class _Flight:
    """One flight: its header, and its frames in the order of the log.

    `count` is the number of I and P frames met so far, `left_out` that of those not handed on.
    """

    def __init__(self, reader: Any, data: bytes):
        types = _checks.library("orangebox.types", "blackbox", "a Blackbox log")
        context = _checks.library("orangebox.context", "blackbox", "a Blackbox log").Context
        self.headers: Mapping[str, Any] = reader.headers
        self.fields: Mapping[Any, Sequence[Any]] = reader.field_defs
        self.context = context(self.headers, self.fields)
        self.kinds = {ord(kind.value): kind for kind in types.FrameType}
        self.kind, self.frame = types.FrameType, types.Frame
        self.data, self.count, self.left_out = data, 0, 0
        self.order = _Order()
        self.main = [field.name for field in self.fields[self.kind.INTRA]]
        others = [self.fields.get(kind, ()) for kind in (self.kind.SLOW, self.kind.GPS)]
        self.others = [field.name for kind in others for field in kind]
        self.names = list(dict.fromkeys([*self.main, *self.others]))

    def wrapped(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return the values of a field as the 32-bit numbers that the flight controller had."""
        if name not in self.main or name == "time":
            return values
        if self.fields[self.kind.INTRA][self.main.index(name)].signed:
            return (values + _WRAP / 2) % _WRAP - _WRAP / 2
        return values % _WRAP

    def frames(self) -> Iterator[tuple[int, Mapping[str, float]]]:
        """Yield the group and the fields, by name, of each frame that stands on a whole I frame.

        The group is that of a P frame, and -1 for an I frame, which stands alone. Fields of slow
        and GPS frames have the values of the last such frame, NaN before the first.
        """
        order, lost = self.order, 0
        stream, others = _Bytes(self.data, self._header_size()), dict.fromkeys(self.others, np.nan)
        while stream.place < len(self.data):
            kind = self.kinds.get(next(stream))
            begin = stream.place
            if kind is None or (kind != self.kind.EVENT and kind not in self.fields):
                # A frame without its letter; erased memory at the end of a log is none.
                lost, order.is_valid = lost + order.is_valid, False
                continue
            is_main = kind in (self.kind.INTRA, self.kind.INTER)
            if is_main:
                self.count, self.left_out = self.count + 1 + lost, self.left_out + lost
                lost = 0
            try:
                if kind == self.kind.EVENT:
                    event, numbers = self._event(stream)
                    if event == _LOG_END:
                        return
                    if event == _RESUME:
                        order.resume(numbers)
                    continue
                values = self._values(stream, kind)
            except IndexError:
                values = ()
            size = stream.place - begin
            if not values or size > _LONGEST_FRAME or not self._is_frame_next(stream.place):
                # It may have swallowed the letter of the next frame.
                stream.place, order.is_valid = begin, False
                self.left_out += is_main
            elif not is_main:
                others |= zip((field.name for field in self.fields[kind]), values, strict=True)
                if kind != self.kind.SLOW:
                    self.context.add_frame(self.frame(kind, values))
            elif not order.accepts(values[:2], kind == self.kind.INTRA, self._next_iteration()):
                self.left_out += 1
            else:
                self.context.last_iter = values[0]
                self.context.add_frame(self.frame(kind, values))
                fields = dict(zip(self.main, values, strict=True)) | {"time": order.time}
                yield -1 if kind == self.kind.INTRA else order.groups, others | fields

    def _next_iteration(self) -> int:
        """Return the iteration after that of the last frame, by the header's intervals."""
        return self.context.last_iter + 1 + self.context.count_skipped_frames()

    def _is_frame_next(self, place: int) -> bool:
        """Whether the bytes from here on are a frame, a P frame without its letter, or the end.

        Where they are none, the frame before is probably hurt itself: it has too few bytes or too
        many. Erased memory is an end.
        """
        if place == len(self.data) or self.data[place] in self.kinds:
            return True
        if _ERASED.match(self.data, place):
            return True
        stream = _Bytes(self.data, place + 1)
        try:
            self._values(stream, self.kind.INTER)
        except IndexError:
            return False
        return stream.place == len(self.data) or self.data[stream.place] in self.kinds

    def _header_size(self) -> int:
        """Return where the lines of the header end."""
        place = 0
        while self.data.startswith(b"H ", place):
            place = self.data.index(b"\n", place) + 1
        return place

    def _values(self, stream: _Bytes, kind: Any) -> tuple[Any, ...]:
        """Decode the fields of one frame."""
        context, fields, values = self.context, self.fields[kind], ()
        context.frame_type, context.field_index = kind, 0
        while context.field_index < len(fields):
            context.current_frame = values
            raw = fields[context.field_index].decoderfun(stream, context)
            for one in raw if isinstance(raw, tuple) else (raw,):
                values += (fields[context.field_index].predictorfun(one, context),)
                context.field_index += 1
        return values

    def _event(self, stream: _Bytes) -> tuple[int, list[int]]:
        """Pass one event; return its kind (-1 for an unknown one) and its numbers."""
        event = next(stream)
        if event == _LOG_END:
            is_last = self.data.startswith(_END_MARK, stream.place)
            return (_LOG_END if is_last else -1), []
        if event == _ADJUSTMENT:
            if next(stream) > 127:
                stream.place += 4
                return event, []
            return event, [_unsigned(stream)]
        if event not in _EVENT_NUMBERS:
            return -1, []
        return event, [_unsigned(stream) for _ in range(_EVENT_NUMBERS[event])]


class _Order:
    """Follow the iterations and times of I and P frames.

    A group is an I frame and the P frames after it; `groups` counts them, `incomplete` are those
    with too few frames. `time` is that of the last frame, µs, without the jumps of a clock of 32
    bits. `is_valid` says whether all frames since the last I frame were whole.
    """

    def __init__(self):
        self.is_valid, self.is_resumed = False, False
        self.last: Sequence[int] = ()
        self.last_key: Sequence[int] = ()
        self.time, self.key_time = 0, 0
        self.groups, self.incomplete = 0, list[int]()

    def resume(self, numbers: Sequence[int]) -> None:
        """Go on at the iteration and the time of an event after a pause."""
        self.last = self.last_key = tuple(numbers)
        self.is_resumed = True

    def accepts(self, values: Sequence[int], is_key: bool, expected: int) -> bool:
        """Whether a frame of this iteration and time follows the last one; it is the last then."""
        if is_key:
            if self.is_valid and not self.is_resumed and self._lacks_frames(values, expected):
                self.incomplete.append(self.groups)
            self.is_valid = not self.last_key or _continues(self.last_key, values)
        else:
            self.is_valid = self.is_valid and _continues(self.last, values)
        if self.is_valid:
            if is_key:
                # A time that is wrong in a P frame must not move those of later groups.
                ahead = (values[1] - self.key_time) % _WRAP
                self.key_time = self.key_time + ahead if self.groups else values[1]
                self.groups += 1
            self.time = self.key_time + (values[1] - self.key_time) % _WRAP
            self.last = values
        if is_key:
            # If it does not continue the last I frame, either may be the hurt one: the next I frame
            # is compared with the later.
            self.last_key, self.is_resumed = values, False
        return self.is_valid

    def _lacks_frames(self, key: Sequence[int], expected: int) -> bool:
        """Whether an I frame is not the one after the last frame; a greater jump is a pause."""
        is_earlier = (key[1] - self.last[1]) % _WRAP >= _WRAP // 2
        return is_earlier or 0 < (key[0] - expected) % _WRAP < _ITERATION_JUMP

    def incomplete_groups(self) -> list[int]:
        """Return the groups that lost frames unseen; none if that is so of half the groups.

        Then it is the header's interval of frames that is not what the log has.
        """
        return self.incomplete if 2 * len(self.incomplete) < self.groups else []


def _unsigned(stream: _Bytes) -> int:
    """Read a number of variable length: seven bits a byte, the eighth says that more follow."""
    number, shift = 0, 0
    while shift < 35:
        byte = next(stream)
        number |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return number
    return 0


def _continues(last: Sequence[int], values: Sequence[int]) -> bool:
    """Whether iteration and time of a frame go on from the last one, and not too far."""
    iteration, time = ((new - old) % _WRAP for old, new in zip(last, values, strict=True))
    return iteration < _ITERATION_JUMP and time < _TIME_JUMP


def _scales(headers: Mapping[str, Any]) -> dict[str, float]:
    """Return the factors of the raw numbers of some fields."""
    factors = {}
    if "gyro_scale" in headers:
        value = headers["gyro_scale"]
        # Written as the bits of a float, which the parser takes for a whole number.
        scale = struct.unpack("f", struct.pack("I", value))[0] if isinstance(value, int) else value
        baseflight = "baseflight" in str(headers.get("Firmware type", "")).lower()
        factors["gyroADC"] = scale * (1e6 * 180 / math.pi if baseflight else 1.0)
    if "acc_1G" in headers:
        factors["accSmooth"] = 1.0 / float(headers["acc_1G"])
    return factors
