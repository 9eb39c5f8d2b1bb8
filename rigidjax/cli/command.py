"""Run the command `python -m rigidjax`, which looks at logs, identifies a body from them, gives a
moment of inertia from a swing, or compares methods.
"""

import _thread
import argparse
import contextlib
import dataclasses
import functools
import os
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import rigidjax as rj
from rigidjax import _checks, _show
from rigidjax.cli import spec, swing, write
from rigidjax.cli.logs.errors import LogError, LogWarning, warn
from rigidjax.cli.logs.layouts import USUAL, imu_columns, time_column
from rigidjax.cli.logs.log import Log
from rigidjax.cli.logs.table import full_names, open_log
from rigidjax.cli.logs.units import TIME_UNITS, unit_in_name
from rigidjax.workprecision import command as workprecision

# The demo takes only the options in this tuple. All other options describe how to read logs or what
# to fit to them, and the demo reads no log.
_OF_DEMO = ("starts", "checkpoint", "figure", "report", "json", "no_cache")
# The options of the command `look`.
_OF_LOOK = (
    "logs", "--columns", "--time", "--unit", "--limit", "--sensor", "--time-unit", "--rate",
    "--window", "--flight", "--strict", "--wheel", "--motors", "--figure",
)  # fmt: skip
# Each of these options names a file to write. Two options must not name the same file, and none may
# name a log that is read.
_OUTPUTS = ("checkpoint", "figure", "report", "json", "csv", "keep", "write")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 0 for success, 1 for a fit that cannot be
    trusted, 2 for bad input or a file that could not be written, 130 for an interrupt.

    The words `arguments` are those that this process was started with if they are `None`. The
    process then belongs to this command alone, so that settings of JAX may be changed: compiled
    programs are kept for the next run, unless `--no-cache` is given.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    # JAX computes in float64 from here on. A library must not change this setting of JAX, but this
    # is a program of its own.
    jax.config.update("jax_enable_x64", True)
    if options.command == "swing":
        return swing.run_subcommand(options, parser)
    if options.command == "identify" and options.demo == bool(options.logs):
        parser.error("identify: give either log FILES or --demo")
    if options.command == "look" and not 0 < len(options.logs) < (2 if options.figure else 1e9):
        parser.error("look: give log FILES; with --figure one")
    _check_outputs(options, parser)
    if arguments is None:
        # Characters of a file name that the terminal cannot show are escaped, since they would
        # raise an error that ends the run.
        for stream in (sys.stdout, sys.stderr):
            stream.reconfigure(errors="backslashreplace")  # pyright: ignore
        sys.unraisablehook = _raise_again
    try:
        return _dispatch(options, parser, owns_process=arguments is None)
    except KeyboardInterrupt:
        _print_error("interrupted (Ctrl-C); nothing more is written")
        return 130


def _raise_again(dropped: "sys.UnraisableHookArgs") -> None:
    """Raise a Ctrl-C again that Python dropped, as it does if the interrupt comes while the garbage
    collector calls a function of JAX; report any other exception as usual.
    """
    if dropped.exc_type is KeyboardInterrupt:
        # Another thread raises the interrupt a moment later: an interrupt that is raised within
        # this hook would be dropped again.
        threading.Timer(0.05, _thread.interrupt_main).start()
    else:
        sys.__unraisablehook__(dropped)


def _dispatch(
    options: argparse.Namespace, parser: argparse.ArgumentParser, owns_process: bool
) -> int:
    """Run the command that the options name, and return its exit code."""
    if owns_process:
        rj.set_xla_flags()
    if options.command == "workprecision":
        return workprecision.run_subcommand(options)
    if options.demo:
        plain = vars(parser.parse_args(["identify", "--demo"]))
        changed = [name for name, value in vars(options).items() if value != plain[name]]
        unused = sorted(set(changed) - set(_OF_DEMO))
        if unused:
            names = ", ".join("--" + name.replace("_", "-") for name in unused)
            parser.error(f"identify --demo: {names} is for log FILES only")
    if owns_process and options.no_cache:
        jax.config.update("jax_enable_compilation_cache", False)
    elif owns_process:
        _keep_programs()
    return _run_demo(options) if options.demo else _run_logs(options)


