"""How sure a fit is: covariance, intervals, goodness, and what the data cannot see."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from scipy.special import ndtri, stdtrit

from rigidjax.identify.loss import weight
from rigidjax.identify.problem import Parameters, Problem

if TYPE_CHECKING:
    from rigidjax.identify.fit import Fit


@eqx.filter_jit
def _linearised(problem: Problem, parameters: Parameters, noise: tuple) -> tuple[Array, Array]:
    """Whitened errors (N, 3) and their Jacobian (N, 3, n), each row times √(its weight)."""
    flat, restore = ravel_pytree(parameters)

    def whitened(vector: Array) -> Array:
        errors = problem.errors(restore(vector))
        return jnp.concatenate([e / s[None] for e, s in zip(errors, noise, strict=True)])

    errors, jacobian = whitened(flat), jax.jacfwd(whitened)(flat)
    root = jnp.sqrt(jax.vmap(lambda e: weight(problem.loss, e))(errors))
    return errors * root[:, None], jacobian * root[:, None, None]


def covariance(
    problem: Problem, parameters: Parameters, noise: tuple
) -> tuple[Float[Array, "n n"], Float[Array, " n"], Float[Array, "k n"]]:
    """Covariance of the parameters, singular values, and the directions that the data miss.

    `(Jᵀ W J)⁻¹` with the whitened Jacobian J and the weights W of the loss; a direction whose
    singular value is below 1e-8 of the largest is given infinite variance, not a made-up one.
    """
    _, jacobian = _linearised(problem, parameters, noise)
    jacobian = np.asarray(jacobian).reshape(-1, jacobian.shape[-1])
    if not np.isfinite(jacobian).all():
        n = jacobian.shape[-1]
        return jnp.full((n, n), jnp.nan), jnp.full(n, jnp.nan), jnp.zeros((0, n))
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    seen = singular > 1e-8 * singular.max()
    inverse = np.where(seen, 1.0 / np.where(seen, singular, 1.0), 0.0)
    out = (directions.T * inverse**2) @ directions
    if not seen.all():
        blind = np.abs(directions[~seen]).max(axis=0) > 1e-6
        out[blind, blind] = np.inf
    return jnp.asarray(out), jnp.asarray(singular), jnp.asarray(directions[~seen])


def estimate_noise(
    problem: Problem, errors: tuple, noise: tuple, parameters: Parameters
) -> tuple[Float[Array, "3"], ...]:
    """Noise of each sensor: as given, or the weighted scatter of its errors, per axis together.

    The number of free parameters is taken off the number of errors.
    """
    free = ravel_pytree(parameters)[0].size
    total = problem.recording.size
    out = []
    for reading, error, sigma in zip(problem.recording.readings, errors, noise, strict=True):
        if reading.sensor.noise is not None:
            out.append(reading.sensor.noise)
            continue
        weights = np.asarray(jax.vmap(lambda e, s=sigma: weight(problem.loss, e / s))(error))
        squares = weights * np.sum(np.asarray(error) ** 2, axis=1)
        share = max(1.0 - free / total, 0.1)
        variance = squares[reading.seen].sum() / (3 * reading.seen.sum() * share)
        # Data without noise must not divide by zero: round-off is the least that is believed.
        floor = 1e-15 * float(jnp.abs(reading.values).max() + 1e-300)
        out.append(jnp.full(3, max(float(np.sqrt(variance)), floor)))
    return tuple(out)


def goodness(problem: Problem, parameters: Parameters, noise: tuple) -> tuple[float, int, bool]:
    """χ² of the sensors with a given noise, its degrees of freedom, and whether to believe the fit.

    Believed where χ² is within five standard deviations of its mean and, for a sensor whose noise
    was estimated, where the motion explains at least half of the variance of its readings.
    """
    errors = problem_errors(parameters, problem)
    free = ravel_pytree(parameters)[0].size
    chi2, count, believable = 0.0, 0, True
    for reading, error, sigma in zip(problem.recording.readings, errors, noise, strict=True):
        mask = reading.seen
        whitened = np.asarray(error)[mask] / np.asarray(sigma)
        if reading.sensor.noise is None:
            values = np.asarray(reading.values)[mask]
            spread = np.sum((values - values.mean(axis=0)) ** 2)
            left = np.sum(np.asarray(error)[mask] ** 2)
            believable &= bool(left <= 0.5 * spread + 1e-12 * np.sum(values**2))
        else:
            weights = np.asarray(jax.vmap(lambda e: weight(problem.loss, e))(jnp.asarray(whitened)))
            chi2 += float(np.sum(weights * np.sum(whitened**2, axis=1)))
            count += 3 * int(mask.sum())
    dof = max(count - free, 1)
    if count:
        believable &= bool(chi2 <= dof + 5 * np.sqrt(2 * dof))
    return chi2, dof, believable


@eqx.filter_jit
def problem_errors(parameters: Parameters, problem: Problem) -> tuple[Array, ...]:
    """The errors at these parameters, compiled once."""
    return problem.errors(parameters)


def intervals(fit: "Fit", level: float) -> dict[str, tuple[float, float]]:
    """See `Fit.interval`."""
    chart = fit.problem.body
    low, high = interval_of(fit, lambda body, state: chart.log_ratios(body), level)
    with np.errstate(over="ignore"):
        low, high = np.exp(low), np.exp(high)
    out = dict(zip(chart.ratio_names, zip(low, high, strict=True), strict=True))
    low, high = interval_of(fit, lambda body, state: state.omega, level)
    out.update(zip(("Ωx", "Ωy", "Ωz"), zip(low, high, strict=True), strict=True))
    return {name: (float(low), float(high)) for name, (low, high) in out.items()}


def interval_of(
    fit: "Fit", of: Callable[[Any, Any], Any], level: float
) -> tuple[np.ndarray, np.ndarray]:
    """See `Fit.interval_of`."""
    if not 0 < level < 1:
        raise ValueError(f"interval: wanted a level between 0 and 1, got {level}")
    middle, spread = spread_of(fit, of)
    reach = quantile(fit, level) * spread
    return middle - reach, middle + reach


def spread_of(fit: "Fit", of: Callable[[Any, Any], Any]) -> tuple[np.ndarray, np.ndarray]:
    """Value and standard deviation of any function of the body and the first state."""
    flat, restore = ravel_pytree(fit.parameters)

    def value(vector: Array) -> Array:
        return jnp.asarray(of(*fit.problem.unpack(restore(vector))))

    middle, slope = np.asarray(value(flat)), np.asarray(jax.jacfwd(value)(flat))
    spread = np.asarray(fit.covariance)
    blind = ~np.isfinite(np.diag(spread))
    touched = np.abs(slope[..., blind]).max(axis=-1, initial=0.0) > 1e-9
    finite = np.where(np.isfinite(spread), spread, 0.0)
    variance = np.einsum("...i,ij,...j->...", slope, finite, slope)
    return middle, np.where(touched, np.inf, np.sqrt(np.maximum(variance, 0.0)))


def quantile(fit: "Fit", level: float) -> float:
    """Half-width of an interval in standard deviations: Student's where the noise is estimated."""
    tail = 0.5 * (1 + level)
    sensors = [reading.sensor for reading in fit.problem.recording.readings]
    if all(sensor.noise is not None for sensor in sensors):
        return float(ndtri(tail))
    count = fit.problem.recording.size
    return float(stdtrit(max(count - fit.covariance.shape[0], 1), tail))


