"""Blackbox logs: scales and units, frames that stand on no I frame, several flights."""

import logging
import struct
import sys
import warnings

import numpy as np
import pytest

from rigidjax.cli.command import main
from rigidjax.cli.logs.errors import LogError, LogWarning
from rigidjax.cli.logs.layouts import imu_columns
from rigidjax.cli.logs.table import open_log
from rigidjax.identify import read_table


def unsigned(value):
    out = bytearray()
    while value >= 128:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


FIELDS = "gyroADC[0],gyroADC[1],gyroADC[2],accSmooth[0]"
SCALES = ("gyro_scale:0x3f800000", "acc_1G:2048")


def blackbox_log(rows, *lines, fields=FIELDS, end=True):
    """A log as the format's own description says: all fields in full, variable bytes."""
    count = fields.count(",") + 1
    header = [
        "Product:Blackbox flight data recorder by Nicholas Sherlock",
        "Data version:2",
        "I interval:1",
        "P interval:1/1",
        f"Field I name:loopIteration,time,{fields}",
        "Field I signed:0,0" + ",1" * count,
        "Field I predictor:0,0" + ",0" * count,
        "Field I encoding:1,1" + ",0" * count,
        "Field P predictor:0,0" + ",0" * count,
        "Field P encoding:1,1" + ",0" * count,
        "Firmware type:Cleanflight",
        *(lines or SCALES),
    ]
    frames = b""
    for index, (time, *values) in enumerate(rows):
        zigzag = [2 * v if v >= 0 else -2 * v - 1 for v in values]
        frames += b"I" + b"".join(map(unsigned, (index, time, *zigzag)))
    mark = b"E\xffEnd of log\x00" if end else b""
    return "".join(f"H {line}\n" for line in header).encode() + frames + mark


# What a log of the right frames has to say.
logging.getLogger("orangebox").setLevel(logging.ERROR)
ROWS = [(1000 * i, 100 - i, -7 * i, 3000, 2048) for i in range(50)]


@pytest.mark.parametrize("end", [True, False])
def test_blackbox_rates_come_in_degrees_a_second(tmp_path, end):
    path = tmp_path / "FLIGHT.BBL"
    path.write_bytes(blackbox_log(ROWS, end=end))
    layout = imu_columns(path)
    assert (layout.unit, layout.time_unit) == ("deg/s", "us")
    table = read_table(path, [*layout.columns, "accSmooth[0]"])
    # Without its last mark the last frame of a log cannot be told from half a frame.
    wanted = np.array(ROWS if end else ROWS[: table["time"].size])
    assert len(wanted) >= len(ROWS) - 1
    np.testing.assert_array_equal(np.stack([table[n] for n in layout.columns], 1), wanted[:, :4])
    np.testing.assert_array_equal(table["accSmooth[0]"], 1.0)


def test_the_scale_in_the_header_counts(tmp_path):
    path = tmp_path / "flight.bfl"
    bits = struct.unpack("I", struct.pack("f", 0.0609756))[0]
    for name in ("gyro_scale", "gyro.scale"):
        path.write_bytes(blackbox_log(ROWS, f"{name}:0x{bits:08x}"))
        np.testing.assert_allclose(read_table(path, ["gyroADC[2]"])["gyroADC[2]"], 182.9268, 1e-6)


def test_a_scale_to_radians_a_microsecond(tmp_path):
    """As Baseflight writes it, whatever the firmware says that it is."""
    path = tmp_path / "flight.bfl"
    (bits,) = struct.unpack("I", struct.pack("f", np.radians(1 / 16.4) * 1e-6))
    path.write_bytes(blackbox_log(ROWS, f"gyro_scale:0x{bits:08x}"))
    np.testing.assert_allclose(read_table(path, ["gyroADC[2]"])["gyroADC[2]"], 182.9268, 1e-6)


