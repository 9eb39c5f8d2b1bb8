"""Binary logs of flight controllers and robots: files made here, as their formats say."""

import json
import struct
import sys
import zlib

import numpy as np
import pytest
from mcap.writer import Writer
from mcap_ros2.writer import Writer as RosWriter

import rigidjax as rj
from rigidjax.cli import spec
from rigidjax.cli.command import main
from rigidjax.cli.logs.errors import LogError
from rigidjax.cli.logs.layouts import USUAL, imu_columns
from rigidjax.identify import read_table

T = np.arange(40) * 0.01
BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)
RATES = np.asarray(rj.simulate(BODY, rj.Spin([3.0, 9.0, -2.0]), T).ys.omega)
IMU = """std_msgs/Header header
geometry_msgs/Vector3 angular_velocity
===
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
===
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
===
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def ulog(path):
    """Header, flags, one format, one topic logged twice (PX4's description of ULog)."""

    def message(kind, body):
        return struct.pack("<HB", len(body), ord(kind)) + body

    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message("B", bytes(40))
    out += message("F", b"sensor_combined:uint64_t timestamp;float[3] gyro_rad;")
    for index in (0, 1):
        out += message("A", struct.pack("<BH", index, index) + b"sensor_combined")
    for t, w in zip(T, RATES, strict=True):
        for index in (0, 1):
            row = struct.pack("<HQ3f", index, round(1e6 * (t + 5)), *(w * (1 + index)))
            out += message("D", row)
    path.write_bytes(out)


def of_json(path):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Imu", "jsonschema", b"{}")
        channel = writer.register_channel("/imu", "json", schema)
        for t, w in zip(T, RATES, strict=True):
            content = {
                "angular_velocity": dict(zip("xyz", w.tolist(), strict=True)),
                "raw": w.tolist(),
            }
            now = 1_700_000_000_000_000_000 + round(1e9 * t)
            writer.add_message(channel, now, json.dumps(content).encode(), now)
        writer.finish()


def of_ros(path):
    with path.open("wb") as file:
        writer = RosWriter(file)
        schema = writer.register_msgdef("sensor_msgs/msg/Imu", IMU)
        for t, w in zip(T, RATES, strict=True):
            stamp = {"sec": 1_700_000_000, "nanosec": round(1e9 * t)}
            content = {
                "header": {"stamp": stamp, "frame_id": "body"},
                "angular_velocity": dict(zip("xyz", w.tolist(), strict=True)),
            }
            # Logged 3 ms late, the first one 1 ms.
            late = 1_700_000_000_000_000_000 + round(1e9 * t) + (3_000_000 if t else 1_000_000)
            writer.write_message("/imu", schema, content, late)
        writer.finish()


def crazyflie(path, version=2):
    out = struct.pack("<BHH", 0xBC, version, 2)
    out += struct.pack("<H", 7) + b"fixedFrequency\0" + struct.pack("<H", 4)
    out += b"gyro.x(f)\0gyro.y(f)\0gyro.z(f)\0motor.m1(H)\0"
    out += struct.pack("<H", 9) + b"other\0" + struct.pack("<H", 1) + b"pm.vbat(f)\0"
    for index, (t, w) in enumerate(zip(T, np.degrees(RATES), strict=True)):
        now = (
            struct.pack("<I", round(1e3 * t)) if version == 1 else struct.pack("<Q", round(1e6 * t))
        )
        out += struct.pack("<H", 7) + now + struct.pack("<3fH", *w, index)
        if index % 10 == 0:
            out += struct.pack("<H", 9) + now + struct.pack("<f", 3.7)
    path.write_bytes(out + struct.pack("<I", zlib.crc32(out)))


def crazyflie_of_old(path):
    crazyflie(path, 1)


# The name of the file, what writes it, and how exact its numbers are.
FILES = {
    "px4": ("log.ulg", ulog, 1e-6),
    "json": ("log.mcap", of_json, 1e-12),
    "ros": ("log.mcap", of_ros, 1e-12),
    "crazyflie": ("log07", crazyflie, 1e-6),
    "old crazyflie": ("log07.usd", crazyflie_of_old, 1e-6),
}


@pytest.mark.parametrize("kind", FILES)
def test_time_and_rates_are_found_in_si(tmp_path, kind):
    name, write, exact = FILES[kind]
    write(tmp_path / name)
    layout = imu_columns(tmp_path / name)
    rates = spec.parse_channel(f"gyro={','.join(layout.columns[1:])}:{layout.unit}")
    record = spec.read_log(
        tmp_path / name, [rates], time=layout.columns[0], time_unit=layout.time_unit
    )
    np.testing.assert_allclose(record.t - record.t[0], T, rtol=0, atol=1e-6)
    np.testing.assert_allclose(record.readings[0].values, RATES, rtol=exact)


def test_other_columns_and_a_second_instance(tmp_path):
    ulog(tmp_path / "a.ulg")
    found = read_table(tmp_path / "a.ulg", ["sensor_combined#1.gyro_rad[2]"])
    np.testing.assert_allclose(found["sensor_combined#1.gyro_rad[2]"], 2 * RATES[:, 2], rtol=1e-6)
    of_json(tmp_path / "a.mcap")
    np.testing.assert_array_equal(
        read_table(tmp_path / "a.mcap", ["/imu.raw[1]"])["/imu.raw[1]"], RATES[:, 1]
    )
    of_ros(tmp_path / "a.mcap")
    both = read_table(tmp_path / "a.mcap", ["/imu.log_time", "/imu.stamp"])
    np.testing.assert_allclose(both["/imu.log_time"] - both["/imu.stamp"], 0.003 + 0 * T + (T == 0) * -0.002, atol=1e-9)  # fmt: skip
    crazyflie(tmp_path / "log")
    found = read_table(tmp_path / "log", ["timestamp", "motor.m1"])
    assert found["motor.m1"].tolist() == list(range(40))
    found = read_table(tmp_path / "log", ["timestamp", "pm.vbat"])
    np.testing.assert_allclose(found["timestamp"], 1e6 * T[::10])


@pytest.mark.parametrize("kind", FILES)
def test_a_name_that_is_not_there_or_a_cut_file_is_one_line(tmp_path, capsys, kind):
    name, write, _ = FILES[kind]
    path = tmp_path / name
    write(path)
    with pytest.raises(LogError, match=r"no column 'other'; the columns are .*(gyro|angular)"):
        read_table(path, ["other"])
    path.write_bytes(path.read_bytes()[:9])
    assert main(["identify", str(path)]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"error: {path}: ") and err.count("\n") == 1


def test_a_text_file_without_ending_is_text(tmp_path):
    (tmp_path / "log").write_text("t,wx,wy,wz\n0,1,2,3\n")
    assert imu_columns(tmp_path / "log").columns == USUAL.columns
    assert read_table(tmp_path / "log", ["wy"])["wy"].tolist() == [2.0]


@pytest.mark.parametrize(("ending", "library"), [("ulg", "pyulog"), ("mcap", "mcap_ros2.decoder")])
def test_without_the_library_the_extra_is_named(tmp_path, monkeypatch, ending, library):
    path = tmp_path / f"log.{ending}"
    (ulog if ending == "ulg" else of_json)(path)
    monkeypatch.setitem(sys.modules, library, None)
    extra = "ulog" if ending == "ulg" else "mcap"
    with pytest.raises(LogError, match=rf"pip install '.\[{extra}\]'"):
        read_table(path, ["x"])
