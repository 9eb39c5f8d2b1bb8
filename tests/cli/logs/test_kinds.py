"""Kinds of logs, each as its user has it and gives it: read right, or refused in one sentence."""

import json
import struct
import warnings
import zipfile

import h5py
import numpy as np
import pytest
import scipy.io

from rigidjax.cli import command, reading
from rigidjax.cli.logs.errors import LogError
from rigidjax.identify import Gyro, read_table

T = np.round(0.03 * np.arange(60), 9)
W = np.round(np.stack([1.5 + np.cos(4 * T), np.sin(3 * T) - 2, 0.7 + T], 1), 6)
A = 9.8 * W[:, ::-1]
DEG, MS, N = np.degrees(W), (1000 * T).round().astype(int), np.arange(60)
NS = 1_700_000_000_000_000_000 + 1_000_000 * MS


def rows(*columns, sep=","):
    cells = [[repr(x) for x in np.asarray(column).tolist()] for column in columns]
    return "".join(sep.join(row) + "\n" for row in zip(*cells, strict=True))


def commas(text):
    return text.replace(".", ",")


def stamped(stamp, text):
    lines = zip(T, text.splitlines(), strict=True)
    return "".join(stamp.format(second=t) + line + "\n" for t, line in lines)


def between(text, every, line):
    lines = text.splitlines()
    return "".join(f"{one}\n" + (line if i % every == 3 else "") for i, one in enumerate(lines))


PLAIN, SERIAL = rows(T, *W.T), rows(MS, *DEG.T)
PAIRS = "".join(
    f"{m} ms:{m} gx:{x:.6f} gy:{y:.6f} gz:{z:.6f}\n" for m, (x, y, z) in zip(MS, DEG, strict=True)
)
VICON = "Objects\n33.3333333333\n,,Global Angle Disc:Disc,,,,,\nFrame,Sub Frame,RX,RY,RZ,TX,TY,TZ\n"
XSENS = "// Start Time: Unknown\n// Update Rate: 33.3333333333Hz\n// Firmware: 4.6\n"
GCSV = "GYROFLOW IMU LOG\nversion,1.3\nid,a\norientation,xyz\ntscale,0.001\ngscale,0.01\n"

