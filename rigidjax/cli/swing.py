"""Run the command `python -m rigidjax swing`, which gives a moment of inertia from a period or from
the log of a gyro.
"""

import argparse
import dataclasses
import operator
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from rigidjax import identify
from rigidjax._types import Scalar
from rigidjax.body.inertia import MassProperties
from rigidjax.cli import spec
from rigidjax.cli.logs.layouts import ImuColumns, imu_columns
from rigidjax.cli.logs.table import open_log
from rigidjax.identify.data.reference_states import rates
from rigidjax.suspensions import AbstractSuspension, Axle, Friction, Strings, TorsionBar, period

# The numbers that each suspension needs besides the period.
_NEEDED = {
    "axle": ("mass", "arm"),
    "torsion": ("stiffness",),
    "bifilar": ("mass", "radius", "length"),
    "trifilar": ("mass", "radius", "length"),
}
_HELP = {
    "period": "of one full swing, s",
    "mass": "of the body, kg",
    "arm": "from the axle to the centre of mass, m",
    "stiffness": "of the bar or wire, N m/rad",
    "radius": "of the circle of the strings' lower ends, m",
    "radius-above": "of that of their upper ends, m (default: as below)",
    "length": "of each string, m",
    "amplitude": "the largest angle, rad (default: a small one)",
    "gravity": "m/s² (default: 9.80665)",
}


def add_command(commands: Any) -> None:
    """Add the command and its options to a parser's commands."""
    parser = commands.add_parser(
        "swing",
        help="give a moment of inertia from the period of a swing, or a gyro's log of it",
        description="Give the moment of inertia about the axis of a swing from its period, or from "
        "the log of a gyro, on an axle, a torsion bar, or two or three strings, exact for any "
        "amplitude.",
        epilog="A drone on two strings: swing --suspension bifilar --mass 1.2 --radius 0.1 "
        "--length 0.4 --period 1.36 --amplitude 0.6 --sigma period=0.001 --sigma length=0.0005. "
        "A gyro's log of a pendulum: swing --suspension axle --mass 0.8 --arm 0.24 --log swing.csv",
    )
    parser.add_argument("--suspension", required=True, choices=tuple(_NEEDED))
    for name, words in _HELP.items():
        parser.add_argument(f"--{name}", type=float, help=words)
    parser.add_argument(
        "--log", metavar="FILE", help="of a gyro on the body, in place of --period and --amplitude"
    )
    parser.add_argument(
        "--columns",
        nargs=4,
        metavar=("T", "WX", "WY", "WZ"),
        help="of the log: time and body rates, about any axis (default: as for identify)",
    )
    parser.add_argument("--unit", choices=("rad/s", "deg/s"), help="of the rates of the log")
    parser.add_argument(
        "--window", nargs=2, type=float, metavar=("FROM", "TO"), help="seconds of the log to use"
    )
    parser.add_argument(
        "--friction",
        nargs="*",
        default=["viscous"],
        choices=("viscous", "quadratic", "coulomb"),
        help="which friction to find in the log (default: viscous)",
    )
    parser.add_argument(
        "--sigma",
        action="append",
        default=[],
        metavar="NAME=NUMBER",
        help="the standard deviation of a number above, such as period=0.001; may be repeated",
    )


def run_subcommand(options: argparse.Namespace, parser: argparse.ArgumentParser) -> int:
    """Print the moment of inertia and its interval, and return the exit code."""
    kind = options.suspension
    given = {name.replace("-", "_"): None for name in _HELP}
    given = {name: getattr(options, name) for name in given}
    logged = options.log is not None
    for name in (*_NEEDED[kind], *(() if logged else ("period",))):
        if given[name] is None:
            parser.error(f"swing: --suspension {kind} needs --{name}")
    strings = ("radius_above",) if kind in ("bifilar", "trifilar") else ()
    weight = ("gravity",) if kind != "torsion" else ()
    timed = () if logged else ("period", "amplitude")
    read = {*_NEEDED[kind], *timed, *strings, *weight}
    if spare := [name for name, value in given.items() if value is not None and name not in read]:
        parser.error(f"swing: --suspension {kind} does not read --{spare[0].replace('_', '-')}")
    usual = dict(amplitude=0.0, gravity=9.80665, radius_above=given["radius"])
    numbers = {k: usual.get(k) if v is None else v for k, v in given.items()}
    numbers = {k: jnp.asarray(v) for k, v in numbers.items() if v is not None}
    sigmas = dict.fromkeys(numbers, 0.0)
    for text in options.sigma:
        name, _, number = text.partition("=")
        try:
            sigmas[name.replace("-", "_")] += float(number)
        except (KeyError, ValueError):
            parser.error(f"--sigma: wanted NAME=NUMBER of a number that is given, got {text}")
    of_fit, code = 0.0, 0
    try:
        if logged:
            fit, moment, of_fit = _fit(kind, numbers, options)
            code = 0 if fit.ok else 1
            print(identify.report.verdict(fit))
        else:
            moment = _moment(kind, numbers)
    except ValueError as error:
        parser.error(f"swing: {error}")
    slopes = jax.grad(_excess, argnums=(1, 2), allow_int=False)(kind, moment, numbers)
    # The period is fixed, so that the moment changes by −(∂f/∂x)/(∂f/∂I) for a change of x.
    sigma = np.sqrt(sum((float(slopes[1][k]) * s) ** 2 for k, s in sigmas.items()))
    sigma = float(np.hypot(of_fit, sigma / abs(slopes[0])))
    where = " about its centre of mass" if kind == "axle" else ""
    print(f"moment of inertia{where}: {_text(moment, sigma)}")
    if kind == "axle":
        about = moment + numbers["mass"] * numbers["arm"] ** 2
        print(f"about the axle: {float(about):.6g} kg m²")
    return code


