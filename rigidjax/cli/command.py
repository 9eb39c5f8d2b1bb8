"""Run the command `python -m rigidjax`, which looks at logs, identifies a body from them, gives a
moment of inertia from a swing, or compares methods.
"""

import _thread
import argparse
import functools
import os
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import jax
import numpy as np

import rigidjax as rj
from rigidjax import _checks, _show
from rigidjax.cli import spec, swing, write
from rigidjax.cli.logs.errors import LogWarning
from rigidjax.cli.logs.units import TIME_UNITS
from rigidjax.cli.output import print_error, print_line, print_warnings
from rigidjax.cli.reading import Seen, look_at, read_logs
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
        print_error("interrupted (Ctrl-C); nothing more is written")
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


def _show_phases(options: argparse.Namespace, seen: Sequence[Seen]) -> int:
    """Print the phases of each log, draw them, and return the exit code."""
    for path, (channels, record, phases) in zip(options.logs, seen, strict=True):
        span = float(record.t[-1] - record.t[0])
        print_line("")
        print_line(f"{path}: {record.t.size} samples over {span:.4g} s")
        print_line(f"{'from':>10} {'to, s':>10}  {'phase':<10} {'turned':>10}  what can be fitted")
        for p in phases:
            turned = f"{p.turned:6.1f} rad" if p.turned else ""
            print_line(f"{p.start:10.3f} {p.end:10.3f}  {p.kind:<10} {turned:>10}  {p.says}")
        if any(p.is_usable for p in phases):
            print_line(f"a fit of the free flights: python -m rigidjax identify {path} --throws")
        if options.figure is not None:
            unit = channels[0].unit if channels[0].unit in ("rad/s", "deg/s") else "rad/s"
            how = dict(rate_unit=unit, title=Path(path).name)
            try:
                rj.plot.phases(record, phases, **how)[0].figure.savefig(options.figure, dpi=130)
            except OSError as error:
                return print_error(f"no figure: {options.figure}: {error}")
            print_line(f"figure: {options.figure}")
    return 0


def _run_logs(options: argparse.Namespace) -> int:
    """Fit the model to the logs that the options name, print and write the report, or show the
    phases of the logs, and return the exit code.
    """
    looks = options.command == "look"
    try:
        target = None if looks else write.open_target(options)
        with print_warnings(options.strict):
            read: Any = (look_at if looks else read_logs)(options)
    except ValueError as error:
        return print_error(error)
    except LogWarning as warning:
        return print_error(f"{warning} (--strict)")
    if looks:
        return _show_phases(options, read)
    channels, records, names, model = read
    for path, record in zip(names, records, strict=True):
        gaps = sum(int((~reading.host_mask).sum()) for reading in record.readings) + record.dropped
        words = f", {gaps} gap{'s' if gaps > 1 else ''}" if gaps else ""
        count, span = record.t.shape[0] + record.dropped, record.t[-1] - record.t[0]
        print_line(f"{path}: {count} samples over {span:.4g} s{words}")
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
            print_line(line)
    except (OSError, ValueError) as error:
        return print_error(error)
    return code


def _fit(
    model: rj.identify.Model, options: argparse.Namespace, starts: int, before: Any = None
) -> rj.identify.Fit | None:
    """Return the fit, or `None` after an error whose message is printed; `starts` is used if the
    options name none, and the body `before` predicts what is held out, too.
    """
    try:
        with print_warnings(strict=False):
            return rj.identify.fit(
                model,
                starts=starts if options.starts is None else options.starts,
                progress=print_line,
                checkpoint=options.checkpoint,
                before=before,
            )
    except (OSError, ValueError) as error:
        print_error(error)
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
                print_line(f"{what}: {path}")
        except Exception as error:
            # Any error of one output, such as a full disk, is printed and not raised, so that the
            # other outputs of the fit are still written: a fit of an hour must not be lost.
            code = print_error(f"no {what}: {path}: {type(error).__name__}: {error}")
    if "interrupted" in fit.status:
        print_error("interrupted (Ctrl-C): not all starts were made, see the status")
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
            print_error(f"a figure is left out: {type(error).__name__}: {error}")
    return figures


def _has_matplotlib() -> bool:
    """Return whether matplotlib is installed, and let it draw without windows; print a line if it
    is missing.
    """
    try:
        import matplotlib
    except ModuleNotFoundError:
        print_line("no figures: matplotlib is missing (in the clone: pip install '.[view]')")
        return False
    matplotlib.use("Agg")
    return True
