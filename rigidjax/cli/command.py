"""`python -m rigidjax`: identify a body from recordings; compare methods."""

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
from typing import Any, NoReturn

import jax
import numpy as np

import rigidjax as rj
from rigidjax import _checks
from rigidjax.cli import spec
from rigidjax.cli.logs.errors import LogError, LogWarning
from rigidjax.cli.logs.layouts import layout_of
from rigidjax.cli.logs.units import TIME_UNITS, unit_in
from rigidjax.workprecision import command as workprecision

# The options that the demo uses as well; the others describe how to read logs.
_OF_ALL = ("starts", "checkpoint", "figure", "report", "json", "no_cache")
# The outputs, and the inputs that must not be overwritten.
_OUT = ("checkpoint", "figure", "report", "json", "csv", "keep")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    0 success; 1 an untrustworthy fit; 2 bad input, or a file that could not be written; 130
    interrupted.

    **Arguments:** `arguments` those of the command line; `None` for the ones of this process. Only
    then does the process belong to this command, and its compiled programs are kept for the next
    run (`--no-cache`).
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    # A program of its own, not a library: the switch is ours to set here.
    jax.config.update("jax_enable_x64", True)
    if options.command == "identify" and options.demo == bool(options.logs):
        parser.error("identify: give either log FILES or --demo")
    _check_files(options, parser)
    if arguments is None:
        # A name that the terminal cannot show must not end a run.
        for stream in (sys.stdout, sys.stderr):
            stream.reconfigure(errors="backslashreplace")  # pyright: ignore
        sys.unraisablehook = _once_more
    try:
        return _run(options, parser, own=arguments is None)
    except KeyboardInterrupt:
        _error("interrupted (Ctrl-C); nothing more is written")
        return 130


def _once_more(lost: Any) -> None:
    """Raise Ctrl-C once more where Python drops it, as in JAX's callback of the collector."""
    if lost.exc_type is KeyboardInterrupt:
        # From another thread, and later: here it would be dropped again.
        threading.Timer(0.05, _thread.interrupt_main).start()
    else:
        sys.__unraisablehook__(lost)


def _run(options: argparse.Namespace, parser: argparse.ArgumentParser, own: bool) -> int:
    if options.command == "workprecision":
        return workprecision.run(options)
    if options.demo:
        plain = vars(parser.parse_args(["identify", "--demo"]))
        given = [name for name, value in vars(options).items() if value != plain[name]]
        odd = sorted(set(given) - set(_OF_ALL))
        if odd:
            names = ", ".join("--" + name.replace("_", "-") for name in odd)
            parser.error(f"identify --demo: {names} is for log FILES only")
    if own and options.no_cache:
        jax.config.update("jax_enable_compilation_cache", False)
    elif own:
        _keep_compiled()
    return _demo(options) if options.demo else _logs(options)


def _check_files(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """End with a message where a file cannot be written: now, not after the fit."""
    figure = options.figure
    if figure is not None and figure.name and not figure.suffix.strip("."):
        # As matplotlib does, so that its name is said.
        options.figure = figure.with_name(figure.name.rstrip(".") + ".png")
    if figure is not None and not _matplotlib():
        parser.error("--figure: needs matplotlib: pip install 'rigidjax[view]'")
    if figure is not None and figure.suffix.strip("."):
        from matplotlib.backend_bases import FigureCanvasBase

        if figure.suffix[1:].lower() not in FigureCanvasBase.get_supported_filetypes():
            parser.error(f"{figure}: wanted a name that ends in .png, .pdf or .svg")
    taken = {Path(path).resolve(): "FILE" for path in getattr(options, "logs", ())}
    if len(taken) < len(getattr(options, "logs", ())):
        parser.error("identify: a log is given twice; its readings would count twice")
    for name in _OUT:
        path = getattr(options, name, None)
        if path is None:
            continue
        if taken.setdefault(path.resolve(), name) != name:
            parser.error(f"--{name}: {path} is already the {taken[path.resolve()]}")
        if name != "checkpoint" and (path.is_dir() or not path.parent.is_dir()):
            why = "is a folder" if path.is_dir() else f"there is no folder {path.parent}"
            parser.error(f"--{name}: {path}: {why}")


def _keep_compiled() -> None:
    """Keep compiled programs in the user's cache folder: the next start takes seconds.

    Not those of `workprecision`, which measures how long compiling takes.
    """
    if jax.__version_info__ < (0, 12):
        # XLA reports two flags of its own for each program that it loads, 2.6 kB a line, as errors.
        jax.config.update("jax_logging_level", "CRITICAL")
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    try:
        folder = _cache_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        held = folder.stat()
        # Programs loaded from there are run: nobody else may have put them there. On Windows a
        # user's folder is the user's own already.
        if hasattr(os, "getuid"):
            if held.st_uid != os.getuid() or held.st_mode & 0o022:
                told = "is not yours alone: it is not used, and starts are slower; delete it"
                print(_checks.printable(f"{folder} {told}"), file=sys.stderr)
                return
            folder.chmod(0o700)
    except (OSError, RuntimeError):
        # No home, or one that cannot be written to: a slower start, nothing else.
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _cache_folder() -> Path:
    """Return where this platform has a user's caches: XDG, macOS, Windows."""
    given = os.environ.get("XDG_CACHE_HOME")
    if given:
        return Path(given) / "rigidjax"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home()) / "rigidjax"
    inside = "Library/Caches" if sys.platform == "darwin" else ".cache"
    return Path.home() / inside / "rigidjax"


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        super().error(_checks.printable(message))


