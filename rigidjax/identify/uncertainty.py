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
# Columns of the Jacobian are brought to length one, but not from below this share of the longest.
WEAKEST = 1e-6


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

    **Fields:** `covariance` (n, n), infinite where a number depends on what is not seen; `seen`
    (n, n) the same within what is seen; `kind` in words; `singular_values` (n,) of the weighted
    Jacobian, its columns of length one; `null_directions` (k, n) that leave no trace in the data.
    """

    covariance: np.ndarray
    seen: np.ndarray
    kind: str
    singular_values: np.ndarray
    null_directions: np.ndarray


def spread(linear: Linearised, times: "Times") -> Spread:
    """`(JᵀWJ)⁻¹` where the errors are white, else the sandwich `H⁻¹ M H⁻¹`.

    `M = Jᵀ C J` with C the errors' own covariance in time: each channel its variance and an
    exponential of its correlation time. Fitted errors are smaller than true ones, the more so the
    fewer of them are independent: M is scaled up by n/(n − p) for n independent errors. With many
    recordings, what differs between them is taken instead where it is more.

    **Arguments:** `linear`; `times` how long the errors hang together.

    Source: White 1980, doi:10.2307/1912934; Liang and Zeger 1986, doi:10.1093/biomet/73.1.13.

    A direction whose singular value is below 1e-8 of the largest has infinite variance, not a
    made-up one.
    """
    rows = linear.rows
    n = rows.shape[1]
    if not np.isfinite(rows).all():
        lost, kind = np.full((n, n), np.nan), "none: the motion is not finite"
        return Spread(lost, lost, kind, np.full(n, np.nan), np.zeros((0, n)))
    # Columns of order one: a bias in rad/s must not look blind beside a moment. But a column of
    # round-off is not to be blown up.
    size = np.sqrt(np.sum(rows**2, axis=0))
    size = np.maximum(size, max(WEAKEST * size.max(), 1e-300))
    _, singular, directions = np.linalg.svd(rows / size, full_matrices=False)
    seen = singular > BLIND * max(singular.max(), 1e-300)
    inverse = np.where(seen, 1.0 / np.where(seen, singular, 1.0), 0.0)
    half = directions.T * inverse
    covariance = (half @ half.T) / np.outer(size, size)
    kind = "Gauss–Newton"
    if times.longest > 1.5:
        covariance = _sandwich(linear, covariance, times)
        kind = f"sandwich: the errors hang together over {times.longest:.0f} samples"
    null = directions[~seen] / size
    null = null / np.linalg.norm(null, axis=1, keepdims=True)
    shown = covariance.copy()
    blind = np.abs(null).max(axis=0, initial=0.0) > 1e-6
    shown[blind, blind] = np.inf
    return Spread(shown, covariance, kind, singular, null)


def _sandwich(linear: Linearised, bread: np.ndarray, times: "Times") -> np.ndarray:
    n = bread.shape[0]
    meat = np.zeros((n, n))
    for error, slope, weight, spans in zip(
        linear.errors, linear.slopes, linear.weights, times.spans, strict=True
    ):
        root = np.sqrt(weight)
        for channel, span in enumerate(spans):
            e, j = error[..., channel] * root, slope[..., channel, :] * root[..., None]
            variance = np.sum(e**2) / max(np.sum(weight > 0), 1)
            # 1 + 2 Σ ρˡ = span for an exponential.
            rho = (span - 1.0) / (span + 1.0)
            ahead, behind = _fading(j, rho), _fading(j[:, ::-1], rho)[:, ::-1]
            meat += variance * np.einsum("rti,rtj->ij", j, ahead + behind - j)
    meat *= times.independent / max(times.independent - n, 0.1 * times.independent)
    scores = linear.scores
    records = scores.shape[0]
    if records > n // 2 and records > 5:
        # Many recordings: what differs between them shows without any model of their errors.
        total = scores.sum(axis=1)
        apart = total.T @ total * records / (records - 1)
        meat = apart if np.trace(bread @ apart) > np.trace(bread @ meat) else meat
    out = bread @ meat @ bread
    # Never narrower than white errors would have it.
    below = np.diag(out) < np.diag(bread)
    factor = np.sqrt(np.where(below, np.diag(bread) / np.maximum(np.diag(out), 1e-300), 1.0))
    return out * np.outer(factor, factor)


def _fading(x: np.ndarray, rho: float) -> np.ndarray:
    """The sums y_t = x_t + ρ y_{t−1} along the second axis of (R, T, n)."""
    # Imported where it is used; not `scipy.signal.lfilter`, nor `scipy.stats` below: to load each
    # takes a second, which is as long as the rest of a first fit's imports.
    from scipy.linalg import solve_banded

    x = np.moveaxis(x, 1, 0)
    bands = np.array([[1.0], [-rho]]) * np.ones(x.shape[0])
    y = solve_banded((1, 0), bands, x.reshape(x.shape[0], -1))
    return np.moveaxis(y.reshape(x.shape), 0, 1)


class Times(eqx.Module):
    """How many samples the errors hang together, for each channel of each sensor.

    **Fields:** `spans` one tuple for each sensor, 1 for white errors; `closeness` the correlation
    from one sample to the next in the channel of the longest; `independent` how many errors that
    makes independent.
    """

    spans: tuple[tuple[float, ...], ...]
    closeness: float
    independent: float

    @property
    def longest(self) -> float:
        """The longest of all channels."""
        return max(span for sensor in self.spans for span in sensor)


def correlation_times(linear: Linearised) -> Times:
    """The integrated autocorrelation time `1 + 2 Σ ρ_l` of each channel.

    Summed up to the first lag at which ρ falls below twice its own scatter.
    """
    spans, longest, closest, independent = [], 1.0, 0.0, 0.0
    for error, weight in zip(linear.errors, linear.weights, strict=True):
        kept, found = error * np.sqrt(weight)[..., None], []
        for channel in range(error.shape[-1]):
            span, first = _channel_time(kept[..., channel], weight > 0)
            if span > longest:
                longest, closest = span, first
            found.append(span)
            independent += float(np.sum(weight > 0)) / span
        spans.append(tuple(found))
    return Times(tuple(spans), closest, independent)


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
    less than a tenth. Under a robust loss outliers are expected, and χ² is theirs: there the median
    of the squared errors counts, as long as it is that of readings without outliers to five
    standard deviations.
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
            size, many = reading.sensor.components, int(seen.sum())
            chi2 += float(np.sum(weight[..., None] * e**2))
            count += size * many
            if problem.loss is not None and many:
                middle = np.median(np.sum(e[seen] ** 2, axis=-1))
                half, density = _median_of_chi2(size)
                # Of a sample's median: 1 / (2 f √n), f the density there.
                wide = 0.5 / (density * np.sqrt(many))
                believable &= bool(middle <= half + 5 * wide)
    dof = max(count - free, 1)
    if count and problem.loss is None:
        believable &= bool(chi2 <= dof + 5 * np.sqrt(2 * dof))
    return chi2, dof, believable


def _median_of_chi2(size: int) -> tuple[float, float]:
    """The median of χ² with `size` degrees of freedom, and the density there."""
    from scipy.special import chdtri, gammaln

    median = float(chdtri(size, 0.5))
    power = 0.5 * size - 1
    density = 0.5 * np.exp(power * np.log(0.5 * median) - 0.5 * median - gammaln(0.5 * size))
    return median, float(density)
