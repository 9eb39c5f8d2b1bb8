"""The command line as a newcomer meets it: what is said, what is kept, and the exit code."""

import html
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.cli import command
from rigidjax.cli.command import main
from rigidjax.identify.answer.answers import Answer

GOOD = "t,wx,wy,wz\n" + "\n".join(f"{k},{np.cos(k):.6f},{np.sin(k):.6f},1.0" for k in range(12))


@pytest.fixture(scope="module")
def found():
    """A fit, to be shown: how it was found does not count here."""
    ts = jnp.linspace(0.0, 10.0, 60)
    motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), motion.ys.omega))
    return rj.identify.fit(rj.identify.Model(record, rj.identify.PrincipalRatios()), starts=1)


@pytest.fixture
def fitted(found, monkeypatch):
    asked = []
    monkeypatch.setattr(rj.identify, "fit", lambda problem, **how: asked.append(how) or found)
    return asked


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Ours, with a log in it."""
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text(GOOD)
    return tmp_path


def environment(folder):
    """A process of its own, with a cache folder of its own."""
    unwanted = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    own = {name: value for name, value in os.environ.items() if name not in unwanted}
    # matplotlib would look through all fonts again, and say so.
    own |= {"XDG_CACHE_HOME": str(folder), "MPLCONFIGDIR": mpl.get_cachedir()}
    return own | {"PYTHONPATH": str(Path(rj.__file__).parents[1])}


@pytest.mark.oldest
@pytest.mark.skipif(sys.platform != "linux", reason="the cache folder is that of Linux")
def test_the_demo_says_nothing_but_its_progress(tmp_path):
    """Neither cold nor with programs from the cache, of which XLA 0.10 has 2.6 kB a line to say."""
    words = [sys.executable, "-m", "rigidjax", "identify", "--demo"]
    how = {"env": environment(tmp_path), "cwd": tmp_path, "capture_output": True, "text": True}
    cold, warm = (subprocess.run(words, **how, timeout=500) for _ in range(2))
    assert (cold.returncode, cold.stderr) == (warm.returncode, warm.stderr) == (0, "")
    assert cold.stdout == warm.stdout
    held = tmp_path / "rigidjax"
    assert held.stat().st_mode & 0o777 == 0o700 and len(list(held.iterdir())) > 5


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="users and modes are those of POSIX")
@pytest.mark.parametrize(
    ("mode", "owner", "used"),
    [(None, 0, True), (0o755, 0, True), (0o777, 0, False), (0o770, 0, False), (0o700, 1, False)],
)
def test_programs_are_kept_in_a_folder_of_the_users_own(
    mode, owner, used, tmp_path, monkeypatch, capsys
):
    said, user = {}, os.getuid()
    config = SimpleNamespace(update=said.__setitem__)
    monkeypatch.setattr(command, "jax", SimpleNamespace(config=config, __version_info__=(0, 12, 0)))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setattr(command, "_cache_folder", lambda: tmp_path / "rigidjax")
    if mode is not None:
        (tmp_path / "rigidjax").mkdir()
        (tmp_path / "rigidjax").chmod(mode)
    monkeypatch.setattr(os, "getuid", lambda: user + owner)
    command._keep_programs()
    assert ("jax_compilation_cache_dir" in said) == used
    err = capsys.readouterr().err
    assert (err == "") == used and ("is not yours alone" in err) != used
    if used:
        assert (tmp_path / "rigidjax").stat().st_mode & 0o777 == 0o700


HARD = (r"m$\badcmd{$.csv", "<script>alert(1)</script>.csv", "_a$b$\x1b[31m.csv", "bad\udcff.csv")


@pytest.mark.skipif(sys.platform != "linux", reason="names that other systems refuse")
@pytest.mark.parametrize("name", HARD)
def test_hard_names_of_files_take_nothing_away(name, folder, fitted, capsys):
    os.makedirs(os.path.dirname(name) or ".", exist_ok=True)
    Path(name).write_text(GOOD)
    options = ["--figure", "f", "--report", "r.html", "--json", "n.json"]
    assert main(["identify", name, *options]) == 0
    out = capsys.readouterr()
    assert out.err == "" and "\x1b" not in out.out and "\udcff" not in out.out
    assert "figure: f.png" in out.out and Path("f.png").stat().st_size > 10_000
    page = Path("r.html").read_text()
    assert page.count("data:image/png;base64,") == 3 and "<script>" not in page
    shown = Path(name).name.replace("\x1b", r"\x1b").replace("\udcff", r"\udcff")
    assert html.escape(shown) in page
    assert json.loads(Path("n.json").read_text())["files"] == [shown]


def test_names_of_columns_and_parameters_are_escaped_on_the_page(tmp_path):
    ts = jnp.linspace(0.0, 10.0, 30)
    motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    gyro = rj.identify.Gyro(0.01, bias=[0.0, 0.0, 0.0])
    record = rj.identify.Recording(ts, (gyro, motion.ys.omega))
    free = rj.identify.Free(lambda s: s.sensors[0].bias, "<script>$", scale=0.01)
    problem = rj.identify.Model(record, rj.identify.PrincipalRatios(), free=[free])
    found = rj.identify.fit(problem, starts=1)
    page = tmp_path / "page.html"
    rj.identify.report.write_html(found, page, title="<script>", files=["<script>"])
    text = page.read_text()
    assert "<script>" not in text and text.count("&lt;script&gt;") >= 5
    # Initial rates, biases of gyros and residuals of gyros have one unit.
    plain, shown = (rj.identify.report.rows(found, unit) for unit in ("rad/s", "deg/s"))
    rates = [index for index, row in enumerate(plain) if row[4] == "rad/s"]
    assert {plain[index][0][:3] for index in rates} == {"Ωx ", "Ωy ", "Ωz ", "<sc"}
    for index, (before, after) in enumerate(zip(plain, shown, strict=True)):
        factor, unit = (180 / np.pi, "deg/s") if index in rates else (1.0, before[4])
        np.testing.assert_allclose(after[1:4], factor * np.array(before[1:4]), rtol=1e-14)
        assert (after[0], after[4]) == (before[0], unit)
    rj.identify.report.write_html(found, page, rate_unit="deg/s")
    text = page.read_text()
    assert re.search(r"held out: .*\d deg/s", text) and not re.search(r"\d(</td><td>| )rad/s", text)


@pytest.mark.parametrize("broken", ["fit", "residuals", "write_json", "write_html", "both"])
def test_what_fails_after_a_fit_takes_nothing_else_with_it(
    broken, folder, fitted, monkeypatch, capsys
):
    def fails(*_, **__):
        raise RuntimeError("of\nall things")

    report = rj.identify.report
    for name in ("write_json", "write_html") if broken == "both" else (broken,):
        monkeypatch.setattr(report if name.startswith("write") else rj.plot, name, fails)
    code = main(
        ["identify", "log.csv", "--figure", "f.png", "--report", "r.html", "--json", "n.json"]
    )
    out = capsys.readouterr()
    assert "Ix/Iz" in out.out and "status: ok" in out.out
    wrong = {
        "fit": {"f.png"},
        "write_json": {"n.json"},
        "write_html": {"r.html"},
        "residuals": set(),
    }
    wrong["both"] = {"n.json", "r.html"}
    written = {name for name in ("f.png", "r.html", "n.json") if Path(name).exists()}
    assert written == {"f.png", "r.html", "n.json"} - wrong[broken]
    # A page without one of its figures is a page; that one is left out is said.
    assert code == (2 if wrong[broken] else 0)
    assert r"RuntimeError: of\nall things" in out.err


def test_numbers_that_are_none_are_written_all_the_same(found, tmp_path):
    import equinox as eqx

    odd = eqx.tree_at(
        lambda f: (f.assessment.chi2, f.assessment.correlation, f.point.noises),
        found,
        (np.nan, np.inf, (jnp.array([[np.inf, 1.0, 1.0]]),)),
    )
    rj.identify.report.write_json(odd, tmp_path / "n.json")
    held = json.loads((tmp_path / "n.json").read_text())
    assert held["chi2"] is None and held["correlation_samples"] is None
    assert held["noise"] == [[None, 1.0, 1.0]]


def test_ctrl_c_is_said_and_is_the_exit_code(folder, found, monkeypatch, capsys):
    import equinox as eqx

    search = Answer("found", ("interrupted after 1 of 8 starts",))
    cut = eqx.tree_at(lambda f: f.assessment.search, found, search)
    monkeypatch.setattr(rj.identify, "fit", lambda *_, **__: cut)
    assert main(["identify", "log.csv", "--json", "n.json"]) == 130
    out = capsys.readouterr()
    assert f"search: {search}" in out.out and "interrupted" in out.err
    held = json.loads(Path("n.json").read_text())
    assert held["search"] == {"answer": "found", "reasons": ["interrupted after 1 of 8 starts"]}
    assert held["status"] == cut.status

    def at_once(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(rj.identify, "fit", at_once)
    assert main(["identify", "log.csv"]) == 130
    assert capsys.readouterr().err == "error: interrupted (Ctrl-C); nothing more is written\n"


def test_ctrl_c_is_not_lost_in_the_garbage_collector(monkeypatch):
    """JAX has a callback there: what is raised in it Python shows and forgets."""

    class Dropped:
        def __del__(self):
            raise KeyboardInterrupt

    monkeypatch.setattr(sys, "unraisablehook", command._raise_again)
    # A job in the background is started with Ctrl-C ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    begin = time.monotonic()

    def goes_on():
        Dropped()
        while time.monotonic() < begin + 5:
            time.sleep(0.01)

    try:
        with pytest.raises(KeyboardInterrupt):
            goes_on()
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_reader_that_stops_reading_does_not_stop_what_is_written_after():
    says = "import sys; from rigidjax.cli.output import print_line; sys.stdin.read(); print_line('1'); print_line('2'); print('on', file=sys.stderr)"
    pipes = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    run = subprocess.Popen([sys.executable, "-c", says], text=True, **pipes)
    assert run.stdout is not None
    run.stdout.close()
    run.stdout = None
    assert run.communicate()[1] == "on\n" and run.returncode == 0


TIMES = 0.05 * np.arange(40)


def rows_of(t, names="t,wx,wy,wz", scale=1.0):
    """A log of a body that turns about a moving axis."""
    rates = scale * np.stack([np.cos(TIMES), np.sin(TIMES), 1.0 + 0 * TIMES], axis=1)
    rows = np.column_stack([t, rates])
    return names + "\n" + "\n".join(",".join(f"{x:.9g}" for x in row) for row in rows)


def repeated():
    t = TIMES.copy()
    t[7] = t[6]
    return rows_of(t)


def test_what_is_left_out_of_a_log_is_said_and_refused_if_that_is_wanted(folder, fitted, capsys):
    Path("log.csv").write_text(repeated())
    line = (
        "log.csv: column 't': 1 of 40 rows are left out: their times are repeated, backward or "
        "missing (row 8)\n"
    )
    assert main(["identify", "log.csv"]) == 0 and len(fitted) == 1
    out = capsys.readouterr()
    assert out.out.startswith(line + "log.csv: 39 samples over 1.95 s\n") and out.err == ""
    assert main(["identify", "log.csv", "--strict"]) == 2 and len(fitted) == 1
    assert capsys.readouterr().err == f"error: {line[:-1]} (--strict)\n"
    assert main(["identify", "log.csv", "--strict", "--window", "1", "1.9"]) == 0
    assert "log.csv: 19 samples over 0.9 s\n" in capsys.readouterr().out


def test_units_in_the_names_of_columns_are_read_and_said(folder, fitted, capsys):
    names = ["Time [ms]", *(f"Gyroscope {axis} (deg/s)" for axis in "xyz")]
    Path("log.csv").write_text(rows_of(1e3 * TIMES, ",".join(names), 180 / np.pi))
    said = "log.csv: time in ms, gyro in deg/s, as the names of its columns say\n"
    samples = "log.csv: 40 samples over 1.95 s\n"
    for options in ([], ["--columns", *names], ["--columns", *names, "--unit", "deg/s"]):
        assert main(["identify", "log.csv", *options]) == 0
        out = capsys.readouterr().out
        assert said + samples in out and "deg/s" in out.split(samples)[1]
    assert main(["identify", "log.csv", "--unit", "rad/s"]) == 2
    words = "'Gyroscope x (deg/s)' is in deg/s by its name, and rad/s is stated: which one?"
    assert words in capsys.readouterr().err


def test_the_time_column_alone_is_named_beside_a_sensor(folder, fitted, capsys):
    Path("log.csv").write_text(rows_of(1e9 * TIMES, "stamp,p,q,r"))
    options = ["--sensor", "gyro=p,q,r", "--time", "stamp", "--time-unit", "ns"]
    assert main(["identify", "log.csv", *options]) == 0
    assert "log.csv: 40 samples over 1.95 s\n" in capsys.readouterr().out
    options += ["--columns", "stamp", "p", "q", "r"]
    assert main(["identify", "log.csv", *options]) == 2
    assert "--time: not together with --columns" in capsys.readouterr().err


REFUSED = [
    (["log.csv", "--columns", "t", "wx", "wy", "wx"], "'wx' twice; one column"),
    (["log.csv", "--columns", "t", "t", "wy", "wz"], "'t' twice; one column"),
    (["log.csv", "--sensor", "gyro=wx,wy,wy"], "'wy' twice; one column"),
    (["log.csv", "--sensor", "gyro=wx,wy,wz", "--sensor", "accelerometer=wx,wy,wz"], "'wx' twice; one column"),
    (["log.csv", "--wheel", "wx:1e-6"], "'wx' twice; one column"),
    (["log.csv", "./log.csv"], "a log is given twice"),
    (["log.csv", "--json", "log.csv"], "--json: log.csv is already the FILE"),
    (["log.csv", "--json", "a", "--report", "./a"], "--json: a is already the report"),
    (["log.csv", "--figure", "f.xyz"], "f.xyz: wanted a name that ends in .png, .pdf or .svg"),
    (["log.csv", "--figure", "."], "is a folder"),
    (["log.csv", "--json", "absent/n.json"], "there is no folder absent"),
    (["log.csv", "--starts", "0"], "starts: wanted a whole number of at least 1, got 0"),
    (["log.csv", "--starts", "100000000000"], "starts: wanted a whole number of at most 10000, got 100000000000"),
    (["log.csv", "--sensor", "gyro=wx,wy,wz", "--unit", "deg/s"], "--unit: not together with --sensor"),
    (["log.csv", "--sensor", "gyro=wx,wy,wz", "--noise", "1"], "--noise: not together with --sensor"),
    (["log.csv", "--flight", "2"], "log.csv: flight 2: only a Blackbox log (.bbl, .bfl) has flights"),
    (["log.csv", "--window", "20", "30"], "between 20 and 30 s from the first stamp, got 0; the log goes from 0 to 11 s"),
    (["log.csv", "--window", "3", "2"], "window: wanted FROM below TO, got 3 2"),
    (["log.csv", "--free", "delay"], "--free delay: wanted a --wheel"),
    (["a\x1b[31m.csv"], r"a\x1b[31m.csv: no such file"),
    (["log.csv", "--json", "a\x1b[31m/b"], r"there is no folder a\x1b[31m"),
]  # fmt: skip


@pytest.mark.parametrize(("options", "words"), REFUSED)
@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_told_before_the_fit(options, words, folder, capsys):
    before = sorted(folder.iterdir())
    try:
        code = main(["identify", *options])
    except SystemExit as ended:
        code = ended.code
    err = capsys.readouterr().err
    assert code == 2 and words in err and "\x1b" not in err
    assert sorted(folder.iterdir()) == before and Path("log.csv").read_text() == GOOD


def test_the_charts_of_other_commands_are_named_as_they_are_written(folder, capsys):
    stored = Path(__file__).parents[1] / "workprecision" / "record.csv"
    rows = stored.read_text().replace("simulate", r"s$\badcmd{$")
    Path("stored.csv").write_text("\n".join(rows.splitlines()[:20]))
    assert main(["workprecision", "--from", "stored.csv", "--figure", "chart"]) == 0
    assert "figure: chart.png" in capsys.readouterr().out and Path("chart.png").exists()
    with pytest.raises(SystemExit):
        main(["workprecision", "--from", str(stored), "--csv", "absent/a.csv"])
    assert "there is no folder absent" in capsys.readouterr().err