def _check_outputs(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Refuse, before the fit, output files that cannot be written; add the ending `.png` to a
    figure without one.
    """
    figure = options.figure
    if figure is not None and figure.name and not figure.suffix.strip("."):
        # Matplotlib adds the ending `.png` to a name without an ending. The ending is added here,
        # so that messages name the right file.
        options.figure = figure.with_name(figure.name.rstrip(".") + ".png")
    if figure is not None and not _has_matplotlib():
        parser.error("--figure: matplotlib is missing; in the clone: pip install '.[view]'")
    if figure is not None and figure.suffix.strip("."):
        from matplotlib.backend_bases import FigureCanvasBase

        if figure.suffix[1:].lower() not in FigureCanvasBase.get_supported_filetypes():
            parser.error(f"{figure}: wanted a name that ends in .png, .pdf or .svg")
    taken = {Path(path).resolve(): "FILE" for path in getattr(options, "logs", ())}
    if len(taken) < len(getattr(options, "logs", ())):
        parser.error("identify: a log is given twice; its readings would count twice")
    for name in _OUTPUTS:
        path = getattr(options, name, None)
        if path is None:
            continue
        if taken.setdefault(path.resolve(), name) != name:
            parser.error(f"--{name}: {path} is already the {taken[path.resolve()]}")
        if name != "checkpoint" and (path.is_dir() or not path.parent.is_dir()):
            why = "is a folder" if path.is_dir() else f"there is no folder {path.parent}"
            parser.error(f"--{name}: {path}: {why}")


def _keep_programs() -> None:
    """Set JAX to store compiled programs in the user's cache folder, so that the next start takes
    only seconds.

    The command `workprecision` does not, since it measures how long programs take to compile.
    """
    if jax.__version_info__ < (0, 12):
        # Messages of XLA are hidden: for each stored program that XLA loads, it reports two of its
        # own flags as errors, in a line of 2.6 kB.
        jax.config.update("jax_logging_level", "CRITICAL")
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    try:
        folder = _cache_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        held = folder.stat()
        # JAX runs the compiled programs that it finds in this folder. The folder must therefore be
        # writable by this user alone, so that nobody else can put a program there. On Windows the
        # folder of a user belongs to the user already.
        if hasattr(os, "getuid"):
            if held.st_uid != os.getuid() or held.st_mode & 0o022:
                words = "is not yours alone: it is not used, and starts are slower; delete it"
                print(_checks.escape_controls(f"{folder} {words}"), file=sys.stderr)
                return
            folder.chmod(0o700)
    except (OSError, RuntimeError):
        # If the home folder cannot be written to, compiled programs are not kept; only the next
        # start is slower.
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _cache_folder() -> Path:
    """Return the folder of rigidjax inside the user's cache folder, where Linux (XDG), macOS or
    Windows has it.
    """
    xdg_folder = os.environ.get("XDG_CACHE_HOME")
    if xdg_folder:
        return Path(xdg_folder) / "rigidjax"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home()) / "rigidjax"
    inside = "Library/Caches" if sys.platform == "darwin" else ".cache"
    return Path.home() / inside / "rigidjax"


class _Parser(argparse.ArgumentParser):
    """Read the command line; control characters, which the name of a file may contain, are escaped
    in messages.
    """

    def error(self, message: str) -> NoReturn:
        """Print the message escaped, and end the program with exit code 2."""
        super().error(_checks.escape_controls(message))


_FLAG: dict[str, Any] = {"action": "store_true"}
# This table has the options of the command `identify`, each with the arguments of
# `argparse.ArgumentParser.add_argument`.
OPTIONS: dict[str, dict[str, Any]] = {
    "logs": dict(metavar="FILE", nargs="*", help="logs of one body"),
    "--demo": _FLAG | dict(help="the tumbling of 4179 Toutatis"),
    "--columns": dict(
        nargs=4, metavar=("T", "WX", "WY", "WZ"), help="names of the time column and of the three "
        "body rates (default: as their names and units say)"),
    "--time": dict(
        metavar="COLUMN", help="name of the time column, if --columns is not given (default: t)"),
    "--unit": dict(
        choices=("rad/s", "deg/s"),
        help="of the rates (default: as the names of the columns say, such as 'x (deg/s)', else "
        "rad/s; Blackbox and Crazyflie deg/s)"),
    "--noise": dict(
        nargs="+", type=float, help="standard deviation of a rate, in the unit of the rates, one "
        "number or one for each axis (default: estimated)"),
    "--limit": dict(
        type=float, help="full scale of the rates, in the unit of the rates: a reading at full "
        "scale means a rate of at least this size (default: found where the log shows a plateau)"),
    "--tolerance": dict(
        metavar="WORD|SCALE", help="how far a gyro or accelerometer may be off: phone, consumer, "
        "industrial, calibrated, or the deviation of its scale and axes, such as 0.01 (default: "
        "not considered)"),
    "--loss": dict(
        choices=tuple(spec.LOSSES), default="soft-l1",
        help="how a large residual counts: linearly (soft-l1, huber) or squared (none); default: "
        "soft-l1"),
    "--sensor": dict(
        action="append", metavar="KIND=COLUMNS[:UNIT[:NOISE]]",
        help="instead of --columns: gyro=wx,wy,wz:deg/s:0.1, accelerometer=ax,ay,az:m/s2, "
        "quaternion=qw,qx,qy,qz, euler-ZYX=yaw,pitch,roll:deg (body to world); may be repeated; "
        "without UNIT as the names of the columns say"),
    "--time-unit": dict(
        choices=TIME_UNITS,
        help="of the time column (default: as its name says, such as 't [ms]', else s; Blackbox, "
        "PX4 and Crazyflie us)"),
    "--rate": dict(
        type=float, metavar="HZ",
        help="readings a second, of a log without times: --time COLUMN then counts readings "
        "(default: as a line above the columns says)"),
    "--window": dict(
        nargs=2, type=float, metavar=("FROM", "TO"),
        help="use these seconds only, from the first time in the log"),
    "--flight": dict(
        type=int, metavar="N", help="which flight of a Blackbox log that holds several, from 1"),
    "--strict": _FLAG | dict(
        help="refuse a log of which rows or frames would be left out, or whose units are doubtful"),
    "--motors": dict(
        nargs="+", default=[], metavar="COLUMN",
        help="speeds or commands of motors: while one runs, no flight is free"),
    "--throws": _FLAG | dict(
        help="fit all free flights in the logs, which the gyro and, where there is one, the "
        "accelerometer show (see: look LOG)"),
    "--wheel": dict(
        action="append", default=[], metavar="COLUMN:INERTIA[:AXIS[:UNIT]]",
        help="a wheel whose speed was logged: its inertia in kg m², axis x, y or z, rad/s or rpm"),
    "--model": dict(
        choices=tuple(spec.MODELS), default="ratios",
        help="which numbers of the body the fit may change (default: ratios, which is all that "
        "free motion shows)"),
    "--typical": dict(
        type=float, default=1.0, metavar="KG_M2",
        help="about how large a moment of inertia of the body is, kg m² (default: 1)"),
    "--free": dict(
        nargs="+", default=[], choices=("bias", "drag", "delay"),
        help="what else the fit may change: the bias of the sensors and the delay of the wheels, "
        "for each log; one linear drag for all logs"),
    "--wrench": dict(
        nargs=6, metavar=("FX", "FY", "FZ", "TX", "TY", "TZ"),
        help="a body that is carried: columns of the force, N, and torque, N m, of the support on "
        "the body, at the origin of its frame and in its axes; finds mass, centre and inertia"),
    "--pose": dict(
        nargs=7, metavar=("X", "Y", "Z", "QW", "QX", "QY", "QZ"),
        help="with --wrench: columns of the frame's place, m, and attitude, frame to world "
        "(default: x y z qw qx qy qz)"),
    "--motion": dict(
        nargs=9, default=[], metavar=("WX", "WY", "WZ", "AX", "AY", "AZ", "ALX", "ALY", "ALZ"),
        help="with --wrench: columns of the frame's rate, of the acceleration of its origin "
        "(without gravity) and of the derivative of the rate, in its own axes (default: from "
        "smoothed poses)"),
    "--gravity": dict(
        nargs=3, type=float, metavar=("GX", "GY", "GZ"),
        help="with --wrench: gravity in the frame of the poses, m/s² (default: 0 0 -9.81)"),
    "--starts": dict(type=int, help="how many starting points of the fit to try"),
    "--checkpoint": dict(
        type=Path, help="store the state of a long fit in this file, and resume the fit from it"),
    "--figure": dict(
        type=Path, metavar="FILE", help="write a figure to this file (.png, .pdf, .svg)"),
    "--report": dict(
        type=Path, metavar="OUT.html", help="write a page with all results to this file"),
    "--no-cache": _FLAG | dict(
        help="compile anew, and keep no compiled programs in the user's cache folder"),
    "--json": dict(
        type=Path, metavar="OUT.json", help="write all results as numbers to this file"),
    "--write": dict(
        type=Path, metavar="MODEL", help="the body in this file of a simulator becomes the fitted "
        "one: URDF, MuJoCo's XML, params.toml of crazyflow, JSON"),
    "--body": dict(metavar="NAME", help="which body of --write (default: the only one)"),
    "--mount": dict(
        nargs=7, type=float, metavar=("X", "Y", "Z", "QW", "QX", "QY", "QZ"),
        help="place, m, and attitude of the log's axes in the frame of --body (default: the same "
        "frame)"),
    "--yes": _FLAG | dict(help="change the file --write; without it, say what would change"),
}  # fmt: skip


def _parser() -> argparse.ArgumentParser:
    """Return the parser of the command line, with all commands and their options."""
    parser = _Parser(
        prog="python -m rigidjax",
        description="Differentiable rigid-body mechanics for JAX: identify inertia from data.",
        epilog="Try: python -m rigidjax identify --demo",
    )
    parser.add_argument("--version", action="version", version=f"rigidjax {rj.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    identify = commands.add_parser(
        "identify",
        help="fit a body and its motion to recordings",
        description="Fit a body's inertia and motion to logs (text, zip files and sheets of "
        "phones, arrays, logs of flight controllers, ROS), several together if several are given; "
        "or, with --demo, to the radar observations of asteroid 4179 Toutatis.",
        epilog="A throw with a gyro and a flywheel whose inertia is known: identify throw1.csv "
        "throw2.csv --wheel flywheel:1.2e-6:z --model tensor --typical 3e-4 --free drag bias "
        "--report throws.html",
    )
    for name, how in OPTIONS.items():
        identify.add_argument(name, **how)
    look = commands.add_parser(
        "look",
        help="find free flight, swings and rest in logs",
        description="Say when a body flies free, swings about one axis, rests or is handled, and "
        "what can be fitted to each part of a log; an accelerometer is found by its name.",
        epilog="Then: identify LOG --throws, or identify LOG --window FROM TO",
    )
    for name, how in OPTIONS.items():
        if name in _OF_LOOK:
            look.add_argument(name, **how)
        else:
            look.set_defaults(**{name.strip("-").replace("-", "_"): how.get("default")})
    swing.add_command(commands)
    workprecision.add_subcommand(commands)
    return parser


def _run_demo(options: argparse.Namespace) -> int:
    """Fit the motion of the tumbling asteroid Toutatis to radar observations, and return the exit
    code.
    """
    from rigidjax.datasets import toutatis

    print("4179 Toutatis, 17 radar observations, 2 to 18 December 1992")
    print(f"data: {toutatis.CITATION}\n")
    fit = _fit(toutatis.model(), options, 16)
    if fit is None:
        return 2
    more = toutatis.rows(fit)
    print()
    print(rj.identify.report.table(rj.identify.report.rows(fit, "deg/day") + more))
    print(f"\nrms of the attitudes: {toutatis.rms_degrees(fit):.1f} deg")
    print(toutatis.remarks(fit))
    print(rj.identify.report.verdict(fit))
    title = "4179 Toutatis, December 1992"
    units = {"time_unit": "day", "rate_unit": "deg/day"}
    return _write_outputs(fit, options, title, [toutatis.CITATION], [title], units, more)


def _columns(
    path: str, log: Log, options: argparse.Namespace
) -> tuple[list[spec.Channel], dict[str, Any]]:
    """Return the sensors of a log, and the column of its times, their unit, and the rate of its
    readings if that column counts them.

    The sensors are those of `--sensor`, else one gyro, which `--unit`, `--noise` and `--limit`
    describe; **raises** `LogError` for both together, or one that is not positive.
    """
    if options.columns and options.time:
        raise LogError("--time: not together with --columns, whose first name is the time column")
    time, *rates = options.columns or ("", "", "", "")
    time, rate = options.time or time, options.rate
    unit, time_unit = options.unit, options.time_unit
    if not options.columns and not options.sensor:
        found = imu_columns(path, log, rate, time)
        (first, *rates), rate = found.columns, found.rate
        time = time or first
        if found.columns != USUAL.columns:
            _print_line(f"{path}: times {time or 'by the rate'}, rates {', '.join(rates)}")
            unit, time_unit = unit or found.unit, time_unit or found.time_unit
            if not unit:
                warn(f"{path}: no unit of the rates is said: read in rad/s; or give --unit deg/s")
    tolerance = spec.tolerance(options.tolerance)
    if options.sensor:
        alone = [name for name in ("unit", "noise", "limit") if getattr(options, name)]
        if alone:
            raise LogError(
                f"--{alone[0]}: not together with --sensor, whose text holds unit and noise, as in "
                "--sensor gyro=wx,wy,wz:deg/s:0.1"
            )
        channels = [spec.parse_channel(text) for text in options.sensor]
        if not time:
            first = full_names(Path(path), log, channels[0].columns)[0]
            time, rate = time_column(path, log, first, rate)
    else:
        noise = None if options.noise is None else spec.noise_of_axes(options.noise, "--noise")
        if options.limit is not None and not options.limit > 0:
            raise LogError(f"--limit: wanted a positive number, got {options.limit}")
        channels = [spec.Channel("gyro", tuple(rates), unit, noise, options.limit)]
    units = [spec.unit_of_channel(path, log, one) for one in channels]
    channels = [
        dataclasses.replace(c, unit=u, tolerance=tolerance)
        for c, u in zip(channels, units, strict=True)
    ]
    return channels, dict(time=time, rate=rate, time_unit=time_unit)


class _Seen(NamedTuple):
    """Hold what is read of a log: its sensors, its recording, and its phases if they are asked for.

    The recording of `identify` has the sensors that the options name, and no motors.
    """

    channels: list[spec.Channel]
    record: rj.identify.Recording
    phases: list[rj.identify.Phase]


def _read_log(path: str, options: argparse.Namespace, wheels: list[spec.WheelColumn]) -> _Seen:
    """Return what is read of a log; raise `LogError` as `spec.read_log`."""
    log = open_log(Path(path), options.flight)
    channels, times = _columns(path, log, options)
    asked, more = options.throws or options.command == "look", []
    if asked and not any(one.kind == "accelerometer" for one in channels):
        more, log = spec.accelerometer(path, log, channels[0].columns[0], times["time"])
        for one in more:
            _print_line(f"{path}: specific force {', '.join(one.columns)} in {one.unit}")
    how: Any = dict(window=options.window, wheels=wheels, free=options.free, **times)
    record = spec.read_log(path, [*channels, *more], log=log, motors=options.motors, **how)
    said = [
        ("time", times["time"], TIME_UNITS),
        *((c.kind, c.columns[0], (c.unit,)) for c in channels),
    ]
    units = [(what, unit_in_name(name, allowed)) for what, name, allowed in said]
    words = [f"{what} in {unit}" for what, unit in units if unit]
    if words and not times["rate"]:
        _print_line(f"{path}: {', '.join(words)}, as the names of its columns say")
    if not asked:
        return _Seen(channels, record, [])
    alone = eqx.tree_at(lambda r: r.readings, record, record.readings[: len(channels)])
    try:
        phases = rj.identify.find_phases(record, options.motors)
    except ValueError as error:
        if not more:
            raise LogError(f"{path}: {error}") from None
        warn(f"{path}: {error}; the phases are by the gyro alone")
        phases, record = rj.identify.find_phases(alone, options.motors), alone
    return _Seen(channels, record if options.command == "look" else alone, phases)


def _throws(path: str, seen: _Seen) -> list[rj.identify.Recording]:
    """Return the free flights of a log from which a body can be fitted, and print all and what
    they say; raise `LogError` if there is none.
    """
    flights = [phase for phase in seen.phases if phase.kind == "free"]
    for one in flights:
        words = f"{path}: free flight {one.start:.3f} … {one.end:.3f} s"
        left_out = "" if one.is_usable else " is left out"
        _print_line(f"{words}{left_out}; it says {one.says}")
    used = [phase for phase in flights if phase.is_usable]
    if not used:
        raise LogError(
            f"{path}: no free flight from which a body can be fitted; what is in it says: "
            "python -m rigidjax look"
        )
    record, rests = seen.record, [phase for phase in seen.phases if phase.kind == "rest"]
    if rests and isinstance(record.readings[0].sensor, rj.identify.Gyro):
        t, rates = (np.asarray(x) for x in (record.t, record.readings[0].values))
        still = np.any([(one.start <= t) & (t <= one.end) for one in rests], axis=0)
        bias = rates[still & record.readings[0].host_mask].mean(axis=0)
        words = ", ".join(f"{rate:.4f}" for rate in bias)
        _print_line(f"{path}: the bias of the gyro is its rate at rest, {words} rad/s")
        gyro = dataclasses.replace(record.readings[0].sensor, bias=jnp.asarray(bias))
        record = eqx.tree_at(lambda r: r.readings[0].sensor, record, gyro)
    return [record.between(one.start, one.end) for one in used]


def _read_logs(
    options: argparse.Namespace,
) -> tuple[list[spec.Channel], list[rj.identify.Recording], list[str], rj.identify.Model]:
    """Return the sensors of the first log, the recordings of all logs, their names, and the model
    that the options describe; raise `LogError` as `read_log`.
    """
    alone = [name for name in ("pose", "motion", "gravity") if getattr(options, name)]
    if alone and not options.wrench:
        raise LogError(f"--{alone[0]}: wanted a --wrench beside it, the columns of the readings")
    if options.wrench:
        others = ("columns", "sensor", "wheel", "unit", "limit", "flight", "throws", "motors")
        others = [name for name in others if getattr(options, name)]
        if others or set(options.free) - {"bias"}:
            what = f"--{others[0]}" if others else "--free drag, --free delay"
            raise LogError(f"{what}: not together with --wrench, whose motion is the logged one")
        how: dict[str, Any] = dict(
            gravity=options.gravity or [0.0, 0.0, -9.81],
            time=options.time or "t",
            window=options.window,
        )
        how |= dict(time_unit=options.time_unit, noise=options.noise, free=options.free)
        pose = options.pose or ["x", "y", "z", "qw", "qx", "qy", "qz"]
        columns = options.wrench, pose, options.motion
        held = [spec.read_held(path, *columns, **how) for path in options.logs]
        names = [_checks.escape_controls(Path(path).name) for path in options.logs]
        return [], held, names, spec.model_of_held(held, options.free, options.loss)
    wheels = [spec.parse_wheel(text) for text in options.wheel]
    if options.model in ("tensor", "principal") and not wheels:
        words = "free motion shows ratios only; a scale needs a --wheel"
        raise LogError(f"--model {options.model}: {words}")
    if "delay" in options.free and not wheels:
        raise LogError("--free delay: wanted a --wheel, whose delay is to be fitted, got none")
    records, names, of_first = [], [], None
    for path in options.logs:
        seen = _read_log(path, options, wheels)
        mine = _throws(path, seen) if options.throws else [seen.record]
        of_first, records = of_first or seen.channels, [*records, *mine]
        name = _checks.escape_controls(Path(path).name)
        names += [f"{name}, {one.t[0]:.3f} s" if options.throws else name for one in mine]
    how = dict(typical_moment=options.typical, wheels=wheels, free=options.free, loss=options.loss)
    return of_first or [], records, names, spec.model_of(records, options.model, **how)


def _look_at(options: argparse.Namespace) -> list[_Seen]:
    """Return what is read of each log."""
    wheels = [spec.parse_wheel(text) for text in options.wheel]
    return [_read_log(path, options, wheels) for path in options.logs]


def _show_phases(options: argparse.Namespace, seen: Sequence[_Seen]) -> int:
    """Print the phases of each log, draw them, and return the exit code."""
    for path, (channels, record, phases) in zip(options.logs, seen, strict=True):
        span = float(record.t[-1] - record.t[0])
        _print_line("")
        _print_line(f"{path}: {record.t.size} samples over {span:.4g} s")
        _print_line(f"{'from':>10} {'to, s':>10}  {'phase':<10} {'turned':>10}  what can be fitted")
        for p in phases:
            turned = f"{p.turned:6.1f} rad" if p.turned else ""
            _print_line(f"{p.start:10.3f} {p.end:10.3f}  {p.kind:<10} {turned:>10}  {p.says}")
        if any(p.is_usable for p in phases):
            _print_line(f"a fit of the free flights: python -m rigidjax identify {path} --throws")
        if options.figure is not None:
            unit = channels[0].unit if channels[0].unit in ("rad/s", "deg/s") else "rad/s"
            how = dict(rate_unit=unit, title=Path(path).name)
            try:
                rj.plot.phases(record, phases, **how)[0].figure.savefig(options.figure, dpi=130)
            except OSError as error:
                return _print_error(f"no figure: {options.figure}: {error}")
            _print_line(f"figure: {options.figure}")
    return 0


@contextlib.contextmanager
def _log_warnings(strict: bool) -> Iterator[None]:
    """Print each `LogWarning` of a `with` block in one line, or raise the first if `strict`."""
    with warnings.catch_warnings():
        warnings.simplefilter("error" if strict else "always", LogWarning)
        usual = warnings.showwarning

        def show(
            message: Warning | str, category: type[Warning], *_place: Any, **_options: Any
        ) -> None:
            if issubclass(category, LogWarning):
                _print_line(str(message))
            else:
                usual(message, category, *_place, **_options)

        warnings.showwarning = show
        yield


def _run_logs(options: argparse.Namespace) -> int:
    """Fit the model to the logs that the options name, print and write the report, or show the
    phases of the logs, and return the exit code.
    """
    looks = options.command == "look"
    try:
        target = None if looks else write.open_target(options)
        with _log_warnings(options.strict):
            read: Any = (_look_at if looks else _read_logs)(options)
    except ValueError as error:
        return _print_error(error)
    except LogWarning as warning:
        return _print_error(f"{warning} (--strict)")
    if looks:
        return _show_phases(options, read)
    channels, records, names, model = read
    for path, record in zip(names, records, strict=True):
        gaps = sum(int((~reading.host_mask).sum()) for reading in record.readings) + record.dropped
        words = f", {gaps} gap{'s' if gaps > 1 else ''}" if gaps else ""
        count, span = record.t.shape[0] + record.dropped, record.t[-1] - record.t[0]
        _print_line(f"{path}: {count} samples over {span:.4g} s{words}")
    print()
    fit = _fit(model, options, 8, None if target is None else target.before(model))
    if fit is None:
        return 2
    of_gyros = (c.unit for c in channels if c.kind == "gyro" and c.unit in ("rad/s", "deg/s"))
    rate_unit = next(of_gyros, None) or "rad/s"
    print()
    print(rj.identify.report.table(rj.identify.report.rows(fit, rate_unit)))
    for sensor, rms in zip(model.records.sensors, fit.rms, strict=True):
        scale, unit = _show.shown_unit(sensor.unit, rate_unit)
        print(f"\nrms of the {type(sensor).__name__}: {rms * scale:.4g} {unit}", end="")
    print()
    print(rj.identify.report.verdict(fit, rate_unit))
    files = [_checks.escape_controls(Path(path).name) for path in options.logs]
    title = f"Identification of {', '.join(files[:3])}{' …' if files[3:] else ''}"
    code = _write_outputs(fit, options, title, files, names, {"rate_unit": rate_unit})
    if target is None or code > 1:
        return code
    try:
        for line in target.write(fit, options.yes, rate_unit):
            _print_line(line)
    except (OSError, ValueError) as error:
        return _print_error(error)
    return code


def _fit(
    model: rj.identify.Model, options: argparse.Namespace, starts: int, before: Any = None
) -> rj.identify.Fit | None:
    """Return the fit, or `None` after an error whose message is printed; `starts` is used if the
    options name none, and the body `before` predicts what is held out, too.
    """
    try:
        return rj.identify.fit(
            model,
            starts=starts if options.starts is None else options.starts,
            progress=_print_line,
            checkpoint=options.checkpoint,
            before=before,
        )
    except (OSError, ValueError) as error:
        _print_error(error)
        return None


def _write_outputs(
    fit: rj.identify.Fit,
    options: argparse.Namespace,
    title: str,
    files_read: list[str],
    names: list[str],
    units: dict[str, str],
    more_rows: Sequence[tuple[str, float, float, float, str]] = (),
) -> int:
    """Write the figure, report and numbers that the options ask for, and return the exit code: 0
    after a good fit, 1 after another, 2 after a failed output, 130 after Ctrl-C.

    If an output fails, a message is printed, and all others are still written. Files read stand in
    the report, and the recordings' names above figures. The dict `units` has `rate_unit` and, if it
    is not s, `time_unit`; the further rows have the name, value, low and high end of the interval,
    and unit of a quantity.
    """
    report, figure = rj.identify.report, options.figure
    if options.demo and figure is None and _has_matplotlib():
        figure = Path("toutatis.png")

    def write_page() -> None:
        drawn = figure is not None or _has_matplotlib()
        report.write_html(
            fit,
            options.report,
            title=title,
            figures=_figures(fit, names, units) if drawn else [],
            files=files_read,
            more=more_rows,
            rate_unit=units["rate_unit"],
        )

    def write_picture() -> None:
        rj.plot.fit(fit, index=0, title=names[0], **units).savefig(figure, dpi=130)

    numbers = functools.partial(report.write_json, fit, options.json, files_read, more_rows)
    wanted = (
        ("figure", figure, write_picture), ("numbers", options.json, numbers),
        ("report", options.report, write_page),
    )  # fmt: skip
    code = 0 if fit.ok else 1
    for what, path, make in wanted:
        try:
            if path is not None:
                make()
                _print_line(f"{what}: {path}")
        except Exception as error:
            # Any error of one output, such as a full disk, is printed and not raised, so that the
            # other outputs of the fit are still written: a fit of an hour must not be lost.
            code = _print_error(f"no {what}: {path}: {type(error).__name__}: {error}")
    if "interrupted" in fit.status:
        _print_error("interrupted (Ctrl-C): not all starts were made, see the status")
        return 130
    return code


def _figures(fit: rj.identify.Fit, names: list[str], units: dict[str, str]) -> list[Any]:
    """Return the figures of a report, of the first twelve recordings; one whose drawing fails is
    left out with a message.
    """
    figures, plot = [], functools.partial(rj.plot.fit, fit, **units)
    logs = [functools.partial(plot, index=i, title=name) for i, name in enumerate(names[:12])]
    time_unit = units.get("time_unit", "s")
    residuals = functools.partial(rj.plot.residuals, fit, time_unit=time_unit)
    for make in (*logs, residuals, functools.partial(rj.plot.inertia_ellipsoid, fit)):
        try:
            drawn = make()
            figures.append(drawn.flat[0].figure if isinstance(drawn, np.ndarray) else drawn)
        except Exception as error:
            _print_error(f"a figure is left out: {type(error).__name__}: {error}")
    return figures


def _has_matplotlib() -> bool:
    """Return whether matplotlib is installed, and let it draw without windows; print a line if it
    is missing.
    """
    try:
        import matplotlib
    except ModuleNotFoundError:
        _print_line("no figures: matplotlib is missing (in the clone: pip install '.[view]')")
        return False
    matplotlib.use("Agg")
    return True


def _print_line(line: str) -> None:
    """Print a line with its control characters escaped."""
    try:
        print(_checks.escape_controls(line), flush=True)
    except OSError:
        # The program that reads the output has ended, as `head` does, or a disk is full. The run
        # goes on without printing, since its files must still be written.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _print_error(message: object) -> int:
    """Print an error in one line, and return the exit code 2."""
    print(f"error: {_checks.escape_controls(message)}", file=sys.stderr)
    return 2
