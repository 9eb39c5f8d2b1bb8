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
from rigidjax.cli.logs.columns import Columns
from rigidjax.cli.logs.errors import LogError, warn

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


def read_blackbox(path: Path, columns: Sequence[str], flight: int | None = None) -> Columns:
    """Return two things: the names of all fields in one flight of a Blackbox log; and a dict of the
    fields that `columns` name.

    A frame is one record of the log: an I frame holds whole values, and a P frame holds differences
    from the frames before it. P frames before the first I frame, and all frames from a damaged
    frame to the next I frame, are left out with a warning. A log without its end mark is read to
    the end of the file.

    Rates are in deg/s and accelerations in g, by the scales in the header, as in the flight
    controllers' own viewer; other fields are as logged. It **warns** of a scale that is missing or
    not known. **Raises** `LogError` if no flight has frames, if several have and `flight` is
    `None`, and for a flight without frames.
    """
    library = _checks.import_library("orangebox.reader", "blackbox", str(path))
    begins, whole = library.Reader(str(path)).log_pointers, path.read_bytes()
    if flight is not None and not 1 <= flight <= len(begins):
        raise LogError(f"{path}: wanted a flight from 1 to {len(begins)}, got {flight}")
    flights = dict(enumerate(map(slice, begins, [*begins[1:], len(whole)]), 1))
    full = [n for n, at in flights.items() if _WITH_FRAMES.match(whole, at.start, at.stop)]
    some = ", ".join(map(str, full))
    if not full:
        raise LogError(f"{path}: no frames in this log; is it whole, and a Blackbox log?")
    if flight is None and len(full) > 1:
        sizes = ", ".join(f"{(flights[n].stop - flights[n].start) / 1e3:.3g}" for n in full)
        rest = len(flights) - len(full)
        raise LogError(
            f"{path}: {len(full)} flights are in this log, of {sizes} kB"
            + (f" ({rest} more have a header only)" if rest else "")
            + f"; choose one: --flight {some if rest else f'1 to {len(full)}'} (flight= in Python)"
        )
    index = flight or full[0]
    if index not in full:
        raise LogError(f"{path}: flight {index} has a header only; flights with frames: {some}")
    data = whole[flights[index]]
    log = _Flight(library.Reader(str(path), index), data)
    rows = {name: array("d") for name in columns if name in log.names}
    factors, groups = _factors_to_deg_per_s_and_g(path, log.headers, list(rows)), array("q")
    for group, frame in log.decode_frames_with_groups():
        groups.append(group)
        for name, numbers in rows.items():
            numbers.append(frame[name])
    keep = ~np.isin(np.frombuffer(groups, np.int64), log.order.groups_with_missing_frames())
    log.left_out += int((~keep).sum())
    if log.left_out:
        warn(
            f"{path}: {log.left_out} of {log.count} frames are left out: they depend on an I frame "
            "that is missing, or on a frame that is damaged"
        )
    return log.names, {
        name: log.wrap_to_32_bits(name, np.frombuffer(numbers, float)[keep]) * factors[name]
        for name, numbers in rows.items()
    }


class _Bytes:
    """Provide the bytes of a Blackbox log one by one to the package orangebox, which decodes the
    numbers in such logs.

    The field `place` is the index of the byte that is read next.
    """

    def __init__(self, data: bytes, place: int):
        self.data, self.place = data, place

    def __next__(self) -> int:
        self.place += 1
        # An `IndexError` of this line tells the caller that the data end within a frame.
        return self.data[self.place - 1]