def in_words(fit: "Fit") -> tuple[str, ...]:
    """What the data fix, what they fix weakly, what they cannot see."""
    out = []
    bounds = intervals(fit, 0.95)
    for name in fit.problem.body.ratio_names:
        low, high = bounds[name]
        wide = (high - low) / (0.5 * (high + low))
        if not np.isfinite(wide) or wide > 1.9:
            out.append(f"{name} is not determined by these data.")
        elif wide > 0.1:
            out.append(
                f"{name} is weakly determined: its 95 % interval is {wide:.0%} of its value."
            )
        else:
            out.append(f"{name} is well determined, to ±{0.5 * wide:.2g} of its value.")
    rate = np.asarray(fit.state0.omega)
    reach = max(0.5 * (bounds[f"Ω{a}"][1] - bounds[f"Ω{a}"][0]) for a in "xyz")
    share = reach / np.linalg.norm(rate)
    grade = "well" if share < 0.1 else "weakly"
    out.append(f"The first body rate is {grade} determined, to ±{share:.2g} of its length.")
    if fit.null_directions.shape[0]:
        out.append(
            f"{fit.null_directions.shape[0]} combinations of the free numbers leave no trace in "
            "these data; intervals that depend on them are infinite."
        )
    if fit.problem.torque is None:
        out.append(
            "Free motion cannot show the absolute inertia: only ratios; mass and centre of mass "
            "leave no trace at all."
        )
    return tuple(out)
