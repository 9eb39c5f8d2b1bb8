"""`look LOG` and `identify LOG --throws`, as a newcomer meets them."""

import functools
import zipfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import throw_logs

import rigidjax as rj
from rigidjax.cli.command import main


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@functools.cache
def thrown():
    return throw_logs.make(5, 3, 200.0)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(name, header, *columns):
    rows = np.column_stack(columns)
    Path(name).write_text("\n".join([header, *(",".join(map(repr, row)) for row in rows.tolist())]))


def phases(out):
    """Kind, start and end of each phase of the table."""
    rows = [line.split() for line in out.splitlines() if line[:1] == " " and " to, s" not in line]
    return [(row[2], float(row[0]), float(row[1])) for row in rows]


def free(rows):
    return [row[1:] for row in rows if row[0] == "free"]


def test_a_log_in_other_units_has_the_same_phases(folder, capsys):
    log = thrown()
    write("log.csv", "t,wx,wy,wz,ax,ay,az", log.t, log.rates, log.forces)
    assert main(["look", "log.csv", "--figure", "picture"]) == 0
    out = capsys.readouterr().out
    usual = phases(out)
    np.testing.assert_allclose(free(usual), log.free, atol=0.02)
    assert "specific force ax, ay, az in m/s2" in out and "identify log.csv --throws" in out
    assert out.endswith("figure: picture.png\n") and Path("picture.png").stat().st_size > 20_000
    header = "Time (ms),Gyro x (deg/s),Gyro y (deg/s),Gyro z (deg/s),Acc x,Acc y,Acc z"
    write("app.csv", header, 1e3 * log.t, np.degrees(log.rates), log.forces / 9.80665)
    assert main(["look", "app.csv"]) == 0
    out = capsys.readouterr().out
    assert phases(out) == usual and "Acc x, Acc y, Acc z in g" in out
    # A window, and a sensor by its columns.
    words = [
        "--sensor",
        "gyro=wx,wy,wz",
        "--sensor",
        "accelerometer=ax,ay,az",
        "--window",
        "5",
        "9",
    ]
    assert main(["look", "log.csv", *words]) == 0
    np.testing.assert_allclose(free(phases(capsys.readouterr().out)), log.free[1:2], atol=0.02)


def test_the_tables_of_a_phones_app_have_times_of_their_own(folder, capsys):
    log = thrown()
    names = ",".join(f"{axis} ({{0}})" for axis in "XYZ")

    def looked():
        with zipfile.ZipFile("app.zip", "w") as packed:
            for name in ("Gyroscope.csv", "Accelerometer.csv"):
                packed.write(name)
        assert main(["look", "app.zip"]) == 0
        return capsys.readouterr().out

    write("Gyroscope.csv", "Time (s)," + names.format("rad/s"), log.t[40:], log.rates[40:])
    # The other sensor reads every second time, begins earlier and ends later.
    other = log.t[::2] + 0.001, log.forces[::2]
    write("Accelerometer.csv", "Time (s)," + names.format("m/s^2"), *other)
    out = looked()
    assert "specific force Accelerometer.X (m/s^2)" in out and "by the gyro alone" not in out
    np.testing.assert_allclose(free(phases(out)), log.free - log.t[40], atol=0.02)
    write("Accelerometer.csv", "count," + names.format("m/s^2"), *other)
    out = looked()
    assert "are not read beside the rates" in out and "was it in the air?" in out


def test_what_is_no_specific_force_is_said_and_not_used(folder, capsys):
    log = thrown()
    write("log.csv", "t,wx,wy,wz,ax,ay,az", log.t, log.rates, 0.02 * log.forces)
    assert main(["look", "log.csv"]) == 0
    out = capsys.readouterr().out
    assert "at rest the accelerometer reads 0.19" in out and "by the gyro alone" in out
    assert 1 <= len(free(phases(out))) <= 3 and "was it in the air?" in out
    assert main(["look", "log.csv", "--strict"]) == 2
    assert main(["look", "log.csv", "--sensor", "gyro=wx,wy,wz", "--sensor",
                 "accelerometer=ax,ay,az"]) == 2  # fmt: skip
    assert "at rest the accelerometer reads" in capsys.readouterr().err


def test_the_free_flights_are_the_recordings_of_one_fit(folder, capsys, monkeypatch):
    log, asked = thrown(), []

    def stop(model, **_):
        asked.append(model)
        raise ValueError("enough")

    monkeypatch.setattr(rj.identify, "fit", stop)
    write("log.csv", "t,wx,wy,wz,ax,ay,az,m", log.t, log.rates, log.forces, 0 * log.t + 3)
    assert main(["identify", "log.csv", "--throws", "--motors", "m"]) == 2
    (model,) = asked
    assert model.count == len(log.free) == 3
    for one, (start, end) in zip(model.recordings, log.free, strict=True):
        assert [type(sensor).__name__ for sensor in one.sensors] == ["Gyro"]
        assert start - 0.005 < one.t[0] < start + 0.02 and end - 0.02 < one.t[-1] < end + 0.005
    out = capsys.readouterr().out
    assert out.count("free flight") == 3 and "the bias of the gyro is its rate at rest" in out
    bias = np.asarray(model.recordings[0].sensors[0].bias)
    still = (log.t[:, None] > log.rest[:, 0] + 0.05) & (log.t[:, None] < log.rest[:, 1] - 0.05)
    np.testing.assert_allclose(bias, log.rates[still.any(axis=1)].mean(axis=0), atol=1e-3)
    # Cut to a tenth of a second, the first flight says nothing of the body.
    window = ["--window", str(log.free[0, 0] + 0.01), str(log.free[0, 0] + 0.13)]
    assert main(["identify", "log.csv", "--throws", *window]) == 2
    out = capsys.readouterr()
    assert "is left out; it says nothing: it turns by" in out.out
    assert "no free flight from which a body can be fitted" in out.err and len(asked) == 1


def test_mistakes_are_answered(folder, capsys):
    write("log.csv", "t,wx,wy,wz", np.arange(50) / 50, np.ones((50, 3)))
    for words in (["look"], ["look", "log.csv", "other.csv", "--figure", "f.png"],
                  ["look", "log.csv", "--throws"]):  # fmt: skip
        with pytest.raises(SystemExit):
            main(words)
    assert "give log FILES" in capsys.readouterr().err
    assert main(["look", "none.csv"]) == 2 and main(["look", "log.csv", "--motors", "m"]) == 2
    err = capsys.readouterr().err
    assert "no such file" in err and "no column 'm'" in err
