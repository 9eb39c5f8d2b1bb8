"""Units in the names of columns, as loggers write them."""

import warnings

import pytest

from rigidjax.cli.logs.errors import LogError, LogWarning
from rigidjax.cli.logs.units import common_unit, unit_in_name

RATES, ACCELERATIONS, TIMES = ("rad/s", "deg/s", "rpm"), ("m/s2", "g"), ("s", "ms", "us", "ns")
NAMES = {
    "Gyroscope x (deg/s)": "deg/s", "wx [rad/s]": "rad/s", "wx deg/s": "deg/s", "wx_deg/s": "deg/s",
    "Gyro X (°/s)": "deg/s", "gx(dps)": "deg/s", "p [º/sec]": "deg/s", "q (rad s^-1)": "rad/s",
    "q (rad·s⁻¹)": "rad/s", "wheel (RPM)": "rpm", "p_deg_s": "deg/s", "w_rad_s": "rad/s",
    "r (Deg/s) ": "deg/s", "wx, deg/s": "deg/s", "wx": None, "wx (body)": None, "gyro[0]": None,
    "wx_s": None, "omega": None, "wx (rad)": "rad",
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_units_of_rates(name):
    assert unit_in_name(name, RATES) == NAMES[name]


@pytest.mark.parametrize(
    ("name", "allowed", "unit"),
    [
        ("Acceleration x (m/s^2)", ACCELERATIONS, "m/s2"), ("a (m/s²)", ACCELERATIONS, "m/s2"),
        ("ax [g]", ACCELERATIONS, "g"), ("ax g", ACCELERATIONS, "g"), ("ax (G)", ACCELERATIONS, None),
        ("a (m/s/s)", ACCELERATIONS, "m/s2"), ("g", ACCELERATIONS, None), ("m s^-2", (), None),
        ("Time (s)", TIMES, "s"), ("t [ms]", TIMES, "ms"), ("timestamp_us", TIMES, "us"),
        ("time (µs)", TIMES, "us"), ("time (μs)", TIMES, "us"), ("stamp_ns", TIMES, "ns"), ("t", TIMES, None),
        ("Zeit (s)", TIMES, "s"), ("ticks", TIMES, None), ("yaw (°)", ("rad", "deg"), "deg"),
    ],
)  # fmt: skip
def test_units_of_other_columns(name, allowed, unit):
    assert unit_in_name(name, allowed) == unit


def test_the_name_decides_where_nothing_is_stated():
    names = ["x (deg/s)", "y (deg/s)", "z"]
    assert common_unit(names, None, RATES, "log") == "deg/s"
    assert common_unit(names, "deg/s", RATES, "log") == "deg/s"
    assert common_unit(["x", "y"], None, RATES, "log") == "rad/s"
    assert common_unit(["x", "y"], "rpm", RATES, "log") == "rpm"


def test_units_that_disagree_are_refused():
    with pytest.raises(
        LogError, match=r"log: column 'x \(deg/s\)' is in deg/s by its name, and rad/s"
    ):
        common_unit(["x (deg/s)"], "rad/s", RATES, "log")
    with pytest.raises(LogError, match=r"'x \(deg/s\)' is in deg/s, column 'y \(rad/s\)' in rad/s"):
        common_unit(["x (deg/s)", "y (rad/s)"], None, RATES, "log")
    with pytest.raises(LogError, match=r"'x \(m/s\^2\)' is in m/s2; wanted rad/s or deg/s or rpm"):
        common_unit(["x (m/s^2)"], None, RATES, "log")


def test_a_unit_that_is_not_known_is_told_unless_one_is_stated():
    with pytest.warns(LogWarning, match=r"'x \(LSB\)': its unit is not known; it is read in rad/s"):
        assert common_unit(["x (LSB)"], None, RATES, "log") == "rad/s"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert common_unit(["x (LSB)"], "deg/s", RATES, "log") == "deg/s"
        assert common_unit(["gyro[0]", "w (x)"], None, RATES, "log") == "rad/s"
