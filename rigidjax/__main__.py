"""`python -m rigidjax`: identify a body from a recording on the command line."""

import argparse
import sys
from pathlib import Path
from typing import Any

import jax

import rigidjax as rj


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code (0 good, 1 a fit not to trust, 2 bad input)."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    # A program of its own, not a library: the switch is ours to set here.
    jax.config.update("jax_enable_x64", True)
    if options.demo == (options.log is not None):
        parser.error("identify: give either a LOG.csv or --demo")
    return _demo(options) if options.demo else _log(options)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m rigidjax",
        description="Differentiable rigid-body mechanics for JAX: identify inertia from data.",
        epilog="Try: python -m rigidjax identify --demo",
    )
    parser.add_argument("--version", action="version", version=f"rigidjax {rj.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    identify = commands.add_parser(
        "identify",
        help="fit inertia ratios and first state to a torque-free recording",
        description="Fit a torque-free motion to a gyro log (CSV with a header line), or, with "
        "--demo, to the radar observations of asteroid 4179 Toutatis.",
    )
    identify.add_argument("log", metavar="LOG.csv", nargs="?", help="gyro log")
    identify.add_argument("--demo", action="store_true", help="the tumbling of 4179 Toutatis")
    identify.add_argument(
        "--columns",
        nargs=4,
        metavar=("T", "WX", "WY", "WZ"),
        default=("t", "wx", "wy", "wz"),
        help="names of the time column (s) and of the three body rates (default: t wx wy wz)",
    )
    identify.add_argument(
        "--unit", choices=("rad/s", "deg/s"), default="rad/s", help="of the rates (default: rad/s)"
    )
    identify.add_argument(
        "--noise", type=float, help="standard deviation of a rate, in --unit (default: estimated)"
    )
    identify.add_argument("--starts", type=int, help="how many starting points to try")
    identify.add_argument(
        "--figure", type=Path, metavar="FILE", help="where the figure goes (.png, .pdf, .svg)"
    )
    return parser


def _demo(options: argparse.Namespace) -> int:
    from rigidjax.identify import toutatis

    print("4179 Toutatis, 17 radar observations, 2 to 18 December 1992")
    print(f"data: {toutatis.CITATION}\n")
    found = rj.identify.fit(toutatis.problem(), starts=options.starts or 16, progress=_say)
    print()
    print(
        rj.identify.report.table(rj.identify.report.rows(found, "deg/day") + toutatis.rows(found))
    )
    print(f"\nrms of the attitudes: {toutatis.rms_degrees(found):.1f} deg")
    print(toutatis.remarks(found))
    print(rj.identify.report.verdict(found))
    figure = options.figure or Path("toutatis.png")
    _draw(found, figure, time_unit="day", rate_unit="deg/day", title="4179 Toutatis, December 1992")
    return 0 if found.ok else 1


def _log(options: argparse.Namespace) -> int:
    try:
        record = rj.identify.read_gyro_csv(
            options.log, columns=tuple(options.columns), unit=options.unit, noise=options.noise
        )
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{options.log}: {record.t.shape[0]} samples over {record.t[-1] - record.t[0]:.4g} s\n")
    problem = rj.identify.Problem(record, rj.identify.Ratios(), loss=rj.identify.SoftL1())
    found = rj.identify.fit(problem, starts=options.starts or 8, progress=_say)
    print()
    print(rj.identify.report.table(rj.identify.report.rows(found, options.unit)))
    scale = 1.0 if options.unit == "rad/s" else 180 / 3.141592653589793
    print(f"\nrms of the rates: {found.rms[0] * scale:.4g} {options.unit}")
    print(rj.identify.report.verdict(found))
    if options.figure is not None:
        _draw(found, options.figure, rate_unit=options.unit, title=Path(options.log).name)
    return 0 if found.ok else 1


def _say(line: str) -> None:
    print(line, flush=True)


def _draw(found: Any, path: Path, **how: Any) -> None:
    try:
        import matplotlib
    except ModuleNotFoundError:
        print("no figure: matplotlib is missing (pip install 'rigidjax[view]')")
        return
    matplotlib.use("Agg")
    try:
        rj.plot.fit(found, **how).savefig(path, dpi=130)
    except (OSError, ValueError) as error:
        print(f"no figure: {path}: {error}", file=sys.stderr)
        return
    print(f"figure: {path}")


if __name__ == "__main__":
    sys.exit(main())
