"""How sure a fit is: covariance, also where the errors are not white, and what the data miss."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rigidjax.identify.problem import Parameters, Problem, along
from rigidjax.identify.residual import Noise, beside, weights_of, whitened
from rigidjax.identify.search import evaluate

# A direction whose singular value is below this share of the largest is not seen at all.
BLIND = 1e-8


class Linearised(eqx.Module):
    """A problem about its best point: whitened errors, their derivatives, their weights.

    **Fields:** for each sensor `errors` (R, T, k), `slopes` (R, T, k, n), `weights` (R, T); `extra`
    (m,) and `extra_slopes` (m, n) of priors and joints.
    """

    errors: tuple[np.ndarray, ...]
    slopes: tuple[np.ndarray, ...]
    weights: tuple[np.ndarray, ...]
    extra: np.ndarray
    extra_slopes: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """The Jacobian (N, n), each row times the root of its weight."""
        n = self.extra_slopes.shape[-1]
        parts = [
            (slope * np.sqrt(weight)[..., None, None]).reshape(-1, n)
            for slope, weight in zip(self.slopes, self.weights, strict=True)
        ]
        return np.concatenate([*parts, self.extra_slopes])

    @property
    def scores(self) -> np.ndarray:
        """What each time adds to the gradient of the misfit, (R, T, n)."""
        parts = [
            np.einsum("rtk,rtkn,rt->rtn", error, slope, weight)
            for error, slope, weight in zip(self.errors, self.slopes, self.weights, strict=True)
        ]
        return np.sum(parts, axis=0)


@eqx.filter_jit
def _linearised(problem: Problem, parameters: Parameters, noise: Noise, found: Any) -> Any:
    (errors, ends), blocks = found
    flat, restore = ravel_pytree(parameters)

    @jax.custom_jvp
    def all_errors(here: Parameters) -> Any:
        return errors, ends

    @all_errors.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        return (errors, ends), along(problem, blocks, tangents[0])

    def value(vector: Array) -> Any:
        here = restore(vector)
        errors, ends = all_errors(here)
        extra = [leaf.reshape(-1) for leaf in beside(here, problem, ends)]
        joined = jnp.concatenate(extra) if extra else jnp.zeros(0, vector.dtype)
        out = (whitened(problem, errors, noise), joined)
        return out, (out, weights_of(problem, errors, noise))

    slopes, (out, weights) = jax.jacfwd(value, has_aux=True)(flat)
    return out, slopes, weights


def errors_at(parameters: Parameters, problem: Problem) -> tuple[Float[Array, "..."], ...]:
    """The errors (R, T, k) of each sensor, by the program that `linearise` runs too."""
    return evaluate(parameters, problem)[0][0]


def linearise(problem: Problem, parameters: Parameters, noise: Noise) -> Linearised:
    """Errors, derivatives and weights at these parameters, as NumPy arrays."""
    found = evaluate(parameters, problem)
    (errors, extra), (slopes, extra_slopes), weights = jax.tree.map(
        np.asarray, _linearised(problem, parameters, noise, found)
    )
    return Linearised(errors, slopes, weights, extra, extra_slopes)


class Spread(eqx.Module):
    """Covariance of the parameters and what it rests on.

    **Fields:** `covariance` (n, n); `kind` in words; `singular_values` (n,) of the weighted
    Jacobian; `null_directions` (k, n) that leave no trace in the data.
    """

    covariance: np.ndarray
    kind: str
    singular_values: np.ndarray
    null_directions: np.ndarray


def spread(linear: Linearised, correlation: float) -> Spread:
    """`(JᵀWJ)⁻¹` where the errors are white, else the sandwich `H⁻¹ M H⁻¹`.

    M adds up products of scores up to some correlation times apart, with Bartlett's weights, so
    that errors which hang together in time count as the fewer they are.

    **Arguments:** `linear`; `correlation` how many samples the errors hang together, 1 for white.

    Source: White 1980, doi:10.2307/1912934; Newey and West 1987, doi:10.2307/1913610.

    A direction whose singular value is below 1e-8 of the largest has infinite variance, not a
    made-up one.
    """
    rows = linear.rows
    n = rows.shape[1]
    if not np.isfinite(rows).all():
        nothing = np.full((n, n), np.nan)
        return Spread(
            nothing, "none: the motion is not finite", np.full(n, np.nan), np.zeros((0, n))
        )
    # Columns of order one: a bias in rad/s must not look blind beside a moment.
    size = np.sqrt(np.sum(rows**2, axis=0))
    size = np.where(size > 0, size, 1.0)
    _, singular, directions = np.linalg.svd(rows / size, full_matrices=False)
    seen = singular > BLIND * max(singular.max(), 1e-300)
    inverse = np.where(seen, 1.0 / np.where(seen, singular, 1.0), 0.0)
    half = directions.T * inverse
    covariance = (half @ half.T) / np.outer(size, size)
    kind = "Gauss–Newton"
    if correlation > 1.5:
        covariance = _sandwich(linear.scores, covariance, correlation)
        kind = f"sandwich: the errors hang together over {correlation:.0f} samples"
    null = directions[~seen] * size if not seen.all() else np.zeros((0, n))
    if len(null):
        null = directions[~seen] / size
        null = null / np.linalg.norm(null, axis=1, keepdims=True)
        blind = np.abs(null).max(axis=0) > 1e-6
        covariance[blind, blind] = np.inf
    return Spread(covariance, kind, singular, null)


def _sandwich(scores: np.ndarray, bread: np.ndarray, correlation: float) -> np.ndarray:
    records, times, n = scores.shape
    reach = int(min(max(2, np.ceil(2.0 * correlation)), times - 1))
    meat = np.einsum("rti,rtj->ij", scores, scores)
    for lag in range(1, reach + 1):
        product = np.einsum("rti,rtj->ij", scores[:, lag:], scores[:, :-lag])
        meat += (1.0 - lag / (reach + 1.0)) * (product + product.T)
    if records > n // 2 and records > 5:
        # Many recordings: what differs between them shows without any model of their errors.
        total = scores.sum(axis=1)
        apart = total.T @ total * records / (records - 1)
        meat = np.where(np.trace(bread @ apart) > np.trace(bread @ meat), apart, meat)
    count = records * times
    finite = np.where(np.isfinite(bread), bread, 0.0)
    out = finite @ meat @ finite * count / max(count - n, 1)
    # Never narrower than white errors would have it.
    below = np.diag(out) < np.diag(finite)
    factor = np.sqrt(np.where(below, np.diag(finite) / np.maximum(np.diag(out), 1e-300), 1.0))
    return out * np.outer(factor, factor)


def correlation_time(linear: Linearised) -> tuple[float, float]:
    """How many samples the errors hang together, and their correlation from one to the next.

    The integrated autocorrelation time `1 + 2 Σ ρ_l`, summed up to the first lag at which ρ falls
    below twice its own scatter, the longest over all channels.
    """
    longest, closest = 1.0, 0.0
    for error, weight in zip(linear.errors, linear.weights, strict=True):
        kept = error * np.sqrt(weight)[..., None]
        for channel in range(error.shape[-1]):
            time, first = _channel_time(kept[..., channel], weight > 0)
            if time > longest:
                longest, closest = time, first
    return longest, closest


def _channel_time(e: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    counts = seen.sum(axis=1, keepdims=True)
    mean = e.sum(axis=1, keepdims=True) / np.maximum(counts, 1)
    centred = np.where(seen, e - mean, 0.0)
    variance = np.sum(centred**2)
    if not variance > 0:
        return 1.0, 0.0
    total, first = 1.0, 0.0
    noise = 2.0 / np.sqrt(max(seen.sum(), 1))
    for lag in range(1, max(2, e.shape[1] // 3)):
        # Each lag has fewer pairs than there are squares.
        pairs = np.sum(seen[:, lag:] & seen[:, :-lag])
        if pairs < 10:
            break
        rho = np.sum(centred[:, lag:] * centred[:, :-lag]) / variance * seen.sum() / pairs
        if lag == 1:
            first = rho
        if rho < noise:
            break
        total += 2.0 * rho
    return float(total), float(first)


def estimate_noise(problem: Problem, errors: tuple, noise: Noise, parameters: Parameters) -> Noise:
    """Noise (R, k) of each sensor: as given, or the weighted scatter of its errors.

    One figure for all channels and recordings of a sensor. The number of free parameters is taken
    off the number of errors.
    """
    free = ravel_pytree(parameters)[0].size
    total = sum(int(r.seen.sum()) * r.sensor.components for r in problem.records.readings)
    weights = weights_of(problem, errors, noise)
    out = []
    for reading, error, sigma, weight in zip(
        problem.records.readings, errors, noise, weights, strict=True
    ):
        if reading.sensor.noise is not None:
            out.append(sigma)
            continue
        squares = float(np.sum(np.asarray(weight)[..., None] * np.asarray(error) ** 2))
        share = max(1.0 - free / total, 0.1)
        variance = squares / (reading.sensor.components * reading.seen.sum() * share)
        # Data without noise must not divide by zero: round-off is the least that is believed.
        floor = 1e-15 * float(jnp.abs(reading.values).max() + 1e-300)
        out.append(jnp.full_like(sigma, max(float(np.sqrt(variance)), floor)))
    return tuple(out)


def goodness(
    problem: Problem, errors: tuple, linear: Linearised, free: int, closeness: float
) -> tuple[float, int, bool]:
    """χ² of the sensors with a given noise, its degrees of freedom, and whether to believe the fit.

    Believed where χ² is within five standard deviations of its mean and, for a sensor whose noise
    was estimated, where the motion explains at least half of the variance of its readings and what
    is left over in one piece (`closeness`, the correlation from one sample to the next, of it) is
    less than a tenth.
    """
    chi2, count, believable = 0.0, 0, True
    for reading, error, e, weight in zip(
        problem.records.readings, errors, linear.errors, linear.weights, strict=True
    ):
        seen = reading.seen
        if reading.sensor.noise is None:
            values = np.asarray(reading.values)[seen]
            spread_of_values = np.sum((values - values.mean(axis=0)) ** 2)
            left = np.sum(np.asarray(error)[seen] ** 2)
            tiny = 1e-12 * np.sum(values**2)
            believable &= bool(left <= 0.5 * spread_of_values + tiny)
            believable &= bool(max(closeness, 0.0) * left <= 0.1 * spread_of_values + tiny)
        else:
            chi2 += float(np.sum(weight[..., None] * e**2))
            count += reading.sensor.components * int(seen.sum())
    dof = max(count - free, 1)
    if count:
        believable &= bool(chi2 <= dof + 5 * np.sqrt(2 * dof))
    return chi2, dof, believable