# The file, the options, and what is read otherwise than by these.
TEXTS = {
    "phyphox": ('"Time (s)","Gyroscope x (rad/s)","Gyroscope y (rad/s)","Gyroscope z (rad/s)"\n' + PLAIN, ""),
    "semicolons and decimal commas": ("Zeit [s];Gyro X [°/s];Gyro Y [°/s];Gyro Z [°/s]\n" + commas(rows(T, *DEG.T, sep=";")), ""),
    "the unit of time within a name": ("GYROSCOPE X (rad/s);GYROSCOPE Y (rad/s);GYROSCOPE Z (rad/s);Time since start in ms\n" + rows(*W.T, MS, sep=";"), ""),
    "z before x, two times": ("time,seconds_elapsed,gyro_z,gyro_y,gyro_x\n" + rows(NS, T, *W.T[::-1]), "--unit rad/s"),
    "blanks": ("t wx  wy wz\n" + rows(T, *W.T, sep="  "), ""),
    "a header after a percent sign": ("% by hand, 2024\n% t wx wy wz\n" + rows(T, *W.T, sep=" "), ""),
    "comments with slashes": ("// by hand\n// 2024\nt,wx,wy,wz\n" + PLAIN, ""),
    "an index without a name": (",t,wx,wy,wz\n" + rows(N, T, *W.T), ""),
    "units in the second line": ("Time,Gyro X,Gyro Y,Gyro Z\n[ms],[deg/s],[deg/s],[deg/s]\n" + SERIAL, ""),
    "milli-degrees": ("t,gx [mdps],gy [mdps],gz [mdps]\n" + rows(T, *(1000 * DEG).T), ""),
    "groups above the names": ("t,gyro,gyro,gyro,acc,acc,acc\n,x,y,z,x,y,z\n" + rows(T, *W.T, *A.T), "--unit rad/s"),
    "boot lines": ("rst:0x1 (POWERON_RESET),boot:0x13\nload:0x3fff0018,len:4\nMPU6050 found\nmillis,gx,gy,gz\n" + SERIAL, "--unit deg/s"),
    "messages between the lines": ("millis,gx,gy,gz\n" + between(SERIAL, 20, "card is slow\n"), "--unit deg/s"),
    "the header again": ("t,wx,wy,wz\n" + between(PLAIN, 40, "t,wx,wy,wz\n"), ""),
    "a line that is cut": ("millis,gx,gy,gz\n" + SERIAL + "1800,1.2", "--unit deg/s"),
    "a number that is cut": ("millis,gx,gy,gz\n" + SERIAL + "1800,1.2,3.1,4.e", "--unit deg/s"),
    "zeros at the end": ("millis,gx,gy,gz\n" + SERIAL + 99 * "\0", "--unit deg/s"),
    "no header, places": (rows(MS, *A.T, *DEG.T), "--columns 1 5 6 7 --time-unit ms --unit deg/s"),
    "no header, names": (SERIAL, "--columns millis gx gy gz --unit deg/s"),
    "no times": ("gx,gy,gz\n" + rows(*W.T), "--rate 33.3333333333 --unit rad/s"),
    "a rate above the names": ("# sampling rate: 33.3333333333 Hz\ngx,gy,gz\n" + rows(*W.T), "--unit rad/s"),
    "pairs": (PAIRS.replace(" ms:", " t:"), "--time-unit ms --unit deg/s"),
    "pairs after a message, with blanks": ("ready\n" + PAIRS.replace(":", " = "), "--time ms --unit deg/s"),
    "stamps of a terminal": ("10:00:00.000 -> gx,gy,gz\n" + stamped("10:00:{second:06.3f} -> ", rows(*DEG.T)), "--unit deg/s"),
    "dates": ("when,wx,wy,wz\n" + stamped("2024-05-01 10:00:{second:06.3f},", rows(*W.T)), "--time when"),
    "times of day": ("date,time,wx,wy,wz\n" + stamped("2024-05-01,10:00:{second:06.3f},", rows(*W.T)), "--time time"),
    "milliseconds since 1970": ("timestamp,gx,gy,gz\n" + rows(NS // 1_000_000, *W.T), "--unit rad/s"),
    "a clock of 32 bits": ("micros,gx,gy,gz\n" + rows((1000 * MS + 2**32 - 700_000) % 2**32, *W.T), "--unit rad/s"),
    "a clock of 16 bits": ("millis,gx,gy,gz\n" + rows((MS + 65_000) % 2**16, *W.T), "--unit rad/s"),
    "Xsens": (XSENS + "PacketCounter\tSampleTimeFine\tAcc_X\tAcc_Y\tAcc_Z\tGyr_X\tGyr_Y\tGyr_Z\n" + rows((N + 65_510) % 2**16, 300 * N, *A.T, *W.T, sep="\t"), "--unit rad/s"),
    "Gyroflow": (GCSV + "t,gx,gy,gz\n" + rows(MS, *(100 * W).T), ""),
    "OpenSim": ("imu\nnRows=60\nnColumns=4\nendheader\ntime\tgyro_x\tgyro_y\tgyro_z\n" + rows(T, *W.T, sep="\t"), "--unit rad/s"),
    "rostopic": ("%time,field.header.seq,field.angular_velocity.x,field.angular_velocity.y,field.angular_velocity.z\n" + rows(NS, N, *W.T), "--unit rad/s"),
    "blackbox_decode": ("loopIteration, time (us), axisP[0], gyroADC[0], gyroADC[1], gyroADC[2]\n" + rows(N, 1000 * MS, N, *DEG.T, sep=", "), "--unit deg/s"),
    "an export of Blackbox": ('"Product","Blackbox"\n"loopIteration","time","gyroADC[0]","gyroADC[1]","gyroADC[2]"\n' + rows(N, 1000 * MS, *DEG.T), ""),
    "ulog2csv": ("timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],gyro_integral_dt\n" + rows(1000 * MS + 5, *W.T, N), ""),
    "records of JSON": (json.dumps([dict(t=t, gyro=dict(zip("xyz", w, strict=True))) for t, w in zip(T.tolist(), W.tolist(), strict=True)]), "--unit rad/s"),
    "lists of JSON": (json.dumps(dict(t=T.tolist(), gyro=W.tolist())), "--unit rad/s"),
    "lines of JSON": ("".join(json.dumps(dict(sensor="Gyroscope", time=t, **dict(zip("xyz", map(str, w), strict=True)))) + "\n" for t, w in zip(T.tolist(), W.tolist(), strict=True)), "--unit rad/s"),
}  # fmt: skip


def read(path, options):
    """The recording of a log by the command's options, or its one sentence."""
    parsed = command._parser().parse_args(["identify", str(path), *options.split()])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return reading.read_logs(parsed)[1][0]


def check(path, options=""):
    recording = read(path, options)
    np.testing.assert_allclose(recording.t - recording.t[0], T, rtol=0, atol=1e-6)
    assert isinstance(recording.sensors[0], Gyro)
    np.testing.assert_allclose(recording.readings[0].values, W, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", TEXTS)
def test_kinds_of_text(kind, tmp_path):
    text, options = TEXTS[kind]
    (tmp_path / "log.txt").write_text(text, encoding="utf-8")
    check(tmp_path / "log.txt", options)


REFUSED = {
    "no header": (SERIAL, "", "no header, but 4 columns of numbers; name them by their places"),
    "no header, too few names": (rows(MS, *A.T, *DEG.T), "--columns t gx gy gz", "no header, but 7 columns"),
    "no times": ("gx,gy,gz\n" + rows(*W.T), "", "name it with --time, or give .* --rate 100"),
    "several lines a reading": ("".join(f"Acceleration X: {x}, Y: {y}, Z: {z}\nRotation X: {z}, Y: {y}, Z: {x}\n" for x, y, z in W), "", "print one line for each reading"),
    "another kind of date": ("time,wx,wy,wz\n" + stamped("05/01/2024 10:00:{second:06.3f},", rows(*W.T)), "", "a date. wanted 2024-05-01T"),
    "a second table": ("t,wx,wy,wz\n" + PLAIN + "\nMarkers\nFrame,X,Y,Z\n" + PLAIN, "", "another table begins"),
    "no gyro": ("t,qw,qx,qy,qz\n" + rows(T, *W.T, T), "", "name yours with --columns or --sensor"),
    "infinity": ("t,wx,wy,wz\n" + PLAIN + "9,inf,1,1\n" + "9.1,1,1,1\n", "", "inf is not a finite number"),
    "one name twice": ("t,wx,wx,wz\n" + PLAIN, "", "wanted one column 'wx', got 2; rename all but one"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_kinds_of_text_that_are_refused(kind, tmp_path):
    text, options, words = REFUSED[kind]
    (tmp_path / "log.txt").write_text(text)
    with pytest.raises(LogError, match=words):
        read(tmp_path / "log.txt", options)


@pytest.mark.parametrize(
    ("first", "words"),
    [
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(900), "save it as CSV"),
        (b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n", "-v7"),
        (b"\x02\x50" + bytes(510), "C3D"), (b"\0\0\0\x18ftypmp42", "a video"),
        (b"<!DOCTYPE html>", "CSV"), (b"7z\xbc\xaf\x27\x1c", "unpack it first"), (b"TDSm", "TDMS"),
        (b"\x80\x04\x95", "numpy.savez"), (b"CDF\x01", "nccopy"), (bytes(2000), "export it as CSV"),
        (b"\x00\x06\x17\x5d\xa0\x12\x34\x56\xfd\x09", "mavlogdump"), (b"PK\x03\x04" + bytes(90), "CSV"),
        (b"SQLite format 3\0" + bytes(90), "CSV"),
    ],
)  # fmt: skip
def test_files_that_are_no_tables_name_the_way_on(first, words, tmp_path):
    (tmp_path / "log.dat").write_bytes(first)
    with pytest.raises(LogError, match=words):
        read(tmp_path / "log.dat", "")


def test_words_for_gaps(tmp_path):
    for word in ("nan", "NaN", "N/A", "null", "None", ""):
        (tmp_path / "log.csv").write_text(f"t,wx\n0,1\n1,{word}\n2,3\n")
        np.testing.assert_array_equal(
            read_table(tmp_path / "log.csv", ["wx"])["wx"], [1, np.nan, 3]
        )


def test_motion_capture(tmp_path):
    """Names that several bodies have, numbers among the names, a rate in place of times."""
    path = tmp_path / "take.csv"
    groups = "," + "".join(f",{kind}" for kind in 4 * ["Rotation"] + 3 * ["Position"])
    head = "Format Version,1.23,Capture Frame Rate,40.0\n\n,Name" + 7 * ",Disc" + "\n,ID" + 7 * ",1"
    path.write_text(
        f"{head}\n{groups}\nFrame,Time (Seconds),X,Y,Z,W,X,Y,Z\n" + rows(N, T, *W.T, T, *A.T)
    )
    found = read_table(path, ["Time (Seconds)", "W", "X", "Y", "Z"])
    np.testing.assert_array_equal(np.stack(list(found.values()), 1), np.column_stack([T, T, W]))
    np.testing.assert_array_equal(read_table(path, ["Position.Y"])["Position.Y"], A[:, 1])
    with pytest.raises(LogError, match=r"name one: Rotation.X, Position.X"):
        read_table(path, ["X"])
    path.write_text(VICON + ",,rad,rad,rad,mm,mm,mm\n" + rows(N, 0 * N, *(0.1 * W).T, *A.T))
    turning = read(path, "--sensor euler-XYZ=RX,RY,RZ")
    np.testing.assert_allclose(turning.t, T, atol=1e-9)


def zipped(path, **files):
    with zipfile.ZipFile(path, "w") as file:
        for name, text in files.items():
            file.writestr(f"run/{name}.csv", text)
        file.writestr("__MACOSX/run/._Gyroscope.csv", "\0")


def test_archives_of_phones(tmp_path):
    head, path = "time,seconds_elapsed,z,y,x\n", tmp_path / "run.zip"
    gyro, other = head + rows(NS, T, *W.T[::-1]), head + rows(NS, T, *A.T)
    zipped(
        path,
        Accelerometer=other,
        GyroscopeUncalibrated=other,
        Gyroscope=gyro,
        Metadata="a,b\n1,2\n",
    )
    check(path)
    np.testing.assert_array_equal(read_table(path, ["Accelerometer.y"])["Accelerometer.y"], A[:, 1])
    with pytest.raises(LogError, match=r"wanted one column 'x', got 3; name one: Accelerometer.x"):
        read_table(path, ["x"])
    zipped(path, Accelerometer=other)
    with pytest.raises(LogError, match="no column 'wx'"):
        read(path, "")
    (tmp_path / "Gyroscope.csv").write_text(gyro)
    check(tmp_path / "Gyroscope.csv")
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("flight.bbl", "H Product:")
    with pytest.raises(LogError, match=r"no text is in it, but flight.bbl; unpack it first"):
        read(path, "")


TABLE = np.array([(t, *w) for t, w in zip(T, W, strict=True)], [(n, float) for n in ("t", "wx", "wy", "wz")])  # fmt: skip
ARRAYS = {
    "npz.npz": lambda path: np.savez(path, t=T, gyro=W.T, note=np.array({"a": 1}, object)),
    "table.npy": lambda path: np.save(path, TABLE),
    "v7.mat": lambda path: scipy.io.savemat(path, {"imu": {"t": T, "gyro": W, "acc": A}, "note": np.array([1, "a", [1, 2]], object)}),
    "v4.mat": lambda path: scipy.io.savemat(path, {"t": T, "wx": W[:, 0], "wy": W[:, 1], "wz": W[:, 2]}, format="4"),
}  # fmt: skip


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays(name, tmp_path):
    ARRAYS[name](tmp_path / name)
    check(tmp_path / name, "--unit rad/s")


def test_arrays_beside_an_object_of_matlab(tmp_path):
    """A timetable: its element names a class and holds a matrix of references."""

    def element(kind, data):
        return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)

    path = tmp_path / "log.mat"
    scipy.io.savemat(path, {"x": np.arange(6, dtype=np.uint32)[:, None]})
    parts = element(6, struct.pack("<II", 17, 0))
    parts += element(1, b"tt") + element(1, b"MCOS") + element(1, b"timetable")
    made = element(14, parts + path.read_bytes()[128:])
    scipy.io.savemat(path, {"t": T, "gyro": W})
    head, arrays = path.read_bytes()[:128], path.read_bytes()[128:]
    path.write_bytes(head + made + arrays)
    check(path, "--unit rad/s")
    path.write_bytes(head + made)
    with pytest.raises(LogError, match="save arrays, not objects"):
        read(path, "")


def test_hdf5_and_matlabs_new_format(tmp_path):
    path = tmp_path / "log.mat"
    for size in (0, 512):
        with h5py.File(path, "w", userblock_size=size) as file:
            file["imu/t"], file["imu/gyro"], file["film"] = T[None], W.T, np.zeros((3, 4, 5))
            file["#refs#/a"] = T
        if size == 0:
            check(path, "--unit rad/s")
    path.write_bytes(b"MATLAB 7.3 MAT-file" + path.read_bytes()[19:])
    check(path, "--unit rad/s")
    np.save(tmp_path / "a.npy", np.column_stack([T, W]))
    check(tmp_path / "a.npy", "--columns [0] [1] [2] [3]")


def test_a_sheet(tmp_path):
    """The least file that Excel opens."""
    names = "".join(f'<c t="inlineStr"><is><t>{n}</t></is></c>' for n in ("t", "wx", "wy", "wz"))
    cells = [
        "".join(f"<c><v>{x!r}</v></c>" for x in row) for row in np.column_stack([T, W]).tolist()
    ]
    data = "".join(f"<row>{row}</row>" for row in [names, *cells])
    head, kind = '<?xml version="1.0"?>', "http://schemas.openxmlformats.org/"
    main, office = (
        f'xmlns="{kind}spreadsheetml/2006/main"',
        f"{kind}officeDocument/2006/relationships",
    )
    links = f'{head}<Relationships xmlns="{kind}package/2006/relationships"><Relationship Id="r1" '
    with zipfile.ZipFile(tmp_path / "log.xlsx", "w") as file:
        file.writestr(
            "[Content_Types].xml", f'{head}<Types xmlns="{kind}package/2006/content-types"/>'
        )
        file.writestr(
            "_rels/.rels",
            f'{links}Type="{office}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        )
        file.writestr(
            "xl/_rels/workbook.xml.rels",
            f'{links}Type="{office}/worksheet" Target="worksheets/sheet1.xml"/></Relationships>',
        )
        file.writestr(
            "xl/workbook.xml",
            f'{head}<workbook {main} xmlns:r="{office}"><sheets><sheet name="Run" sheetId="1" r:id="r1"/></sheets></workbook>',
        )
        file.writestr(
            "xl/worksheets/sheet1.xml",
            f"{head}<worksheet {main}><sheetData>{data}</sheetData></worksheet>",
        )
    check(tmp_path / "log.xlsx")


def test_parquet(tmp_path):
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    when = NS.astype("datetime64[ns]")
    imu = [dict(zip(("gyro_x", "gyro_y", "gyro_z"), w, strict=True)) for w in W.tolist()]
    for columns in ({"time": when, "imu": imu}, {"t": T, "gyro": W.tolist()}):
        parquet.write_table(arrow.table(columns), tmp_path / "log.parquet")
        check(tmp_path / "log.parquet", "--unit rad/s")


def test_ardupilot(tmp_path):
    """Two sensors whose messages alternate: the first is read."""

    def described(number, size, name, form, columns):
        text = struct.pack("<BB4s16s64s", number, size, name, form, columns)
        return b"\xa3\x95\x80" + text

    data = described(128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    data += described(130, 24, b"IMU", b"QBfff", b"TimeUS,I,GyrX,GyrY,GyrZ")
    data += described(131, 44, b"FMTU", b"QBNN", b"TimeUS,FmtType,UnitIds,MultIds")
    data += b"\xa3\x95\x83" + struct.pack("<QB16s16s", 1, 130, b"s#EEE", b"F-000")
    for m, w in zip(MS.tolist(), W, strict=True):
        for place in (0, 1):
            data += b"\xa3\x95\x82" + struct.pack("<QBfff", 1000 * m + 70, place, *(w + place))
    (tmp_path / "log.bin").write_bytes(data)
    check(tmp_path / "log.bin")
    found = read_table(tmp_path / "log.bin", ["IMU#1.GyrX"])
    np.testing.assert_allclose(found["IMU#1.GyrX"], W[:, 0] + 1, rtol=1e-6)
    text = "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n"
    text += "FMT, 130, 23, IMU, Qfff, TimeUS,GyrX,GyrY,GyrZ\nPARM, 1, A, 1.0\n"
    lines = rows(1000 * MS, *W.T, sep=", ").splitlines()
    (tmp_path / "log.log").write_text(text + "".join(f"IMU, {line}\n" for line in lines))
    check(tmp_path / "log.log")


@pytest.mark.parametrize("version", [1, 2])
def test_bags_of_ros(version, tmp_path):
    from rosbags.rosbag1 import Writer as OldWriter
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    imu, header, vector, turn, time = (
        store.types[name]
        for name in (
            "sensor_msgs/msg/Imu", "std_msgs/msg/Header", "geometry_msgs/msg/Vector3",
            "geometry_msgs/msg/Quaternion", "builtin_interfaces/msg/Time",
        )
    )  # fmt: skip
    path = tmp_path / "run.bag" if version == 1 else tmp_path / "run"
    more = {"seq": 0} if version == 1 else {}
    packed = store.serialize_ros1 if version == 1 else store.serialize_cdr
    with OldWriter(path) if version == 1 else Writer(path, version=8) as writer:
        topic = writer.add_connection("/imu", imu.__msgtype__, typestore=store)
        for now, w in zip(NS.tolist(), W, strict=True):
            stamp = header(stamp=time(now // 10**9, now % 10**9), frame_id="b", **more)
            nine, zero = np.zeros(9), vector(0.0, 0.0, 0.0)
            message = imu(
                stamp, turn(0.0, 0.0, 0.0, 1.0), nine, vector(*w.tolist()), nine, zero, nine
            )
            writer.write(topic, now + 5_000, packed(message, imu.__msgtype__))
    check(path)
    if version == 2:
        check(next(path.glob("*.db3")))