_FLAG: dict[str, Any] = {"action": "store_true"}
# The options of `identify`, as `argparse` takes them.
OPTIONS: dict[str, dict[str, Any]] = {
    "logs": dict(metavar="FILE", nargs="*", help="logs of one body"),
    "--demo": _FLAG | dict(help="the tumbling of 4179 Toutatis"),
    "--columns": dict(
        nargs=4, metavar=("T", "WX", "WY", "WZ"), help="names of the time column and of the three "
        "body rates (default: t wx wy wz; those of phyphox and of binary logs are known)"),
    "--time": dict(
        metavar="COLUMN", help="name of the time column alone, beside --sensor (default: t)"),
    "--unit": dict(
        choices=("rad/s", "deg/s"),
        help="of the rates (default: as the names of the columns say, such as 'x (deg/s)', else "
        "rad/s; Blackbox and Crazyflie deg/s)"),
    "--noise": dict(
        nargs="+", type=float, help="standard deviation of a rate, in the unit of the rates, one "
        "number or one for each axis (default: estimated)"),
    "--limit": dict(
        type=float, help="full scale of the rates, in their unit: a reading at it counts as at "
        "least that much (default: found where the log shows a plateau)"),
    "--loss": dict(
        choices=tuple(spec.LOSSES), default="soft-l1",
        help="how an outlier counts: linearly, or squared (none; default: soft-l1)"),
    "--sensor": dict(
        action="append", metavar="KIND=COLUMNS[:UNIT[:NOISE]]",
        help="instead of --columns: gyro=wx,wy,wz:deg/s:0.1, accelerometer=ax,ay,az:m/s2, "
        "quaternion=qw,qx,qy,qz, euler-ZYX=yaw,pitch,roll:deg (body to world); may be repeated; "
        "without UNIT as the names of the columns say"),
    "--time-unit": dict(
        choices=TIME_UNITS,
        help="of the time column (default: as its name says, such as 't [ms]', else s; Blackbox, "
        "PX4 and Crazyflie us)"),
    "--window": dict(
        nargs=2, type=float, metavar=("FROM", "TO"),
        help="use these seconds only, from the first time in the log"),
    "--flight": dict(
        type=int, metavar="N", help="which flight of a Blackbox log that holds several, from 1"),
    "--strict": _FLAG | dict(
        help="refuse a log of which rows or frames would be left out, or whose units are doubtful"),
    "--wheel": dict(
        action="append", default=[], metavar="COLUMN:INERTIA[:AXIS[:UNIT]]",
        help="a wheel whose speed was logged: its inertia in kg m², axis x, y or z, rad/s or rpm"),
    "--model": dict(
        choices=tuple(spec.MODELS), default="ratios",
        help="what of the body is free (default: ratios, all that free motion shows)"),
    "--typical": dict(
        type=float, default=1.0, metavar="KG_M2", help="about how large a moment is"),
    "--free": dict(
        nargs="+", default=[], choices=("bias", "drag", "delay"),
        help="what else is free: sensor bias and wheel delay of each log, linear drag of all"),
    "--starts": dict(type=int, help="how many starting points to try"),
    "--checkpoint": dict(type=Path, help="keep and resume a long fit in this file"),
    "--figure": dict(
        type=Path, metavar="FILE", help="where the figure goes (.png, .pdf, .svg)"),
    "--report": dict(type=Path, metavar="OUT.html", help="a page with all of it"),
    "--no-cache": _FLAG | dict(
        help="compile anew, and keep no compiled programs in the user's cache folder"),
    "--json": dict(type=Path, metavar="OUT.json", help="the same as numbers"),
}  # fmt: skip