def _fit(
    kind: str, numbers: dict[str, Scalar], options: argparse.Namespace
) -> tuple[identify.Fit, Scalar, float]:
    """Return the fit of a log, the moment through the centre of mass and its deviation, kg m²; add
    the period and the amplitude to the `numbers`.
    """
    log = open_log(Path(options.log))
    given = options.columns
    found = ImuColumns(tuple(given), None, None) if given else imu_columns(options.log, log)
    time, *columns = found.columns
    channel = spec.Channel("gyro", tuple(columns), options.unit or found.unit, None, None)
    channel = dataclasses.replace(channel, unit=spec.unit_of_channel(options.log, log, channel))
    how: Any = dict(time=time, time_unit=found.time_unit, rate=found.rate, window=options.window)
    record = spec.read_log(options.log, [channel], log=log, free=("bias",), **how)
    w = rates(record).values
    axes = np.linalg.eigh(np.cov(w.T))[1][:, ::-1]
    body, law = _hung(kind, jnp.asarray(1e-3), numbers, axes)
    law = dataclasses.replace(law, friction=Friction() if options.friction else None)
    free = [identify.Free(lambda s: cast(Any, s.sensors[0]).bias, "bias")]
    for name in options.friction:
        pick = operator.attrgetter(f"torque.friction.{name}")
        free.append(identify.Free(pick, f"{name} friction", scale=1e-3))
    chart = identify.Moment(body, law)
    fit = identify.fit(identify.Model(record, chart, torque=law, free=free))
    turns = fit.model.motion(fit.x)
    numbers["amplitude"] = jnp.minimum(jnp.max(jnp.abs(turns.angle)), 3.0)
    numbers["period"] = period(fit.body, law, numbers["amplitude"])
    extra = law.moment(body, 0.0) - 1e-3
    return fit, law.moment(fit.body, 0.0) - extra, fit.quantities[0].deviation


def _text(moment: Scalar, sigma: float) -> str:
    """Return a moment and its interval."""
    if sigma == 0:
        return f"{float(moment):.6g} kg m² (no interval without --sigma)"
    low, high = (float(moment) + s * 1.96 * sigma for s in (-1, 1))
    return f"{float(moment):.6g} kg m², 95 % interval {low:.6g} … {high:.6g}"


def _excess(kind: str, moment: Scalar, numbers: dict[str, Scalar]) -> Scalar:
    """Return by how much the square of the period exceeds the measured one, s²."""
    body, suspension = _hung(kind, moment, numbers, np.eye(3)[:, ::-1])
    return period(body, suspension, numbers["amplitude"]) ** 2 - numbers["period"] ** 2


def _hung(
    kind: str, moment: Scalar, numbers: dict[str, Scalar], axes: np.ndarray
) -> tuple[MassProperties, AbstractSuspension]:
    """Return a body with a `moment` about the axis of its suspension, and the suspension of this
    `kind`, whose other quantities (mass, arm, gravity, …) are `numbers`.

    The columns of `axes` are the axis and two directions across it, of which the first one points
    to the centre of mass.
    """
    x, (up, side, _) = numbers, jnp.asarray(axes.T)
    body = MassProperties(
        x.get("mass", jnp.asarray(1.0)),
        x.get("arm", jnp.zeros(())) * side,
        0.5 * moment * (jnp.eye(3) - jnp.outer(up, up)),
    )
    if kind == "axle":
        return body, Axle(up, jnp.zeros(3), x["gravity"] * side)
    if kind == "torsion":
        return body, TorsionBar(up, x["stiffness"])
    number = 2 if kind == "bifilar" else 3
    lengths = x["radius_above"], x["radius"], x["length"]
    return body, Strings(number, *lengths, up, x["gravity"])


def _moment(kind: str, numbers: dict[str, Scalar]) -> Scalar:
    """Return the moment about the axis, kg m², that has the measured period.

    The square of the period is nearly linear in the moment: Newton's method needs few steps.
    """
    moment = jnp.asarray(1e-3)
    for _ in range(20):
        value, slope = jax.value_and_grad(_excess, argnums=1)(kind, moment, numbers)
        moment = moment - value / slope
        if not moment > 0:
            raise ValueError(
                "no moment of inertia has so short a period: are all numbers in SI units, and the "
                "period that of a full swing, there and back?"
            )
        if abs(value) <= 1e-14 * numbers["period"] ** 2:
            break
    return moment
