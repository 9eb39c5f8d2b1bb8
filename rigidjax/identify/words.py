"""What a fit found, in words."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from rigidjax.body.inertia import MassProperties
from rigidjax.identify.full_scale import in_words
from rigidjax.identify.reported import Quantity, charts, quantile, recording_names
from rigidjax.identify.several import Bodies

if TYPE_CHECKING:
    from rigidjax.identify.fit import Fit


def identifiability(fit: "Fit") -> tuple[str, ...]:
    """What the data fix, what they fix weakly, what they cannot see."""
    reach = quantile(fit, 0.95)
    out = []
    for quantity in _moments(fit):
        wide = reach * quantity.deviation
        # Half-width over value where narrow; a factor where wide.
        if not np.isfinite(wide) or wide > 1.5:
            out.append(f"{quantity.name} is not determined by these data.")
        elif wide > 0.05:
            out.append(
                f"{quantity.name} is weakly determined: its 95 % interval is "
                f"{2 * np.sinh(wide):.0%} of its value."
            )
        else:
            out.append(f"{quantity.name} is well determined, to ±{wide:.2g} of its value.")
    out.append(_rate(fit, reach))
    out += _unseen(fit)
    out += correlations(fit)
    if fit.problem.torque is None:
        out.append(
            "Free motion cannot show the absolute inertia: only ratios; mass and centre of mass "
            "leave no trace at all."
        )
    out += in_words(fit.problem.records.readings)
    if fit.correlation > 1.5:
        out.append(
            f"The errors are autocorrelated over {fit.correlation:.0f} samples, so something is "
            "missing in the model or the data were filtered; the intervals allow for it."
        )
    return tuple(out)


def _moments(fit: "Fit") -> list[Quantity]:
    """The positive quantities of the bodies."""
    out, first = [], 0
    for _, chart in charts(fit.problem):
        out += fit.quantities[first : first + len(chart.log_names)]
        first += len(chart.log_names) + len(chart.plain_names)
    return out


def _rate(fit: "Fit", reach: float) -> str:
    first = sum(len(c.log_names) + len(c.plain_names) for _, c in charts(fit.problem))
    rates = fit.quantities[first : first + 3 * fit.problem.count]
    shares = []
    for index in range(fit.problem.count):
        three = rates[3 * index : 3 * index + 3]
        length = np.linalg.norm([q.value for q in three])
        shares.append(reach * max(q.deviation for q in three) / length)
    grade = "well" if max(shares) < 0.1 else "weakly"
    what = "The first body rate is" if fit.problem.count == 1 else "The first body rates are"
    its = "its length" if fit.problem.count == 1 else "their lengths"
    return f"{what} {grade} determined, to ±{max(shares):.2g} of {its}."


def _unseen(fit: "Fit") -> list[str]:
    count = fit.null_directions.shape[0]
    if not count:
        return []
    out = []
    if scale_is_unseen(fit):
        out.append("The data fix the inertia only up to scale: its size leaves no trace.")
    one = count == 1
    out.append(
        f"{count} combination{'' if one else 's'} of the free numbers leave{'s' if one else ''} no "
        "trace in these data; intervals that depend on "
        f"{'it' if one else 'them'} are infinite."
    )
    return out


def scale_is_unseen(fit: "Fit") -> bool:
    """Whether some unseen direction is the body grown as a whole, all else at rest."""
    flat, restore = ravel_pytree(fit.parameters)
    null = np.asarray(fit.null_directions)
    if not len(null):
        return False

    if isinstance(fit.problem.body, Bodies):
        return False

    def tensor(x: jax.Array) -> jax.Array:
        body = fit.problem.bodies(restore(x))
        inertia = body.inertia if isinstance(body, MassProperties) else body
        return inertia.tensor.reshape(-1)

    here = np.asarray(tensor(flat))
    slopes = np.stack([np.asarray(jax.jvp(tensor, (flat,), (jnp.asarray(v),))[1]) for v in null])
    wanted, *_ = np.linalg.lstsq(slopes.T, here, rcond=None)
    left = np.linalg.norm(slopes.T @ wanted - here) / np.linalg.norm(here)
    return bool(left < 1e-3)


def correlations(fit: "Fit") -> list[str]:
    """Pairs of free numbers whose errors go together (|ρ| > 0.95)."""
    covariance = np.asarray(fit.covariance)
    deviation = np.sqrt(np.diag(covariance))
    good = np.isfinite(deviation) & (deviation > 0)
    scaled = np.where(good, deviation, 1.0)
    rho = np.where(np.outer(good, good), covariance / np.outer(scaled, scaled), 0.0)
    names = names_of(fit)
    pairs = [
        (i, j)
        for i in range(len(rho))
        for j in range(i)
        if np.isfinite(rho[i, j]) and abs(rho[i, j]) > 0.95
    ]
    pairs.sort(key=lambda pair: -abs(rho[pair]))
    return [
        f"{names[j]} and {names[i]} go together (correlation {rho[i, j]:+.3f})."
        for i, j in pairs[:5]
    ]


def names_of(fit: "Fit") -> list[str]:
    """A name for each free number, in the order of the flattened parameters."""
    problem, own = fit.problem, fit.parameters.own
    out = []
    for name, chart in charts(problem):
        out += [f"body{name}[{i}]" for i in range(chart.size)]
    shared, each = [], []
    names = recording_names(problem)
    for slot in problem.slots:
        shape = np.shape(slot.read(problem.records))[1:]
        parts = [f"[{i}]" for i in range(int(np.prod(shape)))] if shape else [""]
        if not slot.each:
            groups = [f" [{label}]" for label in slot.labels] or [""]
            shared += [f"{slot.name}{where}{part}" for where in groups for part in parts]
        if slot.each or slot.spread is not None:
            kind = slot.name if slot.each else f"{slot.name}, own"
            each += [f"{kind}{where}{part}" for where in names for part in parts]
    out += shared
    for name in ("spin", "turn", "place", "speed"):
        leaf = getattr(own, name)
        if leaf is not None:
            out += [f"{name}[{i}]" for i in range(leaf.size)]
    return out + each
