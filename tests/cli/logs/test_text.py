"""What a user reads when a log is wrong: one line with file, line and column, exit code 2."""

import codecs
import gzip
import re
import subprocess
import sys

import numpy as np
import pytest
from scipy.io import savemat

import rigidjax as rj
from rigidjax.cli.command import main
from rigidjax.cli.logs.errors import LogError
from rigidjax.cli.logs.layouts import imu_columns
from rigidjax.identify import read_table

GOOD = "t,wx,wy,wz\n" + "\n".join(
    f"{0.1 * k:.1f},{np.cos(k):.6f},{np.sin(k):.6f},1.0" for k in range(12)
)


def _swap(line, text):
    lines = GOOD.splitlines()
    lines[line - 1] = text
    return "\n".join(lines)


WRONG = {
    "no column": (GOOD.replace("wy", "gyro_y"), "no column 'wy'; the columns are t, wx, gyro_y, wz"),
    "text": (_swap(5, "0.3,1,fast,1"), "line 5: column 'wy': 'fast' is not a number"),
    "short line": (_swap(6, "0.4,1"), "line 6: column 'wy': the line ends before it"),
    "no times": (re.sub(r"\n\d\.\d", "\n", GOOD), "column 't': the times of 12 of 12 rows are repeated, backward or missing (row 1 is the first)"),
    "two clocks": (GOOD + GOOD.removeprefix("t,wx,wy,wz"), "column 't': the clock was set back at row 13, from 1.1 to 0 s; make two logs of it"),
    "a time that stands": (re.sub(r"\n\d\.\d", "\n0.3", GOOD), "column 't': the times of 11 of 12 rows are repeated, backward or missing (row 2 is the first)"),
    "rates of zero": ("t,wx,wy,wz\n" + "\n".join(f"{k},0,0.0,-0" for k in range(9)), "the rates (wx, wy, wz) are all zero"),
    "no rates": ("t,wx,wy,wz\n" + "\n".join(f"{k},1,,1" for k in range(9)), "no row has a rate in each of the columns wx, wy, wz"),
    "a comment, no column": ("# by hand\n" + GOOD.replace("wy", "gyro"), "no column 'wy'; the columns are t, wx, gyro, wz"),
    "a cell below comments": ("# by hand\n\n# twice\n" + _swap(5, "0.3,1,fast,1"), "line 8: column 'wy': 'fast' is not a number"),
    "a cell below a header that is a comment": ("# by hand\n# " + _swap(5, "0.3,1,fast,1"), "line 6: column 'wy': 'fast' is not a number"),
    "comments alone": ("# t,wx,wy,wz\n# t,wx,wy,wz\n", "wanted at least 4 samples, got 0"),
    "escapes": (GOOD.replace("wy", "\x1b[31mwy\x9b\u202e"), r"no column 'wy'; the columns are t, wx, \x1b[31mwy\x9b\u202e, wz"),
    "empty": ("", "line 1: wanted a header"),
    "a thousand": (_swap(4, "0.2,1_000,1,1"), "line 4: column 'wx': '1_000' is not a number"),
    "digits of another alphabet": (_swap(4, "0.2,١,1,1"), "line 4: column 'wx': '١' is not a number"),
    "time without end": (_swap(4, "-inf,1,1,1"), "line 4: column 't': -inf is not a finite number"),
    "surplus cell": (_swap(5, "0.3,1,1,1,7"), "line 5: 5 cells, but the header names 4 columns"),
    "a decimal comma": (_swap(4, '0.2,"1,5",1,1'), "line 4: column 'wx': '1,5' is not a number; a decimal comma?"),
    "a wanted name twice": (GOOD.replace("wy,wz", "wy,wz,wx", 1), "wanted one column 'wx', got 2"),
    "a quote without end": (_swap(5, '0.3,"1,1,1' + 200_000 * "1"), "cannot be read as text (Error: field larger than field limit"),
    "zero bytes": (GOOD.replace("wy", "w\0y"), "line 1: holds zero bytes, so that it is no text"),
    "zeros alone": (200_000 * "\0", "line 1: holds zero bytes, so that it is no text"),
    "a zero byte below": (_swap(5, "0.3,1,1\0,1"), r"line 5: column 'wy': '1\x00' is not a number"),
    "too short": ("t,wx,wy,wz\n0,1,1,1\n1,1,1,1\n", "wanted at least 4 samples, got 2"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_bad_log_gets_one_clear_line(case, tmp_path, capsys):
    text, words = WRONG[case]
    path = tmp_path / "log.csv"
    path.write_text(text)
    assert main(["identify", str(path)]) == 2
    out = capsys.readouterr()
    assert out.out == ""
    assert out.err.startswith(f"error: {path}: {words}"), out.err
    assert out.err.count("\n") == 1


@pytest.mark.parametrize("text", [150_000 * "w", 900 * "w,"])
def test_of_long_names_and_many_a_part_is_shown(text, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(text + "\n1\n")
    with pytest.raises(LogError, match="no column 't'; the columns are w") as raised:
        read_table(path, ["t"])
    assert len(str(raised.value)) < 400 + len(str(path))
    path.write_text("t\n" + 100_000 * "w")
    with pytest.raises(LogError, match=r"line 2: column 't': 'ww.*' is not a number") as raised:
        read_table(path, ["t"])
    assert len(str(raised.value)) < 400 + len(str(path))


@pytest.mark.parametrize("line", ["0,0\n", "\n", "#\n", "\0"])
def test_a_packed_file_of_equal_lines_is_refused_at_once(line, tmp_path):
    path = tmp_path / "log.csv.gz"
    with gzip.open(path, "wt") as file:
        file.write("t,wx\n" + line * (12_000_000 // len(line)))
    with pytest.raises(LogError, match="unpacks to more than 100 times its size"):
        read_table(path, ["t", "wx"])


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_commas_semicolons_and_tabs(separator, tmp_path):
    """Also a quoted cell, a cell of text in a column that is not wanted, and a last separator."""
    path = tmp_path / "log.txt"
    rows = [
        ["t", "note", "wx", "wy", "wz"],
        ["0", '"a"', "1", "", "3"],
        ["1", "b", " 4", "5", "6", ""],
    ]
    path.write_text("\r\n".join(separator.join(row) for row in rows))
    table = rj.identify.read_table(path, ["t", "wx", "wy", "wz"])
    np.testing.assert_array_equal(table["t"], [0.0, 1.0])
    np.testing.assert_array_equal(table["wy"], [np.nan, 5.0])
    np.testing.assert_array_equal(table["wx"] + table["wz"], [4.0, 10.0])


@pytest.mark.parametrize("comments", ["", "# by hand\n", "# 17.5\n\n# t,x\n#\n"])
@pytest.mark.parametrize("mark", ["", "# ", "#"])
@pytest.mark.parametrize("separator", [",", "\t"])
def test_comments_above_the_header_and_the_header_of_savetxt(comments, mark, separator, tmp_path):
    path, values = tmp_path / "log.csv", np.arange(20.0).reshape(5, 4)
    header = separator.join(("t", "wx", "wy", "wz"))
    np.savetxt(path, values, delimiter=separator, header=header, comments=mark)
    path.write_text("\ufeff" + comments + path.read_text())
    table = rj.identify.read_table(path, ["wz", "t", "wy"])
    for place, name in ((0, "t"), (2, "wy"), (3, "wz")):
        np.testing.assert_array_equal(table[name], values[:, place])


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("encoding", "mark"),
    [
        ("utf-8", b""), ("utf-8", codecs.BOM_UTF8), ("utf-16-le", codecs.BOM_UTF16_LE),
        ("utf-16-be", codecs.BOM_UTF16_BE), ("utf-16-le", b""), ("utf-16-be", b""), ("cp1252", b""),
    ],
)  # fmt: skip
def test_texts_of_other_systems_packed_or_not(encoding, mark, packed, tmp_path):
    text = "t;Drehrate (°/s)\r\n" + "".join(f"{0.5 * k};{k * k}\r\n" for k in range(2000))
    path = tmp_path / ("log.csv.gz" if packed else "log.csv")
    data = mark + text.encode(encoding)
    path.write_bytes(gzip.compress(data) if packed else data)
    table = rj.identify.read_table(path, ["t", "Drehrate (°/s)"])
    np.testing.assert_array_equal(table["t"], 0.5 * np.arange(2000))
    np.testing.assert_array_equal(table["Drehrate (°/s)"], np.arange(2000.0) ** 2)


def test_a_damaged_packed_file_gets_one_line(tmp_path):
    whole = gzip.compress((GOOD + "\n" + 900 * "9,1,1,1\n").encode())
    for data in (b"", whole[:40], whole[:-12] + bytes(12)):
        (tmp_path / "log.csv.gz").write_bytes(data)
        with pytest.raises(
            LogError, match=r"log.csv.gz: (cannot be read as text|line 1: wanted a)"
        ):
            rj.identify.read_table(tmp_path / "log.csv.gz", ["t", "wx"])
    np.savez(tmp_path / "log.npz", t=np.arange(9.0))
    packed = gzip.compress((tmp_path / "log.npz").read_bytes())
    (tmp_path / "log.npz.gz").write_bytes(packed)
    with pytest.raises(LogError, match="only text is read while it is packed; unpack it first"):
        rj.identify.read_table(tmp_path / "log.npz.gz", ["t", "wx"])


@pytest.mark.parametrize("separator", [";", "\t"])
@pytest.mark.parametrize("style", ["%.9E", "%.6f", "%.2f"])
def test_decimal_commas_between_semicolons_and_tabs(separator, style, tmp_path):
    values = np.random.default_rng(3).normal(scale=700.0, size=(40, 3))
    values[4] = [0.0, -1.0, 1234.0]
    path = tmp_path / "log.csv"
    np.savetxt(
        path,
        values,
        fmt=style,
        delimiter=separator,
        header="a\tb\tc".replace("\t", separator),
        comments="",
    )
    points = rj.identify.read_table(path, ["a", "b", "c"])
    path.write_text(path.read_text().replace(".", ","))
    commas = rj.identify.read_table(path, ["a", "b", "c"])
    for name in "abc":
        np.testing.assert_array_equal(points[name], commas[name])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "a;b\n1,5;2\n1;2.5\n",
            "line 3: column 'b': '2.5' is not a number; the decimals above have",
        ),
        (
            "a;b\n1.5;2\n1;2,5\n",
            "line 3: column 'b': '2,5' is not a number; the decimals above have",
        ),
        ("a;b\n1.234,5;2\n", "line 2: column 'a': '1.234,5' is not a number"),
        ("a;b\n1,234,5;2\n", "line 1: no header, but 3 columns of numbers"),
        (
            "a\tb\n1,234\t2\n",
            "line 2: column 'a': '1,234' is not a number; does its comma mark thou",
        ),
        ('a,b\n"1,5",2\n', "line 2: column 'a': '1,5' is not a number; a decimal comma?"),
    ],
)
def test_commas_that_may_mean_two_things_are_refused(text, words, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(LogError) as caught:
        rj.identify.read_table(path, ["a", "b"])
    assert words in str(caught.value)


def test_a_thousand_between_tabs_is_a_decimal_once_another_cell_shows_it(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("a\tb\n0,5\t1,234\n")
    assert rj.identify.read_table(path, ["a", "b"])["b"].tolist() == [1.234]


@pytest.mark.parametrize("unit", ["rad/s", "deg/s", "°/s"])
@pytest.mark.parametrize("time_unit", ["s", "ms"])
def test_a_layout_has_the_units_in_its_names(unit, time_unit, tmp_path):
    path = tmp_path / "log.csv"
    names = [f"Zeit ({time_unit})", "Betrag", *(f"Gyroskop {axis} ({unit})" for axis in "zyx")]
    path.write_text(";".join(names) + "\n")
    layout = imu_columns(path)
    assert layout.columns == (names[0], names[4], names[3], names[2])
    assert layout.unit == unit.replace("°", "deg") and layout.time_unit == time_unit


def test_a_header_that_is_a_comment_is_known_as_that_of_phyphox(tmp_path):
    names = ["Time (s)", *(f"Gyroscope {axis} (rad/s)" for axis in "xyz")]
    path = tmp_path / "log.csv"
    path.write_text("# export\n# " + ",".join(names) + "\n0,,1,\n1,2,3,4\n")
    assert imu_columns(path).columns == tuple(names)
    np.testing.assert_array_equal(rj.identify.read_table(path, names[:2])[names[1]], [np.nan, 2.0])


def test_a_name_that_is_wanted_twice_is_refused(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(GOOD)
    with pytest.raises(LogError, match="wanted different names, got 'wx' twice"):
        rj.identify.read_table(path, ("t", "wx", "wy", "wx"))


KINDS = ["empty", "cut", "text", "other"]


@pytest.mark.parametrize("suffix", [".npz", ".mat"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file_gets_one_clear_line(kind, suffix, tmp_path, capsys):
    path, columns = tmp_path / f"log{suffix}", ["t", "wx", "wy", "wz"]
    arrays = {name: np.arange(500) * 0.1 for name in columns}
    if suffix == ".npz":
        np.savez_compressed(path, **arrays)
    else:
        savemat(path, arrays, do_compression=True)
    assert rj.identify.read_table(path, columns)["t"].shape == (500,)
    whole = path.read_bytes()
    if kind == "other":
        with path.open("wb") as file:
            np.save(file, np.arange(3.0))
    else:
        path.write_bytes(
            {"empty": b"", "cut": whole[: len(whole) // 2], "text": b"t,wx\n1,2\n"}[kind]
        )
    assert main(["identify", str(path)]) == 2
    out = capsys.readouterr()
    assert out.err.startswith(f"error: {path}: ")
    assert out.err.count("\n") == 1 and out.out == ""


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (np.array([0.0, 1.0, -np.inf]), "array 'wx': row 3 is infinite; NaN marks a gap"),
        (np.array([0.0, 1.0, 2.0j]), "array 'wx' does not hold real numbers"),
        (np.array(["0", "1", "2"]), "array 'wx' does not hold real numbers"),
        (np.arange(4), "arrays of different lengths"),
    ],
)
def test_arrays_that_are_no_readings(bad, words, tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, t=np.arange(3), wx=bad)
    with pytest.raises(LogError, match=words):
        rj.identify.read_table(path, ["t", "wx"])


MEMORY = """
import resource, sys
from rigidjax.identify import read_table
kilo = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
before = kilo()
table = read_table(sys.argv[1], ["t", "wx", "wy", "wz"])
print(1024 * (kilo() - before) / sum(column.nbytes for column in table.values()))
"""


@pytest.mark.slow
def test_a_large_log_takes_memory_for_its_numbers(tmp_path):
    path, rows = tmp_path / "log.csv", 40_000 * [("0.123456789,"[:11] + 3 * ",0.12345678") + "\n"]
    with path.open("w") as file:
        file.write("t,wx,wy,wz\n")
        for _ in range(25):
            file.writelines(rows)
    out = subprocess.run([sys.executable, "-c", MEMORY, str(path)], capture_output=True, text=True)
    assert float(out.stdout) < 1.5, out.stderr


@pytest.mark.slow
def test_an_empty_cell_is_a_gap_that_is_told(tmp_path, capsys):
    path = tmp_path / "log.csv"
    path.write_text(_swap(5, "0.3,1,,1"))
    main(["identify", str(path), "--starts", "1"])
    assert "12 samples over 1.1 s, 1 gap" in capsys.readouterr().out


def test_a_missing_file_or_a_folder(tmp_path, capsys):
    assert main(["identify", str(tmp_path / "none.csv")]) == 2
    assert capsys.readouterr().err == f"error: {tmp_path / 'none.csv'}: no such file\n"
    assert main(["identify", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err


def test_units_columns_blank_lines_and_byte_order_mark(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(
        "\ufeffextra,time,p,q,r\n" + "\n\n".join(f"x,{k},1,{10 * k},0" for k in range(5))
    )
    table = rj.identify.read_table(path, ("time", "p", "q", "r"))
    assert [column[3] for column in table.values()] == [3, 1, 30, 0]


def test_a_good_log_prints_ratios_with_intervals(tmp_path, capsys):
    ts = np.linspace(0.0, 8.0, 120)
    motion = rj.simulate(rj.Inertia.from_principal(1.0, 1.7, 2.2), rj.Spin([0.3, 2.0, 0.2]), ts).ys
    noisy = np.asarray(motion.omega) + 0.01 * np.random.default_rng(0).normal(size=(120, 3))
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack([ts, noisy]), delimiter=",", header="t,wx,wy,wz", comments="")
    figure = tmp_path / "fit.png"
    assert main(["identify", str(path), "--starts", "3", "--figure", str(figure)]) == 0
    out = capsys.readouterr().out
    for name, truth in (("I1/I3", 1.0 / 2.2), ("I2/I3", 1.7 / 2.2)):
        line = next(line for line in out.splitlines() if line.startswith(name))
        low, high = (float(x) for x in line.split()[2:5:2])
        assert low < truth < high
        assert high - low < 0.05
    assert "status: ok" in out
    assert "cannot show the absolute inertia" in out
    assert figure.stat().st_size > 10_000


def test_help_version_and_no_arguments(capsys):
    assert main([]) == 0
    assert "identify --demo" in capsys.readouterr().out
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"rigidjax {rj.__version__}\n"
    with pytest.raises(SystemExit) as ended:
        main(["identify"])
    assert ended.value.code == 2
    assert "either log FILES or --demo" in capsys.readouterr().err
