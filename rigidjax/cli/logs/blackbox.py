"""Read Blackbox logs of flight controllers; orangebox (an extra) decodes the fields of their
frames.

A log is a sequence of frames, each of which begins with a letter for its kind. An I frame can be
decoded alone. A P frame holds differences from the frames before it, back to the last I frame. The
library orangebox returns P frames even if their I frame is missing. The order of frames is
therefore checked here, in the way of the flight controllers' own decoder.
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
from rigidjax.cli.logs.errors import LogError, warn
from rigidjax.cli.logs.log import Log

# The first two numbers are bounds of the flight controllers' own decoder: the largest jumps of the
# iteration and of the time, µs, between two frames. The counters of iteration and time have 32
# bits, so that they start again from zero where they would reach _WRAP. That decoder has a bound on
# the length of a frame, too, 256 bytes; it is not used here, since frames of many fields are
# longer.
_ITERATION_JUMP, _TIME_JUMP, _WRAP = 5_000, 10_000_000, 2**32
# An event is a record of the log without readings. For each kind of event this table has the number
# of integers of variable length that follow the kind in the log.
_EVENT_NUMBERS = {0: 1, 14: 2, 15: 1, 30: 2}
_RESUME, _ADJUSTMENT, _LOG_END = 14, 13, 255
_END_MARK = b"End of log\0"
_ERASED = re.compile(rb"[\xff\0]*\Z")
_HEADER = re.compile(rb"(?:H [^\n]*\n)*")
_FIELDS = re.compile(rb"^H Field [ISG] name:(.*)$", re.MULTILINE)
# A flight with frames: behind the lines of its header somewhere is the letter of an I frame.
_WITH_FRAMES = re.compile(rb"(?:H [^\n]*\n)+(?!H ).*?I", re.DOTALL)
# Fields of rates and of accelerations, by their names in old and new logs of several firmwares.
RATES = ("gyroADC", "gyroData", "gyroUnfilt", "gyroRaw", "gyroRAW")
ACCELERATIONS = ("accSmooth", "accADC")
# With the header `blackbox_high_resolution` these fields, and the rates, are ten times finer.
_FINER = (*(f"rcCommand[{i}]" for i in range(4)), *(f"setpoint[{i}]" for i in range(3)))
_SCALES = ("gyro_scale", "gyro.scale", "acc_1G", "blackbox_high_resolution")
# A header with such a name may change the unit of the rates or of the accelerations.
_LIKE_A_SCALE = re.compile(
    r"(?=.*(gyro|acc|imu|log|blackbox))(?=.*(scale|resolution|unit|lsb|1g))", re.IGNORECASE
)


def read_blackbox(path: Path, flight: int | None = None) -> Log:
    """Return one flight of a Blackbox log: rates in deg/s and accelerations in g, by the scales in
    the header, as in the flight controllers' own viewer; other fields as logged.

    P frames before the first I frame, and all frames from a damaged frame to the next I frame, are
    left out with a warning. A log without its end mark is read to the end of the file. It **warns**
    of a scale that is missing or not known. **Raises** `LogError` if no flight has frames, and when
    it is read if several have and `flight` (from 1) is `None`, and for a flight that is not there
    or without frames.
    """
    library = _checks.import_library("orangebox.reader", "blackbox", str(path))
    begins, whole = library.Reader(str(path)).log_pointers, path.read_bytes()
    flights = dict(enumerate(map(slice, begins, [*begins[1:], len(whole)]), 1))
    full = [n for n, at in flights.items() if _WITH_FRAMES.match(whole, at.start, at.stop)]
    some = ", ".join(map(str, full))
    if not full:
        raise LogError(f"{path}: no frames in this log; is it whole, and a Blackbox log?")

    def read(columns: Sequence[str]) -> dict[str, np.ndarray]:
        if flight is not None and flight not in flights:
            raise LogError(f"{path}: wanted a flight from 1 to {len(begins)}, got {flight}")
        if flight is None and len(full) > 1:
            sizes = ", ".join(f"{(flights[n].stop - flights[n].start) / 1e3:.3g}" for n in full)
            rest = len(flights) - len(full)
            raise LogError(
                f"{path}: {len(full)} flights are in this log, of {sizes} kB"
                + (f" ({rest} more have a header only)" if rest else "")
                + f"; choose one: --flight {some if rest else f'1 to {len(full)}'} (flight= in "
                "Python)"
            )
        index = flight or full[0]
        if index not in full:
            raise LogError(f"{path}: flight {index} has a header only; flights with frames: {some}")
        log = _Flight(library.Reader(str(path), index), whole[flights[index]])
        groups = array("q")
        rows = {name: array("d") for name in columns if name in log.names}
        factors = _factors(path, log.headers, list(rows))
        for group, frame in log.frames():
            groups.append(group)
            for name, numbers in rows.items():
                numbers.append(frame[name])
        keep = ~np.isin(np.frombuffer(groups, np.int64), log.order.lossy_groups())
        log.left_out += int((~keep).sum())
        if log.left_out:
            warn(
                f"{path}: {log.left_out} of {log.count} frames are left out: they depend on an I "
                "frame that is missing, or on a frame that is damaged"
            )
        values = {name: np.frombuffer(numbers, float)[keep] for name, numbers in rows.items()}
        return {name: log.wrapped(name, x) * factors[name] for name, x in values.items()}

    at = flights[flight if flight in full else full[0]]
    fields = _FIELDS.findall(whole, at.start, _HEADER.match(whole, at.start).end())  # pyright: ignore
    names = list(dict.fromkeys(name for line in fields for name in line.decode().split(",")))
    units = {"time": "us"} | dict.fromkeys(RATES, "deg/s") | dict.fromkeys(ACCELERATIONS, "g")
    stems = {name: name.partition("[")[0] for name in names}
    return Log(names, read, {name: units[stem] for name, stem in stems.items() if stem in units})


class _Bytes:
    """Provide the bytes of a log one by one to the package orangebox, which decodes the numbers;
    `place` is the index of the next byte.
    """

    def __init__(self, data: bytes, place: int):
        self.data, self.place = data, place

    def __next__(self) -> int:
        self.place += 1
        # An `IndexError` of this line tells the caller that the data end within a frame.
        return self.data[self.place - 1]


class _Flight:
    """Hold one flight of a Blackbox log: its header, and its frames in the order of the log."""

    def __init__(self, reader: Any, data: bytes):
        types = _checks.import_library("orangebox.types", "blackbox", "a Blackbox log")
        context = _checks.import_library("orangebox.context", "blackbox", "a Blackbox log").Context
        self.headers: Mapping[str, Any] = reader.headers
        self.fields: Mapping[Any, Sequence[Any]] = reader.field_defs
        self.context = context(self.headers, self.fields)
        self.kinds = {ord(kind.value): kind for kind in types.FrameType}
        self.kind, self.frame = types.FrameType, types.Frame
        # `count` I and P frames were read so far, of which `left_out` were left out.
        self.data, self.count, self.left_out = data, 0, 0
        self.order = _Order()
        self.main = [field.name for field in self.fields[self.kind.INTRA]]
        others = [self.fields.get(kind, ()) for kind in (self.kind.SLOW, self.kind.GPS)]
        self.others = [field.name for kind in others for field in kind]
        self.names = list(dict.fromkeys([*self.main, *self.others]))

    def wrapped(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return the values of a field as the 32-bit integers that the flight controller had, which
        sums of many differences may leave.

        The time, and the fields of slow and GPS frames, are no such sums.
        """
        if name not in self.main or name == "time":
            return values
        if self.fields[self.kind.INTRA][self.main.index(name)].signed:
            return (values + _WRAP / 2) % _WRAP - _WRAP / 2
        return values % _WRAP

    def frames(self) -> Iterator[tuple[int, Mapping[str, float]]]:
        """Yield each I and P frame that can be used, in order: its group, and its fields by name.

        The group of a P frame is the number of the last I frame before it, from 1; an I frame,
        which depends on no other frame, has the group -1. Slow and GPS frames yield nothing: their
        fields, NaN before the first such frame, stand in the I and P frames after them. The field
        `time` goes on where the 32-bit counter of the log starts again from zero.
        """
        order, lost = self.order, 0
        stream = _Bytes(self.data, _HEADER.match(self.data).end())  # pyright: ignore
        others = dict.fromkeys(self.others, np.nan)
        while stream.place < len(self.data):
            kind = self.kinds.get(next(stream))
            begin = stream.place
            if kind is None or (kind != self.kind.EVENT and kind not in self.fields):
                # The byte that was read is not the letter with which a frame of this log begins: it
                # belongs to a damaged frame. The frame is counted in `lost` if no frame since the
                # last I frame was damaged before. It is added to `left_out` only when a later frame
                # is found, since erased memory at the end of a log is no frame.
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
                values = self._decode(stream, kind)
            except IndexError:
                values = ()
            if not values or not self._is_boundary(stream.place):
                # This frame is damaged, so that its decoder may have read beyond the letter with
                # which the next frame begins. Reading therefore begins again after the letter of
                # this frame.
                stream.place, order.is_valid = begin, False
                self.left_out += is_main
            elif not is_main:
                others |= zip((field.name for field in self.fields[kind]), values, strict=True)
                if kind != self.kind.SLOW:
                    self.context.add_frame(self.frame(kind, values))
            elif not order.accept(
                values[:2],
                kind == self.kind.INTRA,
                # The header says how many iterations are skipped after a frame.
                self.context.last_iter + 1 + self.context.count_skipped_frames(),
            ):
                self.left_out += 1
            else:
                self.context.last_iter = values[0]
                self.context.add_frame(self.frame(kind, values))
                fields = dict(zip(self.main, values, strict=True)) | {"time": order.time}
                yield -1 if kind == self.kind.INTRA else order.groups, others | fields

    def _is_boundary(self, index: int) -> bool:
        """Return whether a frame (or a P frame whose letter is damaged), erased memory or the end
        of the data begins at a byte: else the frame before this byte is probably damaged.
        """
        # Erased memory matches at the end of the data, too.
        if _ERASED.match(self.data, index) or self.data[index] in self.kinds:
            return True
        stream = _Bytes(self.data, index + 1)
        try:
            self._decode(stream, self.kind.INTER)
        except IndexError:
            return False
        return stream.place == len(self.data) or self.data[stream.place] in self.kinds

    def _decode(self, stream: _Bytes, frame_type: Any) -> tuple[Any, ...]:
        """Return the numbers of the frame that begins at the present place of `stream`."""
        context, fields, values = self.context, self.fields[frame_type], ()
        context.frame_type, context.field_index = frame_type, 0
        while context.field_index < len(fields):
            context.current_frame = values
            raw = fields[context.field_index].decoderfun(stream, context)
            for one in raw if isinstance(raw, tuple) else (raw,):
                values += (fields[context.field_index].predictorfun(one, context),)
                context.field_index += 1
        return values

    def _event(self, stream: _Bytes) -> tuple[int, list[int]]:
        """Read an event, and return its kind and the integers that it holds; of an unknown kind -1
        and none.
        """
        event = next(stream)
        if event == _LOG_END and self.data.startswith(_END_MARK, stream.place):
            return event, []
        count = _EVENT_NUMBERS.get(event)
        if event == _ADJUSTMENT:
            count = 1
            if next(stream) > 127:
                stream.place += 4
                count = 0
        if count is None:
            return -1, []
        return event, [_varint(stream) for _ in range(count)]


