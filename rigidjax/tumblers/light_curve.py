"""Fit a tumbling body to its light curve alone, and list all motions that explain the light
curve.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks, exact
from rigidjax._types import Scalar
from rigidjax.body.inertia import Inertia, tensor_of
from rigidjax.identify.answer import answers
from rigidjax.identify.answer.answers import FAILS, FOUND, LEAVES, NOT_ALONE, NOT_ENDED, Answer
from rigidjax.identify.answer.fit import fit
from rigidjax.identify.answer.result import Fit
from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Reading
from rigidjax.identify.model.model import Model, require_single
from rigidjax.identify.uncertainty import covariance as uncertainty
from rigidjax.identify.uncertainty.quantities import (
    quantities_on_host,
    reported_quantities,
    standard_deviations,
)
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, dot
from rigidjax.tumblers.search import (
    MAGNITUDE,
    fluxes_of,
    noise_of,
    search_starts,
    starts_of_pairs,
)
from rigidjax.tumblers.sensor import Brightness, bisector_at
from rigidjax.tumblers.two_frequencies import TwoFrequencies, two_frequencies

# Two motions count as the same if their rotation periods, precession periods and two ratios of
# moments have relative differences below the four numbers of SAME, or below REACH standard
# deviations.
SAME, REACH = np.array([1e-3, 1e-3, 0.05, 0.05]), 5.0
# A second motion explains the data nearly as well as the best motion if its log-likelihood is lower
# by less than this number.
MARGIN = 10.0
# The brightness of a real body differs from that of an ellipsoid by this relative standard
# deviation.
SHAPE = 0.04
# A χ² is rejected if it is above its mean by this number of standard deviations. `fit` accepts five
# standard deviations, but the errors of a wrong motion of a light curve may be hardly larger than
# the noise.
CONTENT = 3.0
# At least LEAST pairs of frequencies are tried. Further pairs are tried only if their χ² exceeds
# that of the best pair by less than ABOVE.
LEAST, ABOVE = 12, 40.0


class Alias(eqx.Module):
    """Hold a motion that a search found.

    **Fields:**

    - `x`: (n,) the parameters.
    - `cost`: half of χ², the sum over the readings of the squares of error divided by noise.
    - `rotation`: the body period, s (`rigidjax.exact.body_period`).
    - `precession`: the mean precession period, s (`rigidjax.exact.precession_period`).
    - `mode`: `"long"` or `"short"`, for a momentum that circulates in the body about the axis of
      the smallest or of the largest moment.
    - `ratios`: (2,) the two smaller moments of inertia divided by the largest.
    - `explains`: whether this motion explains the data nearly as well as the best motion.
    """

    x: Float[Array, " n"]
    cost: float
    rotation: float
    precession: float
    mode: str
    ratios: np.ndarray
    explains: bool

    def __str__(self) -> str:
        return (
            f"{self.mode}-axis mode, rotation {self.rotation:.6g} s, precession "
            f"{self.precession:.6g} s, moments {self.ratios[0]:.3f} : {self.ratios[1]:.3f} : 1, "
            f"cost {self.cost:.6g}"
        )


class LightCurve(eqx.Module):
    """Hold the result of `fit_light_curve`: the fit of the best motion, and all other motions.

    **Fields:**

    - `fit`: the fit of the best motion; its covariance allows for a body that is not an ellipsoid.
    - `aliases`: all motions that were found, in the order of their costs.
    - `deviations`: (4,) the relative standard deviations of four numbers of the best motion: the
      rotation period, the precession period and the two ratios of moments.
    - `pairs`: the pairs of frequencies that `two_frequencies` found.
    - `search`: the answer whether the search found the best motion, in the words of the field
      `search` of a `Fit`. Here the answer is "not alone" also if another of the `aliases` explains
      the data nearly as well.
    - `explanation`: the answer whether the model explains the readings, in the words of the field
      `explanation` of a `Fit`. Here the answer is "leaves a part" also if χ² is three standard
      deviations above its mean for the given noise.
    """

    fit: Fit
    aliases: tuple[Alias, ...]
    deviations: Float[np.ndarray, "4"]
    pairs: TwoFrequencies
    search: Answer
    explanation: Answer

    @property
    def status(self) -> str:
        """Return one line of text with the answers `search` and `explanation` of this result; the
        line is "ok" if both answers are good and give no reason.
        """
        return answers.joined_status(self.search, self.explanation)

    @property
    def ok(self) -> bool:
        """Return whether the `status` of this result is "ok", so that no other motion explains the
        data nearly as well as the best motion.
        """
        return self.status == "ok"

    @property
    def rivals(self) -> tuple[Alias, ...]:
        """Return the motions, other than the best, that explain the data nearly as well as the
        best.
        """
        return tuple(alias for alias in self.aliases[1:] if alias.explains)

    def __str__(self) -> str:
        aliases = (f"{'*' if alias.explains else ' '} {alias}" for alias in self.aliases)
        return "\n".join([self.status, *aliases])


def fit_light_curve(
    model: Model,
    *,
    shortest: float | None = None,
    count: int = 48,
    tolerance: float = 1e-4,
    progress: Callable[[str], Any] | None = None,
) -> LightCurve:
    """Fit the motion of a free tumbler to one light curve, without an initial guess.

    `two_frequencies` finds pairs of frequencies in the squared flux. Each pair is taken as the
    frequency of precession and twice the frequency of rotation, in the long-axis and in the
    short-axis mode (Kaasalainen 2001), over a grid of bodies and phases. In these modes the angular
    momentum circulates in the body about the axis of the smallest or of the largest moment. A fit
    with the full model of the sensor takes a few steps from each of the best starts. The best
    results are then continued to convergence. The result lists all motions that were found. The
    brightness has symmetries: half turns of the world (see `Brightness`), and half turns of the
    body about its axes. Motions that differ by such a half turn have the same periods, moments and
    mode, and count as one motion.

    The intervals allow for a shape that is not an ellipsoid by consider parameters (Tapley, Schutz
    and Born 2004, Statistical Orbit Determination, ch. 6). The brightness is multiplied by 1 + n·S
    n, where n (3,) is the unit vector half way between sun and observer in the body frame. The
    entries of the matrix S (3, 3) are independent random numbers with a standard deviation of 0.04.

    **Arguments:**

    - `model`: a model of one recording with one `Brightness` sensor and no torque; make the `level`
      of the sensor a `Free` unless the level is known. The search for a start takes fluxes below a
      thousandth of their median as that thousandth, and a noise that is `None` from the scatter
      about the best Fourier series; a flux that is negative by more than ten times the noise (with
      `None`: ten standard deviations of all fluxes) is refused by `Recording`.
    - `shortest`: the shortest period of a line in the spectrum, s; `None` for four times the median
      interval between the samples.
    - `count`: the largest number of pairs of frequencies. If more pairs fit, the answer `search` of
      the result is "not ended".
    - `tolerance`: as for `rigidjax.identify.fit`.
    - `progress`: a function such as `print`, called with lines of text.

    Sources: Pravec et al. 2005, Icarus 173:108, doi:10.1016/j.icarus.2004.07.021; Kaasalainen 2001,
    A&A 376:302, doi:10.1051/0004-6361:20010935. **Raises:** `ValueError` for a model with other
    sensors, several recordings or a torque; `TypeError` under a trace.
    """
    reading = _require_one_brightness(model)
    _checks.integer(count, "count", 1)
    _checks.positive_float(tolerance, "tolerance")
    say = lambda line: None  # noqa: E731
    if progress is not None:
        say = _checks.require_function(progress, "progress", "of a line of text, such as print")
    t, flux, noise = fluxes_of(model, reading)
    squares, sigma = flux**2, None if noise is None else 2.0 * flux * noise
    pairs = two_frequencies(t, squares, sigma, shortest=shortest, count=count)
    above = ABOVE * max(1.0, float(pairs.misfits[0]) / pairs.dof)
    used = max(LEAST, int((pairs.misfits <= pairs.misfits[0] + above).sum()))
    starts = starts_of_pairs(model, reading, t, squares, sigma, pairs.frequencies[:used])
    say(f"{used} pairs of frequencies, χ² {pairs.misfits[0]:.6g} of {pairs.dof}")
    say(f"{len(starts)} starts")
    whole = stacking.pad_to_few(model)
    ends = search_starts(whole, starts, noise_of(reading, flux, pairs.scatter), tolerance)
    # The different motions at the ends of the searches, the smallest cost first.
    aliases: list[Alias] = []
    for end in sorted(ends, key=lambda one: float(one.cost)):
        if np.isfinite(float(end.cost)):
            alias = _alias(whole, end.x, float(end.cost))
            if not any(_same_motion(alias, other, SAME) for other in aliases):
                aliases.append(alias)
    if not aliases:
        raise ValueError(
            "fit_light_curve: wanted a start with a finite cost, got none; are the readings in "
            "the unit of the sensor?"
        )
    say(f"{len(aliases)} motions, cost {aliases[0].cost:.6g}")
    best = fit(whole, starts=1, initial=aliases[0].x, tolerance=tolerance)
    result = _result(best, aliases, pairs, used >= count)
    # The result has the readings without the padding that the search added.
    own = eqx.tree_at(lambda m: m.slots, model, best.model.slots)
    linear = best.linear and best.linear.first_times(model.records.t.shape[1])
    return eqx.tree_at(lambda one: (one.fit.point.model, one.fit.linear), result, (own, linear))


def _require_one_brightness(model: Model) -> Reading:
    """Return the readings of the only sensor of a single recording, a `Brightness`."""
    require_single(model)
    if not _checks.is_known(model):
        words = "got traced ones; call it outside of jax.jit, jax.grad and jax.vmap"
        raise TypeError(f"model: wanted known numbers, {words}")
    readings = model.records.readings
    kinds = ", ".join(type(r.sensor).__name__ for r in readings)
    if len(readings) != 1 or not isinstance(readings[0].sensor, Brightness):
        raise ValueError(f"fit_light_curve: wanted one Brightness sensor, got {kinds}")
    if model.count != 1:
        raise ValueError(
            f"fit_light_curve: wanted one recording, got {model.count}; fit the longest alone, "
            "then all of them with rigidjax.identify.fit, starting from the result"
        )
    if model.body_indices is not None:
        raise ValueError("fit_light_curve: wanted one body, got several by name")
    if model.torque is not None:
        raise ValueError("fit_light_curve: wanted a free body, got a model with a torque")
    return stacking.pick(readings[0], 0)


class Nature(NamedTuple):
    """Hold numbers that differ between free motions: periods, moment ratios and energy."""

    logarithms: Float[Array, "4"]  # of both periods, s, and of the ratios of `Alias`
    energy: Scalar  # h²/2T over the middle moment, below 1 in the long-axis mode


@eqx.filter_jit
def _nature(x: Float[Array, " n"], model: Model) -> Nature:
    """Return the `Nature` of the motion with the parameters x."""
    body: Any = model.bodies(x)
    inertia = Inertia(tensor_of(body))
    omega = x[model.index.start[0, -3:]] * model.reference.rate[0]
    moments, momentum = inertia.moments, apply(inertia.tensor, omega)
    both = exact.body_period(inertia, omega), exact.precession_period(inertia, omega)
    numbers = jnp.log(jnp.concatenate([jnp.stack(both), moments[:2] / moments[2]]))
    return Nature(numbers, dot(momentum, momentum) / dot(omega, momentum) / moments[1])


@eqx.filter_jit
def _slopes(x: Float[Array, " n"], model: Model) -> Float[Array, "4 n"]:
    """Return the derivatives of the logarithms in a `Nature` by the parameters."""
    return jax.jacfwd(lambda x: _nature(x, model)[0])(x)


def _alias(model: Model, x: Array, cost: float) -> Alias:
    """Return the motion with the parameters x as an `Alias`."""
    numbers, middle = (np.asarray(v) for v in _nature(x, model))
    rotation, precession, *ratios = np.exp(numbers)
    mode = "long" if middle < 1 else "short"
    motion = float(rotation), float(precession), mode, np.array(ratios)
    return Alias(x, cost, *motion, explains=False)


def _same_motion(a: Alias, b: Alias, tolerance: np.ndarray) -> bool:
    """Return whether two motions have the same mode, and logarithms of the periods and ratios that
    differ by less than `tolerance` (4,).
    """
    one, other = (np.log([m.rotation, m.precession, *m.ratios]) for m in (a, b))
    return a.mode == b.mode and bool((np.abs(one - other) < tolerance).all())


@eqx.filter_jit
def _bisectors(x: Float[Array, " n"], model: Model) -> Float[Array, "times 3"]:
    """Return the unit vectors half way between sun and observer at the times of the readings, in
    the axes of the moving body.
    """
    point = model.unpack(x)
    body, state0 = point.body, point.state0
    motion, t = exact.FreeBody(Inertia(tensor_of(body)), state0), model.records.t[0]
    sensor = stacking.pick(model.records.readings[0], 0).sensor

    def in_body(now: Array) -> Array:
        state: Any = motion(now - t[0])
        return quaternion.rotate_inverse(state.q, bisector_at(sensor, now))

    return jax.vmap(in_body)(t)


def _widened_fit(best: Fit) -> Fit:
    """Return the fit of a light curve with a larger covariance, which allows for a body that is not
    an ellipsoid (see `fit_light_curve`), and wider intervals.
    """
    linear: Any = best.linear
    reading, weight = stacking.pick(best.model.records.readings[0], 0), linear.weights[0][0]
    flux = np.asarray(reading.values) - linear.raw[0][0, :, 0]
    size = np.full(weight.shape, 1.0 / MAGNITUDE) if reading.sensor.unit == "mag" else flux
    n = np.asarray(_bisectors(best.x, best.model))
    change = SHAPE / float(best.noises[0][0, 0]) * size[:, None, None] * n[:, :, None] * n[:, None]
    slopes = linear.slopes[0][0, :, 0] * weight[:, None]
    kept = weight > 0
    white = uncertainty.white_covariance(linear).covariance
    shift = white @ slopes[kept].T @ change[kept].reshape(-1, 9)
    covariance, seen = (
        np.asarray(c) + shift @ shift.T for c in (best.covariance, best.determined_covariance)
    )
    null = np.asarray(best.null_directions)
    numbers = quantities_on_host(best.model, best.x, best.point.near)
    freedom = best.uncertainty.degrees_of_freedom(numbers[1])
    uncertain = dataclasses.replace(
        best.uncertainty,
        covariance=jnp.asarray(covariance),
        determined=jnp.asarray(seen),
        kind=f"sandwich: a shape {SHAPE:.0%} off the ellipsoid; {best.covariance_kind}",
    )
    reported = reported_quantities(
        best.model, numbers, seen, null, best.uncertainty.limits, freedom
    )
    return dataclasses.replace(best, uncertainty=uncertain, quantities=reported)


def _result(
    best: Fit, aliases: list[Alias], pairs: TwoFrequencies, is_incomplete: bool
) -> LightCurve:
    """Return the result that holds the fit of the best motion, and all motions, the best first;
    more pairs of frequencies may fit if `is_incomplete`.
    """
    slopes = np.asarray(_slopes(best.point.derivative_point, best.model))
    wider = _widened_fit(best)
    own, deviations = (
        standard_deviations(
            slopes, np.asarray(one.determined_covariance), np.asarray(one.null_directions)
        )
        for one in (best, wider)
    )
    # A motion nearer than `near` to the best motion is the result of a search that stopped on its
    # way to the best motion: it does not count as another motion.
    near = np.fmax(SAME, REACH * own)
    # The best motion keeps the cost that the search gave it, since the costs of the search all
    # belong to the same noise; the fit may have estimated another noise.
    first = _alias(best.model, best.x, aliases[0].cost)
    others = [alias for alias in aliases if not _same_motion(alias, first, near)]
    # A motion whose cost exceeds that of the best motion by less than a margin explains the data
    # nearly as well. The margin is wider if the errors of the best motion are larger than the
    # noise, or autocorrelated.
    count = int(best.model.records.readings[0].host_mask.sum())
    margin = MARGIN * max(1.0, 2.0 * first.cost / count) * max(best.correlation, 1.0)
    marked = tuple(
        eqx.tree_at(lambda a: a.explains, alias, alias.cost <= first.cost + margin)
        for alias in (first, *others)
    )
    rivals = sum(alias.explains for alias in marked) - 1
    search, explanation = best.search, best.explanation
    if rivals and search.word != NOT_ENDED and explanation.word != FAILS:
        who = "another motion explains" if rivals == 1 else f"{rivals} other motions explain"
        search = Answer(NOT_ALONE, (f"{who} the light curve nearly as well",))
    elif is_incomplete and best.ok:
        search = Answer(NOT_ENDED, ("more pairs of frequencies fit than were tried",))
    # χ² is not tested under a robust loss, since outliers dominate χ².
    above = best.chi2 - best.dof if best.model.loss is None else 0.0
    if search == Answer(FOUND) and best.ok and above > CONTENT * np.sqrt(2.0 * best.dof):
        why = "another motion that was not found, or more noise than given"
        explanation = Answer(LEAVES, (f"χ² is {best.chi2:.6g} of {best.dof}: {why}",))
    return LightCurve(wider, marked, deviations, pairs, search, explanation)