def _parser() -> argparse.ArgumentParser:
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
        description="Fit a body's inertia and motion to logs (.csv or .csv.gz with a header line, "
        ".npz, .mat, Blackbox's .bbl and .bfl, PX4's .ulg, .mcap, a Crazyflie's), several together "
        "if several are given; or, with --demo, to the radar observations of asteroid "
        "4179 Toutatis.",
        epilog="A throw with a gyro and a flywheel whose inertia is known: identify throw1.csv "
        "throw2.csv --wheel flywheel:1.2e-6:z --model tensor --typical 3e-4 --free drag bias "
        "--report throws.html",
    )
    for name, how in OPTIONS.items():
        identify.add_argument(name, **how)
    workprecision.add(commands)
    return parser


def _demo(options: argparse.Namespace) -> int:
    from rigidjax.datasets import toutatis

    print("4179 Toutatis, 17 radar observations, 2 to 18 December 1992")
    print(f"data: {toutatis.CITATION}\n")
    found = _fit(toutatis.model(), options, 16)
    if found is None:
        return 2
    more = toutatis.rows(found)
    print()
    print(rj.identify.report.table(rj.identify.report.rows(found, "deg/day") + more))
    print(f"\nrms of the attitudes: {toutatis.rms_degrees(found):.1f} deg")
    print(toutatis.remarks(found))
    print(rj.identify.report.verdict(found))
    title = "4179 Toutatis, December 1992"
    units = {"time_unit": "day", "rate_unit": "deg/day"}
    return _write(found, options, title, [toutatis.CITATION], [title], units, more)


def _channels(options: argparse.Namespace, rates: Sequence[str]) -> list[spec.Channel]:
    """Return the sensors that the options describe."""
    if options.sensor:
        alone = [name for name in ("unit", "noise", "limit") if getattr(options, name)]
        if alone:
            raise LogError(f"--{alone[0]}: with --sensor, it stands in that itself")
        return [spec.channel(text) for text in options.sensor]
    noise = None if options.noise is None else spec.noises(options.noise, "--noise")
    if options.limit is not None and not options.limit > 0:
        raise LogError(f"--limit: wanted a positive number, got {options.limit}")
    return [spec.Channel("gyro", tuple(rates), options.unit, noise, options.limit)]


def _read(options: argparse.Namespace) -> tuple[list[Any], list[Any], rj.identify.Model]:
    """Return the sensors, the recordings, and the model that the options describe."""
    if options.columns and options.time:
        raise LogError("--time: the first of --columns is it already")
    wheels = [spec.wheel(text) for text in options.wheel]
    if options.model in ("tensor", "principal") and not wheels:
        words = "free motion shows ratios only; a scale needs a --wheel"
        raise LogError(f"--model {options.model}: {words}")
    if "delay" in options.free and not wheels:
        raise LogError("--free delay: that of a --wheel, and there is none")
    how: dict[str, Any] = dict(window=options.window, wheels=wheels, free=options.free)
    records, of_first = [], None
    for path in options.logs:
        time, *rates = options.columns or layout_of(path).columns
        time = options.time or time
        time_unit = spec.unit_of_time(path, time, options.time_unit)
        channels = [
            dataclasses.replace(one, unit=spec.unit_of_channel(path, one))
            for one in _channels(options, rates)
        ]
        _say_units(path, time, time_unit, channels)
        how |= dict(time=time, time_unit=time_unit, flight=options.flight)
        records.append(spec.read_log(path, channels, **how))
        of_first = of_first or channels
    how = dict(typical=options.typical, wheels=wheels, free=options.free, loss=options.loss)
    return of_first or [], records, spec.model_of(records, options.model, **how)


def _say_units(path: str, time: str, time_unit: str, channels: Sequence[spec.Channel]) -> None:
    """Say which units were read from the names of columns."""
    units = [("time", (time,), time_unit)] + [(one.kind, one.columns, one.unit) for one in channels]
    words = [f"{what} in {unit}" for what, names, unit in units if unit_in(names[0], [unit or ""])]
    if words:
        _say(f"{path}: {', '.join(words)}, as the names of its columns say")


@contextlib.contextmanager
def _log_warnings(strict: bool) -> Iterator[None]:
    """Say warnings of logs in one line each, or raise the first of them where that is wanted."""
    with warnings.catch_warnings():
        warnings.simplefilter("error" if strict else "always", LogWarning)
        usual = warnings.showwarning

        def show(message: Any, category: type[Warning], *where: Any, **how: Any) -> None:
            if issubclass(category, LogWarning):
                _say(str(message))
            else:
                usual(message, category, *where, **how)

        warnings.showwarning = show
        yield


