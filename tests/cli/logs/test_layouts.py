"""The columns that logs are known to have."""

import numpy as np
import pytest

from rigidjax.cli.logs.layouts import USUAL, accelerometer_columns, imu_columns
from rigidjax.cli.logs.log import Log
from rigidjax.identify import read_table

PHYPHOX = '"Time (s)","{0} x (rad/s)","{0} y (rad/s)","{0} z (rad/s)","{1} (rad/s)"\n'


@pytest.mark.parametrize("words", [("Gyroscope", "Absolute"), ("Gyroskop", "Absolutwert")])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_phyphox_is_known_by_its_header(tmp_path, words, separator):
    path = tmp_path / "Raw Data.csv"
    header = PHYPHOX.format(*words).replace(",", separator)
    rows = "\n".join(separator.join(map(str, row)) for row in np.arange(20.0).reshape(4, 5))
    path.write_text(header + rows)
    layout = imu_columns(path)
    assert (layout.unit, layout.time_unit) == ("rad/s", "s")
    table = read_table(path, layout.columns)
    np.testing.assert_array_equal(table[layout.columns[0]], [0, 5, 10, 15])
    np.testing.assert_array_equal(table[f"{words[0]} z (rad/s)"], [3, 8, 13, 18])


@pytest.mark.parametrize("text", ["t,wx,wy,wz\n", "a,b\n1,2\n", '"unclosed (s),x (rad/s)'])
def test_other_texts_have_the_usual_columns(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)
    assert imu_columns(path).columns == USUAL.columns


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ("t,wx,wy,wz,ax,ay,az", "ax,ay,az"),
        ("t,wx,wy,wz,alx,aly,alz", None),
        ("time,gyro.x,gyro.y,gyro.z,acc.x,acc.y,acc.z", "acc.x,acc.y,acc.z"),
        ("t,gyroADC[0],gyroADC[1],gyroADC[2],accSmooth[0],accSmooth[1],accSmooth[2]",
         "accSmooth[0],accSmooth[1],accSmooth[2]"),
        ("t,/imu.linear_acceleration.x,/imu.linear_acceleration.y,/imu.linear_acceleration.z",
         "/imu.linear_acceleration.x,/imu.linear_acceleration.y,/imu.linear_acceleration.z"),
        ("t,Linear Acceleration x (m/s^2),Linear Acceleration y (m/s^2),"
         "Linear Acceleration z (m/s^2)", None),
        ("t,userAccelerationX(G),userAccelerationY(G),userAccelerationZ(G)", None),
        ("t,Beschl x [mg],Beschl y [mg],Beschl z [mg]", "Beschl x [mg],Beschl y [mg],Beschl z [mg]"),
        ("t,accuracy x,accuracy y,accuracy z", None),
        ("t,acc_raw_x,acc_raw_y,acc_raw_z,acc_x,acc_y,acc_z", "acc_x,acc_y,acc_z"),
    ],
)  # fmt: skip
def test_the_specific_force_is_found_by_names_and_units(names, found):
    log = Log(names.split(","), dict)
    columns = accelerometer_columns(log, "log")
    assert columns == (None if found is None else tuple(found.split(",")))
