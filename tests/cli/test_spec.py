"""Recordings from files as loggers write them: times, windows, units."""

import re
import warnings

import numpy as np
import pytest

from rigidjax.cli import spec
from rigidjax.cli.logs.errors import LogError, LogWarning

T = np.round(0.02 * np.arange(100), 9)
RATES = np.stack([np.cos(3 * T), np.sin(2 * T), 0.5 + 0 * T], axis=1)
GYRO = [spec.parse_channel("gyro=wx,wy,wz")]


@pytest.fixture(autouse=True)
def quiet():
    """A warning that a test does not ask for is an error, whatever the settings of a run."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def written(folder, t, values=RATES, head="t,wx,wy,wz", form="%.9f", stamp="%.9f"):
    path = folder / "log.csv"
    form = [stamp] + [form] * values.shape[1]
    np.savetxt(
        path, np.column_stack([t, values]), fmt=form, delimiter=",", header=head, comments=""
    )
    return path


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_stamps_since_1970_in_any_unit_are_counted_from_the_first(unit, tmp_path):
    scale = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    path = written(tmp_path, scale * 1.75e9 + scale * T, stamp="%.6f" if unit == "s" else "%.0f")
    record = spec.read_log(path, GYRO, time_unit=unit)
    # In doubles, the seconds since 1970 have steps of 2.4e-7, nanoseconds steps of 256.
    np.testing.assert_allclose(record.t, T, rtol=0, atol=5e-7)
    part = spec.read_log(path, GYRO, time_unit=unit, window=(0.5, 1.1))
    np.testing.assert_allclose(part.t, T[25:56], rtol=0, atol=5e-7)
    np.testing.assert_array_equal(part.readings[0].values, record.readings[0].values[25:56])


@pytest.mark.parametrize(
    ("name", "unit"), [("time (ms)", "ms"), ("stamp_us", "us"), ("t [s]", "s"), ("Zeit [ns]", "ns")]
)
def test_the_name_of_the_time_column_says_its_unit(name, unit, tmp_path):
    scale = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    path = written(tmp_path, scale * T, head=f"{name},wx,wy,wz")
    np.testing.assert_allclose(spec.read_log(path, GYRO, time=name).t, T, atol=1e-12)
    other = "s" if unit != "s" else "ms"
    with pytest.raises(LogError, match=f"is in {unit} by its name, and {other} is stated"):
        spec.read_log(path, GYRO, time=name, time_unit=other)


def test_the_names_of_the_columns_say_the_units_of_sensors_and_wheels(tmp_path):
    head = "t,x (°/s),y (°/s),z (°/s),ax [g],ay [g],az [g],motor (rpm)"
    values = np.column_stack([np.degrees(RATES), RATES, 60.0 + 0 * T])
    path = written(tmp_path, T, values, head)
    channels = [
        spec.parse_channel("gyro=x (°/s),y (°/s),z (°/s)"),
        spec.parse_channel("accelerometer=ax [g],ay [g],az [g]"),
    ]
    record = spec.read_log(path, channels, wheels=[spec.parse_wheel("motor (rpm):1e-6:x")])
    np.testing.assert_allclose(record.readings[0].values, RATES, atol=1e-9)
    np.testing.assert_allclose(record.readings[1].values, 9.80665 * RATES, atol=1e-7)
    (speed,) = record.inputs.values()
    np.testing.assert_allclose(speed(0.5), 2 * np.pi, rtol=1e-12)
    for text, named in (("gyro=x (°/s),y (°/s),z (°/s):rad/s", "deg/s"),):
        with pytest.raises(LogError, match=f"is in {named} by its name, and rad/s is stated"):
            spec.read_log(path, [spec.parse_channel(text)])
    with pytest.raises(LogError, match=r"'motor .rpm.' is in rpm by its name, and rad/s is stated"):
        spec.read_log(path, channels, wheels=[spec.parse_wheel("motor (rpm):1e-6:x:rad/s")])


@pytest.mark.parametrize("bad", [{40: 38}, {40: 39, 70: 2}, {0: 99}, {99: 5}])
def test_rows_with_bad_stamps_are_left_out_with_a_line(bad, tmp_path):
    t = T.copy()
    for row, other in bad.items():
        t[row] = T[other]
    words = f"{len(bad)} of 100 rows are left out.*{', '.join(str(row + 1) for row in bad)}\\)"
    with pytest.warns(LogWarning, match=words):
        record = spec.read_log(written(tmp_path, t), GYRO)
    kept = [k for k in range(100) if k not in bad]
    # Where the first stamp is one that is left out, the times begin below it.
    np.testing.assert_allclose(record.t, T[kept] - t[0], atol=1e-12)
    np.testing.assert_allclose(record.readings[0].values, RATES[kept], atol=1e-9)


def test_bad_stamps_outside_the_window_are_no_matter_to_sensors_and_wheels(tmp_path):
    t = T.copy()
    t[[3, 80]] = T[[2, 10]]
    speeds = np.column_stack([RATES, 100.0 + 7 * T])
    path = written(tmp_path, t, speeds, "t,wx,wy,wz,s")
    record = spec.read_log(path, GYRO, window=(0.4, 1.2), wheels=[spec.parse_wheel("s:1e-6")])
    np.testing.assert_allclose(record.t, T[20:61], atol=1e-12)
    (speed,) = record.inputs.values()
    np.testing.assert_allclose(speed(1.7), 100 + 7 * 1.7, rtol=1e-6)


@pytest.mark.parametrize("begin", [0.0, 1.75e9])
def test_a_wheel_is_read_where_rows_are_left_out_or_stamps_are_rounded(begin, tmp_path):
    t = begin + T
    t[50] = t[49]
    speeds = np.column_stack([RATES, 100.0 + 7 * T])
    path = written(tmp_path, t, speeds, "t,wx,wy,wz,s", stamp="%.6f")
    with pytest.warns(LogWarning, match="1 of 100 rows are left out"):
        record = spec.read_log(path, GYRO, wheels=[spec.parse_wheel("s:1e-6")])
    (speed,) = record.inputs.values()
    times = np.array([0.3, 0.97, 1.0, 1.03, 1.9])
    np.testing.assert_allclose([speed(t) for t in times], 100 + 7 * times, rtol=1e-7)


def test_a_wheel_at_uneven_times_is_refused(tmp_path):
    speeds = np.column_stack([RATES, 100.0 + 7 * T])
    path = written(tmp_path, T + 0.004 * np.sin(9 * T), speeds, "t,wx,wy,wz,s")
    with pytest.raises(LogError, match="column 's': Series: wanted evenly spaced"):
        spec.read_log(path, GYRO, wheels=[spec.parse_wheel("s:1e-6")])


def test_a_missing_stamp_is_a_row_that_is_left_out(tmp_path):
    path = written(tmp_path, T)
    lines = path.read_text().splitlines()
    lines[8] = lines[8][lines[8].index(",") :]
    path.write_text("\n".join(lines))
    with pytest.warns(LogWarning, match=r"1 of 100 rows are left out: .*missing \(row 8\)"):
        assert spec.read_log(path, GYRO).t.size == 99


def test_times_in_another_unit_are_remarked_upon(tmp_path):
    path = written(tmp_path, 1e9 * T)
    with pytest.warns(LogWarning, match=r"step between two times is 2e\+07 s, .* is it in ns\?"):
        spec.read_log(path, GYRO)
    path = written(tmp_path, 1e3 * T, 5 * RATES)
    with pytest.warns(
        LogWarning, match=r"20 s, in which the body turns .* times; is it in ms or us\?"
    ):
        spec.read_log(path, GYRO)


@pytest.mark.parametrize("kind", ["gyro-x", "euler", "eulerZYX", "accelerometer-1", ""])
def test_a_kind_of_sensor_that_is_none_is_refused(kind):
    with pytest.raises(LogError, match="wanted gyro, accelerometer, quaternion or euler-SEQUENCE"):
        spec.parse_channel(f"{kind}=a,b,c")


@pytest.mark.parametrize(
    ("unit", "factor", "hint"),
    [("rad/s", 131 * 180 / np.pi, r", or deg/s \(--unit deg/s\)\?"), ("deg/s", 131 * 180 / np.pi, r"\?$")],
)  # fmt: skip
@pytest.mark.parametrize("time_unit", ["s", "ms"])
def test_rates_that_no_gyro_reads_are_said(unit, factor, hint, time_unit, tmp_path):
    """And nothing about the unit of the times, as one wrong row says nothing about the rates."""
    scale = 1.0 if time_unit == "s" else 1e3
    gyro = [spec.Channel("gyro", ("wx", "wy", "wz"), unit, None)]
    path = written(tmp_path, scale * T, np.round(factor * RATES))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        spec.read_log(path, gyro, time_unit=time_unit)
    words = r"log.csv: the rates \(wx, wy, wz\) reach .* rad/s, which no gyro reads: are they raw counts"
    (only,) = map(str, (w.message for w in said if issubclass(w.category, LogWarning)))
    assert re.search(words + ".*" + hint, only), only
    values = RATES.copy()
    values[3] = 9e9
    with warnings.catch_warnings():
        warnings.simplefilter("error", LogWarning)
        spec.read_log(written(tmp_path, T, values), GYRO)


@pytest.mark.parametrize("window", [None, (0.5, 1.0)])
def test_rates_that_are_all_zero_are_refused_in_words(window, tmp_path):
    values = RATES.copy()
    values[25:51] = 0.0
    if window is None:
        values[:] = 0.0
    words = r"log.csv: the rates \(wx, wy, wz\) are all zero: a body at rest shows nothing"
    with pytest.raises(LogError, match=words):
        spec.read_log(written(tmp_path, T, values), GYRO, window=window)