def test_of_a_high_resolution_rates_and_commands_are_ten_times_finer(tmp_path):
    path = tmp_path / "flight.bbl"
    scale = {"gyroADC[1]": 0.1, "gyroUnfilt[0]": 0.1, "rcCommand[3]": 0.1, "setpoint[2]": 0.1,
             "setpoint[3]": 1.0, "accSmooth[2]": 1 / 512, "motor[0]": 1.0}  # fmt: skip
    rows = [(1000 * i, *(i * k for k in range(3, 10))) for i in range(40)]
    lines = ("gyro_scale:0x3f800000", "acc_1G:512", "blackbox_high_resolution:1", "vbat_scale:110")
    path.write_bytes(blackbox_log(rows, *lines, fields=",".join(scale)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        table = read_table(path, list(scale))
    for k, (name, factor) in enumerate(scale.items(), 3):
        np.testing.assert_allclose(table[name], factor * k * np.arange(40), 1e-12, err_msg=name)
        assert open_log(path).units.get(name) == {"g": "deg/s", "a": "g"}.get(name[0])


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["acc_1G:2048"], r"no scale of the fields gyroADC\[0\], gyroADC\[1\]; they are read as logged"),
        ([*SCALES, "gyro_resolution:3"], "change a unit in a way that is not known: gyro_resolution:3"),
        ([*SCALES, "blackbox_high_resolution:2"], "is not known: blackbox_high_resolution:2"),
    ],
)  # fmt: skip
def test_a_scale_that_is_not_known_is_said(lines, words, tmp_path):
    path = tmp_path / "flight.bbl"
    path.write_bytes(blackbox_log(ROWS, *lines))
    with pytest.warns(LogWarning, match=words):
        read_table(path, ["gyroADC[0]", "gyroADC[1]"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_table(path, ["time"])["time"].size == len(ROWS)


@pytest.mark.parametrize("many", [90, 145, 400])
def test_frames_may_be_longer_than_256_bytes(many, tmp_path):
    path = tmp_path / "flight.bbl"
    rows = [(900 * i, 3 * i, *(70_000 + k for k in range(many))) for i in range(30)]
    fields = "gyroADC[0]," + ",".join(f"debug[{k}]" for k in range(many))
    path.write_bytes(blackbox_log(rows, *SCALES, fields=fields))
    table = read_table(path, ["time", "gyroADC[0]", f"debug[{many - 1}]"])
    wanted = np.array(rows)[:, [0, 1, -1]]
    np.testing.assert_array_equal(np.stack(list(table.values()), 1), wanted)


@pytest.mark.parametrize("content", [b"", b"t,wx\n1,2\n", blackbox_log(ROWS)[:200]])
def test_what_is_no_blackbox_log_gets_one_line(tmp_path, capsys, content):
    path = tmp_path / "flight.bbl"
    path.write_bytes(content)
    assert main(["identify", str(path)]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"error: {path}: ") and err.count("\n") == 1


def test_a_field_that_is_not_there_is_named(tmp_path):
    path = tmp_path / "flight.bbl"
    path.write_bytes(blackbox_log(ROWS))
    with pytest.raises(
        LogError, match=r"no column 'motor.0.'; the columns are loopIteration, time"
    ):
        read_table(path, ["motor[0]"])


def test_without_the_parser_the_extra_is_named(tmp_path, monkeypatch):
    path = tmp_path / "flight.bbl"
    path.write_bytes(blackbox_log(ROWS))
    monkeypatch.setitem(sys.modules, "orangebox.reader", None)
    with pytest.raises(LogError, match=r"pip install '.\[blackbox\]'"):
        read_table(path, ["time"])


INTERVAL, STEP = 6, 500
END = b"E\xffEnd of log\x00"


def signed(value):
    return unsigned(2 * value if value >= 0 else -2 * value - 1)


def value_of(n):
    """The readings of frame n."""
    return [7 * n * n % 501 - 250, 31 * n % 97, -n, 2048 + n % 5]


def time_of(n):
    return 40_000_000 + STEP * n + 3 * (n % 4)


def frames(first, last, start=0, iteration=0):
    """Frames `first` … `last` - 1 of a log with an I frame at each multiple of `INTERVAL`.

    The differences of P frames are those of the previous frame, or of both before (time).
    """
    out = []
    for n in range(first, last):
        time = start + time_of(n)
        if n % INTERVAL == 0:
            numbers = unsigned((iteration + n) % 2**32) + unsigned(time % 2**32)
            out.append(b"I" + numbers + b"".join(map(signed, value_of(n))))
        else:
            before = time_of(n - 1)
            earlier = before if n % INTERVAL == 1 else time_of(n - 2)
            steps = [new - old for new, old in zip(value_of(n), value_of(n - 1), strict=True)]
            moved = signed(time_of(n) - 2 * before + earlier)
            out.append(b"P" + moved + b"".join(map(signed, steps)))
    return out


HEADER = "".join(f"H {line}\n" for line in [
    "Product:Blackbox flight data recorder by Nicholas Sherlock", "Data version:2",
    f"I interval:{INTERVAL}", "P interval:1/1",
    "Field I name:loopIteration,time,gyroADC[0],gyroADC[1],gyroADC[2],accSmooth[0]",
    "Field I signed:0,0,1,1,1,1", "Field I predictor:0,0,0,0,0,0", "Field I encoding:1,1,0,0,0,0",
    "Field P predictor:6,2,1,1,1,1", "Field P encoding:9,0,0,0,0,0",
    "Field S name:flightModeFlags,stateFlags", "Field S signed:0,0", "Field S predictor:0,0",
    "Field S encoding:1,1",
    "Firmware type:Cleanflight", "gyro_scale:0x3f800000", "acc_1G:2048",
]).encode()  # fmt: skip
COLUMNS = ["loopIteration", "time", "gyroADC[0]", "gyroADC[1]", "gyroADC[2]"]


def content(numbers):
    return np.array([[n, time_of(n), *value_of(n)[:3]] for n in numbers], float)


def read(tmp_path, data, **how):
    path = tmp_path / "flight.bbl"
    path.write_bytes(data)
    return np.stack(list(read_table(path, COLUMNS, **how).values()), axis=1)


def test_differences_are_summed(tmp_path):
    data = HEADER + b"".join(frames(0, 50)) + END
    np.testing.assert_array_equal(read(tmp_path, data), content(range(50)))


@pytest.mark.parametrize("first", [1, 2, 5, 11])
def test_nothing_before_the_first_i_frame(first, tmp_path):
    begin = -(-first // INTERVAL) * INTERVAL
    words = rf"flight.bbl: {begin - first} of {50 - first} frames are left out: they depend on an"
    with pytest.warns(LogWarning, match=words):
        table = read(tmp_path, HEADER + b"".join(frames(first, 50)) + END)
    np.testing.assert_array_equal(table, content(range(begin, 50)))


@pytest.mark.parametrize("hurt", [7, 11, 20, 31])
def test_nothing_from_a_frame_without_its_letter_to_the_next_i_frame(hurt, tmp_path):
    parts = frames(0, 50)
    parts[hurt] = b"\0" + parts[hurt][1:]
    with pytest.warns(LogWarning, match="of 50 frames are left out"):
        table = read(tmp_path, HEADER + b"".join(parts) + END)
    again = (hurt // INTERVAL + 1) * INTERVAL
    np.testing.assert_array_equal(table, content([*range(hurt), *range(again, 50)]))


@pytest.mark.parametrize("hurt", [7, 11, 31, 40])
@pytest.mark.parametrize("lost", [slice(1, 2), slice(-1, None)])
def test_a_frame_of_too_few_bytes_is_not_handed_on(hurt, lost, tmp_path):
    """It takes the letter of the next frame for one of its numbers."""
    # The iteration of an I frame has two bytes from 128 on.
    parts = frames(240, 290)
    numbers = bytearray(parts[hurt])
    del numbers[lost]
    parts[hurt] = bytes(numbers)
    with pytest.warns(LogWarning, match="frames are left out"):
        table = read(tmp_path, HEADER + b"".join(parts) + END)
    again = (hurt // INTERVAL + 1) * INTERVAL
    numbers = [*range(240, 240 + hurt), *range(240 + again, 290)]
    np.testing.assert_array_equal(table, content(numbers))


@pytest.mark.parametrize("lost", [[20], [20, 21], [19, 20, 21, 22]])
def test_whole_frames_that_are_missing_are_seen_at_the_next_i_frame(lost, tmp_path):
    """The differences after them are added to the wrong frame: which, nobody knows."""
    data = b"".join(frame for n, frame in enumerate(frames(0, 50)) if n not in lost)
    with pytest.warns(LogWarning, match=f"{5 - len(lost)} of {50 - len(lost)} frames are left"):
        table = read(tmp_path, HEADER + data + END)
    np.testing.assert_array_equal(table, content([*range(19), *range(24, 50)]))


def test_an_interval_that_the_header_does_not_have_leaves_nothing_out(tmp_path):
    data = HEADER.replace(b"P interval:1/1", b"P interval:1/2") + b"".join(frames(0, 50)) + END
    np.testing.assert_array_equal(read(tmp_path, data)[:, 2:], content(range(50))[:, 2:])


def test_a_wrong_time_stays_in_its_group(tmp_path):
    """One that goes on, but by too much: the differences of the I frames say so."""
    parts = frames(0, 50)
    parts[20] = b"P" + signed(5_000_000) + parts[20][2:]
    with pytest.warns(LogWarning, match="5 of 50 frames are left out"):
        table = read(tmp_path, HEADER + b"".join(parts) + END)
    np.testing.assert_array_equal(table, content([*range(19), *range(24, 50)]))


def test_a_frame_that_does_not_go_on_in_time_is_hurt(tmp_path):
    parts = frames(0, 50)
    parts[20] = b"P" + signed(20_000_000) + parts[20][2:]
    with pytest.warns(LogWarning, match="4 of 50 frames are left out"):
        table = read(tmp_path, HEADER + b"".join(parts) + END)
    np.testing.assert_array_equal(table, content([*range(20), *range(24, 50)]))


@pytest.mark.parametrize("cut", range(1, 9))
def test_a_log_that_ends_within_a_frame_keeps_the_whole_ones(cut, tmp_path):
    """Cut by an I frame, whose bytes are counted."""
    parts = frames(0, 49)
    assert len(parts[-1]) > 8
    with pytest.warns(LogWarning, match="1 of 49 frames are left out"):
        table = read(tmp_path, HEADER + b"".join(parts)[:-cut])
    np.testing.assert_array_equal(table, content(range(48)))


def test_erased_memory_behind_the_last_frame_is_no_fault(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        table = read(tmp_path, HEADER + b"".join(frames(0, 20)) + 300 * b"\xff")
    np.testing.assert_array_equal(table, content(range(20)))


def test_events_and_slow_frames_do_not_break_the_order(tmp_path):
    parts = frames(0, 40)
    parts[3] += b"S" + unsigned(9) + unsigned(1)
    parts[8] += b"E\0" + unsigned(123_456)
    parts[9] += b"E\x1e" + unsigned(3) + unsigned(300)
    parts[15] += b"E\x0d\x05" + signed(-300)
    parts[16] += b"E\x0d\x85" + struct.pack("<f", 1.5)
    parts[20] += b"S" + unsigned(300) + unsigned(2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        table = read(tmp_path, HEADER + b"".join(parts) + END)
    np.testing.assert_array_equal(table, content(range(40)))
    flags = read_table(tmp_path / "flight.bbl", ["flightModeFlags"])["flightModeFlags"]
    np.testing.assert_array_equal(flags, 4 * [np.nan] + 17 * [9.0] + 19 * [300.0])


def test_a_pause_that_is_announced_loses_nothing(tmp_path):
    """By the event of resumed logging: 90 s later, 180 000 iterations on."""
    later, skipped = 90_000_000, 180_000
    resume = b"E\x0e" + unsigned(skipped + 12) + unsigned(later + time_of(12))
    data = b"".join(frames(0, 12)) + resume + b"".join(frames(12, 30, later, skipped))
    table = read(tmp_path, HEADER + data + END)
    wanted = content(range(30))
    wanted[12:, :2] += [skipped, later]
    np.testing.assert_array_equal(table, wanted)


def test_a_pause_that_is_not_announced_costs_one_group(tmp_path):
    later = 90_000_000
    data = b"".join(frames(0, 12)) + b"".join(frames(12, 30, later))
    with pytest.warns(LogWarning, match="6 of 30 frames are left out"):
        table = read(tmp_path, HEADER + data + END)
    wanted = content([*range(12), *range(18, 30)])
    wanted[12:, 1] += later
    np.testing.assert_array_equal(table, wanted)


def test_the_clock_goes_on_after_32_bits(tmp_path):
    """71.6 minutes in µs; differences go over the end, the next I frame begins at zero."""
    begin = 2**32 - time_of(9)
    table = read(tmp_path, HEADER + b"".join(frames(0, 30, begin)) + END)
    wanted = content(range(30))
    wanted[:, 1] += begin
    np.testing.assert_array_equal(table, wanted)


def two_flights():
    return HEADER + b"".join(frames(0, 24)) + END + HEADER + b"".join(frames(12, 48)) + END


def test_of_several_flights_one_is_chosen(tmp_path, capsys):
    np.testing.assert_array_equal(read(tmp_path, two_flights(), flight=1), content(range(24)))
    np.testing.assert_array_equal(read(tmp_path, two_flights(), flight=2), content(range(12, 48)))
    words = r"flight.bbl: 2 flights are in this log, of .* kB; choose one: --flight 1 to 2"
    with pytest.raises(LogError, match=words):
        read(tmp_path, two_flights())
    assert main(["identify", str(tmp_path / "flight.bbl")]) == 2
    assert "choose one: --flight 1 to 2 (flight= in Python)\n" in capsys.readouterr().err
    for flight in (0, 3, -1):
        with pytest.raises(LogError, match=f"wanted a flight from 1 to 2, got {flight}"):
            read(tmp_path, two_flights(), flight=flight)


def test_of_flights_of_a_header_only_those_with_frames_are_named(tmp_path):
    """As a flash memory keeps them that was armed and disarmed, or whose header was cut."""
    whole, cut = HEADER + b"".join(frames(0, 24)) + END, HEADER[:200]
    data = HEADER + whole + cut + HEADER + END + two_flights() + HEADER + 90 * b"\xff"
    words = (
        r"3 flights are in this log, of .* kB \(4 more have a header only\); .* --flight 2, 5, 6 "
    )
    with pytest.raises(LogError, match=words):
        read(tmp_path, data)
    for flight in (1, 3, 4, 7):
        words = f"flight {flight} has a header only; flights with frames: 2, 5, 6$"
        with pytest.raises(LogError, match=words):
            read(tmp_path, data, flight=flight)
    np.testing.assert_array_equal(read(tmp_path, data, flight=6), content(range(12, 48)))
    np.testing.assert_array_equal(read(tmp_path, cut + whole + HEADER), content(range(24)))
    with pytest.raises(LogError, match=r"flight.bbl: no frames in this log; is it whole"):
        read(tmp_path, HEADER + cut)


def test_only_blackbox_has_flights(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,wx\n0,1\n")
    with pytest.raises(LogError, match="flight 1: only a Blackbox log"):
        read_table(path, ["t"], flight=1)


def test_fields_have_their_units(tmp_path):
    path = tmp_path / "flight.bbl"
    units = {"time": "us", "gyroADC[1]": "deg/s", "accSmooth[2]": "g", "motor[0]": None}
    path.write_bytes(blackbox_log(ROWS, *SCALES, fields=",".join(list(units)[1:])))
    assert open_log(path).units == {name: unit for name, unit in units.items() if unit}
