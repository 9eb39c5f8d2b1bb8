"""Run the command `python -m rigidjax swing`, which gives a moment of inertia from a period."""

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rigidjax._types import Scalar
from rigidjax.body.inertia import MassProperties
from rigidjax.suspensions import Axle, Strings, TorsionBar, period

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
        help="give a moment of inertia from the period of a swing",
        description="Give the moment of inertia about the axis of a swing from its period, on an "
        "axle, a torsion bar, or two or three strings, exact for any amplitude.",
        epilog="A drone on two strings: swing --suspension bifilar --mass 1.2 --radius 0.1 "
        "--length 0.4 --period 1.36 --amplitude 0.6 --sigma period=0.001 --sigma length=0.0005",
    )
    parser.add_argument("--suspension", required=True, choices=tuple(_NEEDED))
    for name, words in _HELP.items():
        parser.add_argument(f"--{name}", type=float, required=name == "period", help=words)
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
    for name in (*_NEEDED[kind], "period"):
        if given[name] is None:
            parser.error(f"swing: --suspension {kind} needs --{name}")
    strings = ("radius_above",) if kind in ("bifilar", "trifilar") else ()
    weight = ("gravity",) if kind != "torsion" else ()
    read = {*_NEEDED[kind], "period", "amplitude", *strings, *weight}
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
    try:
        moment = _moment(kind, numbers)
    except ValueError as error:
        parser.error(f"swing: {error}")
    slopes = jax.grad(_excess, argnums=(1, 2), allow_int=False)(kind, moment, numbers)
    # The period is fixed, so that the moment changes by −(∂f/∂x)/(∂f/∂I) for a change of x.
    sigma = np.sqrt(sum((float(slopes[1][k]) * s) ** 2 for k, s in sigmas.items()))
    sigma = float(sigma / abs(slopes[0]))
    where = " about its centre of mass" if kind == "axle" else ""
    print(f"moment of inertia{where}: {_text(moment, sigma)}")
    if kind == "axle":
        about = moment + numbers["mass"] * numbers["arm"] ** 2
        print(f"about the axle: {float(about):.6g} kg m²")
    return 0


def _text(moment: Scalar, sigma: float) -> str:
    """Return a moment and its interval."""
    if sigma == 0:
        return f"{float(moment):.6g} kg m² (no interval without --sigma)"
    low, high = (float(moment) + s * 1.96 * sigma for s in (-1, 1))
    return f"{float(moment):.6g} kg m², 95 % interval {low:.6g} … {high:.6g}"


def _excess(kind: str, moment: Scalar, numbers: dict[str, Scalar]) -> Scalar:
    """Return by how much the square of the period exceeds the measured one, s²."""
    x = numbers
    body = MassProperties(
        x.get("mass", jnp.asarray(1.0)),
        jnp.stack([x.get("arm", jnp.zeros(())), jnp.zeros(()), jnp.zeros(())]),
        moment * jnp.diag(jnp.array([0.5, 0.5, 0.0])),
    )
    up = jnp.array([0.0, 0.0, 1.0])
    if kind == "axle":
        suspension: Any = Axle(up, jnp.zeros(3), x["gravity"] * jnp.array([1.0, 0.0, 0.0]))
    elif kind == "torsion":
        suspension = TorsionBar(up, x["stiffness"])
    else:
        suspension = Strings(
            2 if kind == "bifilar" else 3, x["radius_above"], x["radius"], x["length"], up,
            x["gravity"],
        )  # fmt: skip
    return period(body, suspension, x["amplitude"]) ** 2 - x["period"] ** 2


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