class _Order:
    """Check the order of the frames by their iterations and times, µs.

    A group is an I frame and the P frames after it, up to the next I frame.
    """

    def __init__(self):
        # `is_valid`: no frame since the last I frame was damaged or missing.
        self.is_valid, self.is_resumed = False, False
        # The iteration and the time of the last frame, and of the last I frame.
        self.last: Sequence[int] = ()
        self.last_key: Sequence[int] = ()
        # The times of these frames, µs, which go on where the 32-bit counter starts again.
        self.time, self.key_time = 0, 0
        # The count of groups, and the numbers of those from which frames are missing.
        self.groups, self.incomplete = 0, list[int]()

    def resume(self, iteration_and_time: Sequence[int]) -> None:
        """Compare the next frame with the event that ends a pause of the logging, not with the
        frame before it.
        """
        self.last = self.last_key = tuple(iteration_and_time)
        self.is_resumed = True

    def accept(self, values: Sequence[int], is_i_frame: bool, expected: int) -> bool:
        """Return whether a frame can be used: an I frame that follows the last I frame closely, or
        is the first; a P frame that follows the last frame closely, if no frame since the last I
        frame was left out.

        A frame that can be used becomes the last frame. The iteration `expected` is that of the
        frame if none is missing before it.
        """
        if is_i_frame:
            if self.is_valid and not self.is_resumed:
                # An iteration that jumps by _ITERATION_JUMP or more means a pause of the logging,
                # in which no frames are missing.
                is_earlier = (values[1] - self.last[1]) % _WRAP >= _WRAP // 2
                if is_earlier or 0 < (values[0] - expected) % _WRAP < _ITERATION_JUMP:
                    self.incomplete.append(self.groups)
            self.is_valid = not self.last_key or _follows(self.last_key, values)
        else:
            self.is_valid = self.is_valid and _follows(self.last, values)
        if self.is_valid:
            if is_i_frame:
                # The time of a frame is computed from the time of the last I frame, since a wrong
                # time of one P frame must not shift the times of all later frames.
                elapsed = (values[1] - self.key_time) % _WRAP
                self.key_time = self.key_time + elapsed if self.groups else values[1]
                self.groups += 1
            self.time = self.key_time + (values[1] - self.key_time) % _WRAP
            self.last = values
        if is_i_frame:
            # The new I frame becomes the last I frame even if it does not closely follow the I
            # frame before it: either of the two may be damaged, so that the next I frame is
            # compared with the later of the two.
            self.last_key, self.is_resumed = values, False
        return self.is_valid

    def lossy_groups(self) -> list[int]:
        """Return the groups from which frames are missing; none if these seem to be half of all
        groups or more: the header then states another interval of frames than that of the log.
        """
        return self.incomplete if 2 * len(self.incomplete) < self.groups else []


