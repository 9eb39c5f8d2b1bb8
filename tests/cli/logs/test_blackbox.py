"""Logs of phyphox and of flight controllers: known columns, units, scales."""

import struct
import sys

import numpy as np
import pytest

from rigidjax.cli.command import main
from rigidjax.cli.logs.errors import LogError
from rigidjax.cli.logs.layouts import USUAL, layout_of
from rigidjax.identify import read_table

PHYPHOX = '"Time (s)","{0} x (rad/s)","{0} y (rad/s)","{0} z (rad/s)","{1} (rad/s)"\n'


@pytest.mark.parametrize("words", [("Gyroscope", "Absolute"), ("Gyroskop", "Absolutwert")])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_phyphox_is_known_by_its_header(tmp_path, words, separator):
    path = tmp_path / "Raw Data.csv"
    header = PHYPHOX.format(*words).replace(",", separator)
    rows = "\n".join(separator.join(map(str, row)) for row in np.arange(20.0).reshape(4, 5))
    path.write_text(header + rows)
    layout = layout_of(path)
    assert (layout.unit, layout.time_unit) == ("rad/s", "s")
    table = read_table(path, layout.columns)
    np.testing.assert_array_equal(table[layout.columns[0]], [0, 5, 10, 15])
    np.testing.assert_array_equal(table[f"{words[0]} z (rad/s)"], [3, 8, 13, 18])


@pytest.mark.parametrize("text", ["t,wx,wy,wz\n", "", '"unclosed (s),x (rad/s)'])
def test_other_texts_have_the_usual_columns(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)
    assert layout_of(path) == USUAL
    assert layout_of(tmp_path / "none.csv") == layout_of(tmp_path) == USUAL


def unsigned(value):
    out = bytearray()
    while value >= 128:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def blackbox_log(rows, scale="0x3f800000", end=True):
    """A log as the format's own description says: all fields in full, variable bytes."""
    header = [
        "Product:Blackbox flight data recorder by Nicholas Sherlock",
        "Data version:2",
        "I interval:1",
        "P interval:1/1",
        "Field I name:loopIteration,time,gyroADC[0],gyroADC[1],gyroADC[2],accSmooth[0]",
        "Field I signed:0,0,1,1,1,1",
        "Field I predictor:0,0,0,0,0,0",
        "Field I encoding:1,1,0,0,0,0",
        "Field P predictor:0,0,0,0,0,0",
        "Field P encoding:1,1,0,0,0,0",
        "Firmware type:Cleanflight",
        f"gyro_scale:{scale}",
        "acc_1G:2048",
    ]
    frames = b""
    for index, (time, *values) in enumerate(rows):
        zigzag = [2 * v if v >= 0 else -2 * v - 1 for v in values]
        frames += b"I" + b"".join(map(unsigned, (index, time, *zigzag)))
    mark = b"E\xffEnd of log\x00" if end else b""
    return "".join(f"H {line}\n" for line in header).encode() + frames + mark


ROWS = [(1000 * i, 100 - i, -7 * i, 3000, 2048) for i in range(50)]


@pytest.mark.parametrize("end", [True, False])
def test_blackbox_rates_come_in_degrees_a_second(tmp_path, end):
    path = tmp_path / "FLIGHT.BBL"
    path.write_bytes(blackbox_log(ROWS, end=end))
    layout = layout_of(path)
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
    path.write_bytes(blackbox_log(ROWS, f"0x{bits:08x}"))
    np.testing.assert_allclose(read_table(path, ["gyroADC[2]"])["gyroADC[2]"], 182.9268, rtol=1e-6)


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
    with pytest.raises(LogError, match=r"no array 'motor.0.'; the arrays are loopIteration, time"):
        read_table(path, ["motor[0]"])


def test_without_the_parser_the_extra_is_named(tmp_path, monkeypatch):
    path = tmp_path / "flight.bbl"
    path.write_bytes(blackbox_log(ROWS))
    monkeypatch.setitem(sys.modules, "orangebox", None)
    with pytest.raises(LogError, match=r"pip install 'rigidjax\[blackbox\]'"):
        read_table(path, ["time"])