class _Flight:
    """Hold one flight of a Blackbox log: its header, and its frames in the order of the log.

    A frame is one record of the log; an I frame holds whole values, and a P frame holds differences
    from the frames before it. **Fields**, among others: `names` the names of all fields of the
    frames; `count` the number of I and P frames that were read so far; `left_out` the number of
    these frames that were left out.
    """

    def __init__(self, reader: Any, data: bytes):
        types = _checks.import_library("orangebox.types", "blackbox", "a Blackbox log")
        context = _checks.import_library("orangebox.context", "blackbox", "a Blackbox log").Context
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

    def wrap_to_32_bits(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return the `values` of the field `name` as the 32-bit integers that the flight controller
        had: sums of many differences may lie outside of the range of such integers. The time, and
        the fields of slow frames and GPS frames (which hold other quantities than I and P frames),
        are returned unchanged.
        """
        if name not in self.main or name == "time":
            return values
        if self.fields[self.kind.INTRA][self.main.index(name)].signed:
            return (values + _WRAP / 2) % _WRAP - _WRAP / 2
        return values % _WRAP

    def decode_frames_with_groups(self) -> Iterator[tuple[int, Mapping[str, float]]]:
        """Yield a pair for each frame that can be decoded: its group, and its fields by name.

        A frame is one record of the log. An I frame holds whole values; a P frame holds differences
        from the frames before it. The group of a P frame is the number of the last I frame before
        it, counted from 1. An I frame, which depends on no other frame, has the group -1. Fields of
        slow and GPS frames have the values of the last such frame, and are NaN before the first
        such frame.
        """
        order, lost = self.order, 0
        stream, others = (
            _Bytes(self.data, _HEADER.match(self.data).end()),  # pyright: ignore
            dict.fromkeys(self.others, np.nan),
        )
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
                    event, numbers = self._read_event_kind_and_integers(stream)
                    if event == _LOG_END:
                        return
                    if event == _RESUME:
                        order.resume_after_pause(numbers)
                    continue
                values = self._decode_frame(stream, kind)
            except IndexError:
                values = ()
            if not values or not self._is_frame_or_end_at(stream.place):
                # This frame is damaged, so that its decoder may have read beyond the letter with
                # which the next frame begins. Reading therefore begins again after the letter of
                # this frame.
                stream.place, order.is_valid = begin, False
                self.left_out += is_main
            elif not is_main:
                others |= zip((field.name for field in self.fields[kind]), values, strict=True)
                if kind != self.kind.SLOW:
                    self.context.add_frame(self.frame(kind, values))
            elif not order.store_frame_if_in_order(
                values[:2], kind == self.kind.INTRA, self._expected_iteration_of_next_frame()
            ):
                self.left_out += 1
            else:
                self.context.last_iter = values[0]
                self.context.add_frame(self.frame(kind, values))
                fields = dict(zip(self.main, values, strict=True)) | {"time": order.time}
                yield -1 if kind == self.kind.INTRA else order.groups, others | fields

    def _expected_iteration_of_next_frame(self) -> int:
        """Return the iteration of the flight controller's loop at which the next frame must have
        been written, if no frame is missing.

        A frame is one record of the log. The header says after how many iterations a frame is
        written.
        """
        return self.context.last_iter + 1 + self.context.count_skipped_frames()

    def _is_frame_or_end_at(self, index: int) -> bool:
        """Return whether the byte `index` of the data is where one of three things begins: a frame;
        a P frame whose first byte (its letter P) is damaged; or the end of the data.

        If none of them begins there, the frame before this byte is probably damaged, and has too
        few bytes or too many. Erased memory counts as the end of the data.
        """
        if index == len(self.data) or self.data[index] in self.kinds:
            return True
        if _ERASED.match(self.data, index):
            return True
        stream = _Bytes(self.data, index + 1)
        try:
            self._decode_frame(stream, self.kind.INTER)
        except IndexError:
            return False
        return stream.place == len(self.data) or self.data[stream.place] in self.kinds

    def _decode_frame(self, stream: _Bytes, frame_type: Any) -> tuple[Any, ...]:
        """Return the numbers of one frame (a record of the log), decoded from the bytes that begin
        at the present place of `stream`.

        `frame_type` is the type of the frame, such as INTRA for an I frame, which holds whole
        values.
        """
        context, fields, values = self.context, self.fields[frame_type], ()
        context.frame_type, context.field_index = frame_type, 0
        while context.field_index < len(fields):
            context.current_frame = values
            raw = fields[context.field_index].decoderfun(stream, context)
            for one in raw if isinstance(raw, tuple) else (raw,):
                values += (fields[context.field_index].predictorfun(one, context),)
                context.field_index += 1
        return values

    def _read_event_kind_and_integers(self, stream: _Bytes) -> tuple[int, list[int]]:
        """Read one event from the `stream`, and return its kind and the integers that it holds.

        An event is a record of the log without readings, such as the end of a pause of the logging.
        For an event of an unknown kind the kind is -1, and no integers are read.
        """
        event = next(stream)
        if event == _LOG_END:
            is_last = self.data.startswith(_END_MARK, stream.place)
            return (_LOG_END if is_last else -1), []
        if event == _ADJUSTMENT:
            if next(stream) > 127:
                stream.place += 4
                return event, []
            return event, [_read_variable_length_integer(stream)]
        if event not in _EVENT_NUMBERS:
            return -1, []
        return event, [_read_variable_length_integer(stream) for _ in range(_EVENT_NUMBERS[event])]


class _Order:
    """Check the order of the frames of a Blackbox log by their iterations and times.

    An I frame holds whole values; a P frame holds differences from the frames before it. A group is
    an I frame and the P frames after it, up to the next I frame.

    **Fields**, among others:

    - `groups`: the number of groups so far.
    - `incomplete`: the numbers of the groups from which frames are missing.
    - `time`: the time of the last frame, µs; it goes on where the 32-bit counter of the log starts
      again from zero.
    - `is_valid`: whether no frame since the last I frame was damaged or missing.
    """

    def __init__(self):
        self.is_valid, self.is_resumed = False, False
        self.last: Sequence[int] = ()
        self.last_key: Sequence[int] = ()
        self.time, self.key_time = 0, 0
        self.groups, self.incomplete = 0, list[int]()

    def resume_after_pause(self, iteration_and_time: Sequence[int]) -> None:
        """Set the iteration and the time of the last frame to those of the event that ends a pause
        of the logging: the next frame is compared with this event, not with the last frame before
        the pause.
        """
        self.last = self.last_key = tuple(iteration_and_time)
        self.is_resumed = True

    def store_frame_if_in_order(
        self, iteration_and_time: Sequence[int], is_i_frame: bool, expected_iteration: int
    ) -> bool:
        """Return whether a frame can be used, and if so, store it as the last frame. An I frame can
        be used if it follows the last I frame closely, or is the first one; a P frame, if it
        follows the last frame closely and no frame since the last I frame was left out.

        - `iteration_and_time`: the iteration of the flight controller's loop at which the frame was
          written, and the time, µs.
        - `is_i_frame`: whether it is an I frame, which holds whole values; a P frame holds
          differences.
        - `expected_iteration`: the iteration that the frame has if no frame is missing.
        """
        values = iteration_and_time
        if is_i_frame:
            is_unbroken = self.is_valid and not self.is_resumed
            if is_unbroken and self._are_frames_missing_before(values, expected_iteration):
                self.incomplete.append(self.groups)
            self.is_valid = not self.last_key or _closely_follows_frame(self.last_key, values)
        else:
            self.is_valid = self.is_valid and _closely_follows_frame(self.last, values)
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

    def _are_frames_missing_before(self, i_frame: Sequence[int], expected_iteration: int) -> bool:
        """Return whether frames (records of the log) are missing before an I frame, which is a
        frame that holds whole values and not differences.

        The first number of a frame counts the iterations of the flight controller's loop. If it
        jumps by more than `_ITERATION_JUMP`, the logging was paused, and no frames are missing.

        - `i_frame`: the iteration of the I frame, and its time, µs.
        - `expected_iteration`: the iteration that the I frame has if no frame is missing.
        """
        is_earlier = (i_frame[1] - self.last[1]) % _WRAP >= _WRAP // 2
        return is_earlier or 0 < (i_frame[0] - expected_iteration) % _WRAP < _ITERATION_JUMP

    def groups_with_missing_frames(self) -> list[int]:
        """Return the numbers of the groups from which frames are missing.

        A group is an I frame and the P frames after it. The result is empty if frames seem to be
        missing from half of all groups or more: the interval between frames that the header states
        is then not the interval in the log.
        """
        return self.incomplete if 2 * len(self.incomplete) < self.groups else []


def _read_variable_length_integer(stream: _Bytes) -> int:
    """Return the integer of variable length that begins at the present place of `stream`.

    Each byte holds seven bits of the integer, the lowest bits first; the eighth bit is set if more
    bytes follow. An integer of more than five bytes is damaged, and the result is zero.
    """
    number, shift = 0, 0
    while shift < 35:
        byte = next(stream)
        number |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return number
    return 0


def _closely_follows_frame(last_frame: Sequence[int], frame: Sequence[int]) -> bool:
    """Return whether a frame follows the last frame closely: its iteration and its time are not
    before those of the last frame, and not further after them than the flight controllers' own
    decoder of such logs allows.

    Both arguments hold an iteration of the flight controller's loop, and a time, µs.
    """
    iteration, time = ((new - old) % _WRAP for old, new in zip(last_frame, frame, strict=True))
    return iteration < _ITERATION_JUMP and time < _TIME_JUMP


def _factors_to_deg_per_s_and_g(
    path: Path, headers: Mapping[str, Any], columns: Sequence[str]
) -> dict[str, float]:
    """Return the factor of each of the `columns`, which converts the integers of the log at `path`:
    rates to deg/s, accelerations to g, and commands to their usual unit.

    It warns of a scale that is missing in the `headers`, and of a header that may change a unit in
    a way that is not known.
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