def _logs(options: argparse.Namespace) -> int:
    try:
        with _log_warnings(options.strict):
            channels, records, model = _read(options)
    except ValueError as error:
        return _error(error)
    except LogWarning as warning:
        return _error(f"{warning} (--strict)")
    for path, record in zip(options.logs, records, strict=True):
        gaps = sum(int((~reading.seen).sum()) for reading in record.readings) + record.dropped
        told = f", {gaps} gap{'s' if gaps > 1 else ''}" if gaps else ""
        count, span = record.t.shape[0] + record.dropped, record.t[-1] - record.t[0]
        _say(f"{path}: {count} samples over {span:.4g} s{told}")
    print()
    found = _fit(model, options, 8)
    if found is None:
        return 2
    rate_unit = next((c.unit for c in channels if c.kind == "gyro" and c.unit != "rpm"), "rad/s")
    print()
    print(rj.identify.report.table(rj.identify.report.rows(found, rate_unit)))
    for sensor, rms in zip(model.records.sensors, found.rms, strict=True):
        scale = 180 / 3.141592653589793 if sensor.unit == "rad/s" and rate_unit == "deg/s" else 1.0
        unit = rate_unit if sensor.unit == "rad/s" else sensor.unit
        print(f"\nrms of the {type(sensor).__name__}: {rms * scale:.4g} {unit}", end="")
    print()
    print(rj.identify.report.verdict(found))
    names = [_checks.printable(Path(path).name) for path in options.logs]
    title = f"Identification of {', '.join(names[:3])}{' …' if names[3:] else ''}"
    return _write(found, options, title, names, names, {"rate_unit": rate_unit})


def _fit(model: rj.identify.Model, options: argparse.Namespace, starts: int) -> Any:
    """Return the fit, or `None` after an error message."""
    try:
        return rj.identify.fit(
            model,
            starts=starts if options.starts is None else options.starts,
            progress=_say,
            checkpoint=options.checkpoint,
        )
    except (OSError, ValueError) as error:
        _error(error)
        return None


def _write(
    found: Any,
    options: argparse.Namespace,
    title: str,
    read: list[str],
    names: list[str],
    units: dict[str, str],
    more: Sequence[tuple[str, float, float, float, str]] = (),
) -> int:
    """Write the outputs that the options ask for, each separately; return the exit code."""
    report, figure = rj.identify.report, options.figure
    if options.demo and figure is None and _matplotlib():
        figure = Path("toutatis.png")

    def page() -> None:
        figures = _figures(found, names, units) if figure is not None or _matplotlib() else []
        page: dict[str, Any] = {"title": title, "figures": figures, "files": read, "more": more}
        report.write_html(found, options.report, rate_unit=units["rate_unit"], **page)

    def drawn() -> None:
        rj.plot.fit(found, index=0, title=names[0], **units).savefig(figure, dpi=130)

    numbers = functools.partial(report.write_json, found, options.json, read, more)
    wanted = (
        ("figure", figure, drawn), ("numbers", options.json, numbers),
        ("report", options.report, page),
    )  # fmt: skip
    kept = True
    for what, path, make in wanted:
        try:
            if path is not None:
                make()
                _say(f"{what}: {path}")
        except Exception as error:
            # Nothing else is lost.
            _error(f"no {what}: {path}: {type(error).__name__}: {error}")
            kept = False
    if "interrupted" in found.status:
        _error("interrupted (Ctrl-C): not all starts were made, see the status")
        return 130
    return 2 if not kept else 0 if found.ok else 1


def _figures(found: Any, names: list[str], units: dict[str, str]) -> list[Any]:
    figures, fit = [], functools.partial(rj.plot.fit, found, **units)
    logs = [functools.partial(fit, index=i, title=name) for i, name in enumerate(names[:12])]
    time_unit = units.get("time_unit", "s")
    left_over = functools.partial(rj.plot.residuals, found, time_unit=time_unit)
    for make in (*logs, left_over, functools.partial(rj.plot.inertia_ellipsoid, found)):
        try:
            drawn = make()
            figures.append(drawn.flat[0].figure if isinstance(drawn, np.ndarray) else drawn)
        except Exception as error:
            _error(f"a figure is left out: {type(error).__name__}: {error}")
    return figures


def _matplotlib() -> bool:
    """Whether figures can be drawn; without a window."""
    try:
        import matplotlib
    except ModuleNotFoundError:
        _say("no figures: matplotlib is missing (pip install 'rigidjax[view]')")
        return False
    matplotlib.use("Agg")
    return True


def _say(line: str) -> None:
    try:
        print(_checks.printable(line), flush=True)
    except OSError:
        # The reader has stopped, as `head` does, or a disk is full: files are still to be written.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _error(what: object) -> int:
    """Print the error in one line; **returns** the exit code 2."""
    print(f"error: {_checks.printable(what)}", file=sys.stderr)
    return 2
