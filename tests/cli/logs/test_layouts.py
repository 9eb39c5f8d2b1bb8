"""The columns that logs are known to have."""

import numpy as np
import pytest

from rigidjax.cli.logs.layouts import USUAL, imu_columns
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
