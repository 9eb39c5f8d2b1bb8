"""The numbers that a fit determines, and those that it does not, in words."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from rigidjax.identify.answers import FAILS, NOT_ENDED
from rigidjax.identify.full_scale import in_words
from rigidjax.identify.quantities import (
    Quantity,
    charts,
    covariance as reported_covariance,
    quantile,
)
from rigidjax.identify.sensors import Gyro
from rigidjax.identify.several_bodies import Bodies, tensor_of
from rigidjax.identify.undetermined import SEVERAL, undetermined

if TYPE_CHECKING:
    from rigidjax.identify.result import Fit


def identifiability(fit: "Fit") -> tuple[str, ...]:
    """The quantities that the data determine well, weakly, and not at all.

    Nothing is called determined if the fit does not explain the data, or did not end.
    """
    lost = fit.model.word == FAILS
    if lost or fit.search.word == NOT_ENDED:
        why = "does not explain the data" if lost else "did not end in a minimum"
        out = [
            f"This fit {why}, so it determines nothing: its numbers and intervals belong to the "
            "best point found, and say nothing about the body."
        ]
        # A search that did not end may have moved along directions that the data do not determine.
        out += [] if lost else _unseen(fit)
        return (*out, *in_words(fit.problem.records.readings))
    reach = quantile(fit, 0.95)
    out = []
    for quantity in _moments(fit):
        wide = reach * quantity.deviation
        # Half-width over value for a narrow interval; a factor for a wide one.
        if not np.isfinite(wide) or wide > 1.5:
            out.append(f"{quantity.name} is not determined by these data.")
        elif wide > 0.05:
            out.append(
                f"{quantity.name} is weakly determined: its 95 % interval is "
                f"{2 * np.sinh(wide):.0%} of its value."
            )
        else:
            out.append(f"{quantity.name} is well determined, to ±{wide:.2g} of its value.")
    out += _flat(fit, reach)
    out.append(_rate(fit, reach))
    out += _unseen(fit)
    out += correlations(fit)
    if fit.problem.torque is None:
        out.append(
            "Free motion cannot show the absolute inertia, only ratios of moments; nor the mass or "
            "the centre of mass."
        )
        if all(isinstance(sensor, Gyro) for sensor in fit.problem.records.sensors):
            out.append(
                "Rates of free motion with an axis mirrored or two axes swapped fit another body "
                "as well: they cannot show such a mistake."
            )
    out += in_words(fit.problem.records.readings)
    return tuple(out)


def _moments(fit: "Fit") -> list[Quantity]:
    """The positive quantities of the bodies."""
    out, first = [], 0
    for _, chart in charts(fit.problem):
        out += fit.quantities[first : first + len(chart.log_names)]
        first += len(chart.log_names) + len(chart.plain_names)
    return out


def _flat(fit: "Fit", reach: float) -> list[str]:
    """Remarks on bodies that may be flat."""
    covariance = np.asarray(fit.seen)
    return [
        f"A flat body{limit.where} fits as well: (I1 + I2 − I3)/I3 ≤ "
        f"{limit.bound(covariance):.2g} (95 %). Intervals end at the limit of real bodies."
        for limit in fit.limits
        if limit.is_near(covariance, reach)
    ]


def _rate(fit: "Fit", reach: float) -> str:
    first = sum(len(c.log_names) + len(c.plain_names) for _, c in charts(fit.problem))
    rates = fit.quantities[first : first + 3 * fit.problem.count]
    shares = []
    for index in range(fit.problem.count):
        three = rates[3 * index : 3 * index + 3]
        length = np.linalg.norm([q.value for q in three])
        shares.append(reach * np.max([q.deviation for q in three]) / max(length, 1e-300))
    wide = np.max(shares)
    what = "The initial body rate is" if fit.problem.count == 1 else "The initial body rates are"
    if not wide < 1.0:
        return f"{what} not determined by these data."
    grade = "well" if wide < 0.1 else "weakly"
    its = "its length" if fit.problem.count == 1 else "their lengths"
    return f"{what} {grade} determined, to ±{wide:.2g} of {its}."


def _unseen(fit: "Fit") -> list[str]:
    found = undetermined(fit)
    if not found:
        return []
    out = []
    if scale_is_unseen(fit):
        out.append("The data determine the inertia only up to scale.")
    out += [one.in_words for one in found[:SEVERAL]]
    if len(found) > SEVERAL:
        out.append(f"{len(found) - SEVERAL} more combinations of numbers are not determined.")
    out.append("Intervals of quantities that depend on these are infinite.")
    return out


def scale_is_unseen(fit: "Fit") -> bool:
    """Whether an undetermined direction scales the whole body and changes nothing else."""
    flat, restore = ravel_pytree(fit.beside)
    null = np.asarray(fit.null_directions)
    if not len(null) or isinstance(fit.problem.body, Bodies):
        return False

    def tensor(x: jax.Array) -> jax.Array:
        return tensor_of(fit.problem.bodies(restore(x))).reshape(-1)

    here = np.asarray(tensor(flat))
    slopes = np.stack([np.asarray(jax.jvp(tensor, (flat,), (jnp.asarray(v),))[1]) for v in null])
    wanted, *_ = np.linalg.lstsq(slopes.T, here, rcond=None)
    left = np.linalg.norm(slopes.T @ wanted - here) / np.linalg.norm(here)
    return bool(left < 1e-3)


def correlations(fit: "Fit") -> list[str]:
    """Pairs of reported quantities whose errors are correlated (|ρ| > 0.95).

    An inertia tensor enters by its principal moments, not by its components.
    """
    covariance = reported_covariance(fit)
    deviation = np.array([quantity.deviation for quantity in fit.quantities])
    good = np.isfinite(deviation) & (deviation > 0)
    follow = {f"{plain}{name}" for name, c in charts(fit.problem) for plain in c.plain_names}
    names = [quantity.name for quantity in fit.quantities]
    good &= np.array([name not in follow or name.startswith("com") for name in names])
    scaled = np.where(good, deviation, 1.0)
    rho = np.where(np.outer(good, good), covariance / np.outer(scaled, scaled), 0.0)
    pairs = [
        (i, j)
        for i in range(len(rho))
        for j in range(i)
        if np.isfinite(rho[i, j]) and abs(rho[i, j]) > 0.95
    ]
    pairs.sort(key=lambda pair: -abs(rho[pair]))
    return [
        f"{names[j]} and {names[i]} are strongly correlated (ρ = {rho[i, j]:+.3f})."
        for i, j in pairs[:5]
    ]
