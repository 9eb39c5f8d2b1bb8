"""The width of the recordings' deviations from a shared number, estimated from them.

The width σ of the deviations d_r maximises the marginal likelihood, with all other numbers
integrated out about the best point (Laplace). The method is expectation and maximisation: σ² is the
mean of d_r² plus the posterior variance of d_r (Dempster, Laird and Rubin 1977, section 4.5; Laird
and Ware 1982, doi:10.2307/2529876).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rigidjax.identify import uncertainty
from rigidjax.identify.checkpoint import Tried
from rigidjax.identify.parameters import Parameters, by_slot, numbered
from rigidjax.identify.problem import Problem
from rigidjax.identify.residual import Noise
from rigidjax.identify.search import again

# Rounds, and the relative change at which they end; a width below so much of the first one is zero.
_ROUNDS, _SETTLED, _LEAST = 40, 0.01, 1e-4


def with_widths(
    problem: Problem, best: Tried, noise: Noise, tolerance: float, max_steps: int
) -> tuple[Problem, Tried]:
    """The problem with the estimated widths, and its best point near `best`."""
    wanted = [index for index, slot in enumerate(problem.slots) if slot.estimated]
    if not wanted:
        return problem, best
    least = _LEAST * _widths(problem)[wanted]
    for _ in range(_ROUNDS):
        before = _widths(problem)[wanted]
        found = np.maximum(_expected(problem, best.parameters, noise)[wanted], least)
        new = [jnp.asarray(width) for width in found]
        problem = eqx.tree_at(lambda p: [p.slots[i].spread for i in wanted], problem, new)
        best = again(best, problem, noise, tolerance, max_steps)
        if (np.abs(found - before) < _SETTLED * before).all() or (found <= least).all():
            break
    return problem, best


def _widths(problem: Problem) -> np.ndarray:
    """The width of each `Free`, in steps; 1 for a `Free` without one."""
    return np.array([1.0 if s.spread is None else float(s.spread) for s in problem.slots])


def _expected(problem: Problem, parameters: Parameters, noise: Noise) -> np.ndarray:
    """The root mean square of each one's deviations, with their uncertainty included."""
    linear = uncertainty.linearise(problem, parameters, noise)
    variance = np.diag(uncertainty.of_white(linear).seen)
    values, places = (by_slot(problem, of) for of in (parameters, numbered(parameters)))
    out = np.ones(len(problem.slots))
    for index, slot in enumerate(problem.slots):
        if slot.spread is not None:
            deviation, where = np.asarray(values[index][2]), np.ravel(places[index][2]).astype(int)
            out[index] = np.sqrt(np.mean(deviation**2) + np.mean(variance[where]))
    return out


def widths(problem: Problem) -> dict[str, jax.Array]:
    """The spread of each `Free` with one, by name, in its unit."""
    return {s.name: s.spread * s.scale for s in problem.slots if s.spread is not None}