def _varint(stream: _Bytes) -> int:
    """Return the integer of variable length at the present place of `stream`: seven bits a byte,
    the lowest first; the eighth is set if more bytes follow. One of more than five bytes is
    damaged, and gives zero.
    """
    number, shift = 0, 0
    while shift < 35:
        byte = next(stream)
        number |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return number
    return 0


def _follows(last_frame: Sequence[int], frame: Sequence[int]) -> bool:
    """Return whether a frame follows the last one as closely as the flight controllers' own decoder
    wants.
    """
    iteration, time = ((new - old) % _WRAP for old, new in zip(last_frame, frame, strict=True))
    return iteration < _ITERATION_JUMP and time < _TIME_JUMP


def _factors(path: Path, headers: Mapping[str, Any], columns: Sequence[str]) -> dict[str, float]:
    """Return the factors of the wanted fields: from integers to deg/s, g, and the usual units of
    commands.

    It **warns** of a scale that is missing, and of a header that may change a unit in a way that is
    not known.
    """
    finer = headers.get("blackbox_high_resolution", 0)
    gyro, one_g = headers.get("gyro_scale", headers.get("gyro.scale")), headers.get("acc_1G")
    # In the header the scale of the gyro is a float of 32 bits, whose bits the parser of the header
    # may have read as an integer.
    scale = gyro or 1.0
    if isinstance(scale, int):
        (scale,) = struct.unpack("f", struct.pack("I", scale))
    # Some firmwares, such as Baseflight, have a scale to rad/µs; none to deg/s is so small.
    scale *= 1e6 * 180 / math.pi if scale < 1e-6 else 1.0
    factors, unscaled = dict.fromkeys(columns, 1.0), []
    for name in columns:
        stem = name.partition("[")[0]
        if stem in RATES or name in _FINER:
            factors[name] = (scale if stem in RATES else 1.0) / (10 if finer else 1)
        elif stem in ACCELERATIONS and one_g:
            factors[name] = 1.0 / float(one_g)
        if (stem in RATES and not gyro) or (stem in ACCELERATIONS and not one_g):
            unscaled.append(name)
    if unscaled:
        listed = ", ".join(unscaled)
        warn(f"{path}: the header has no scale of the fields {listed}; they are read as logged")
    odd = [name for name in headers if _LIKE_A_SCALE.match(name) and name not in _SCALES]
    odd += ["blackbox_high_resolution"] if finer not in (0, 1) else []
    if odd and any(name.partition("[")[0] in RATES + ACCELERATIONS for name in columns):
        listed = ", ".join(f"{name}:{headers[name]}" for name in odd)
        warn(f"{path}: a header may change a unit in a way that is not known: {listed}")
    return factors
