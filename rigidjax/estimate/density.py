"""The posterior density of a problem in unconstrained numbers, for any sampler."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.estimate.grid import TURN_A_STEP
from rigidjax.estimate.terms import groups_of, grown_noises, own_numbers, prior_residuals, terms
from rigidjax.identify import uncertainty
from rigidjax.identify.parameters import Unpacked
from rigidjax.identify.problem import Problem
from rigidjax.identify.result import Fit
from rigidjax.motion.torques import CorrelatedTorque, RandomTorque

# The advice if a fit without the torque ended far from the body.
_GUESS = (
    ", or begin from a first guess, fit(problem, starts=1, max_steps=1): the torque may be too "
    "strong for a fit without it"
)


class LogDensity(eqx.Module):
    """The logarithm of the posterior density of a fitted problem, of one vector x.

    Call it with x (n,), real numbers without bounds: the problem's `Parameters` (body chart,
    `Free`s, initial states), then logarithms of factors of the unknown noises (one for each noise
    that the fit estimates) and of the process's numbers. `unpack(x)` gives body, states and values,
    `x0` is the fit. `covariance` is Laplace's, for a sampler's start and mass matrix; it is smaller
    than the fit's if errors are autocorrelated.

    With a `process` the filter integrates the unknown torque out, from the initial state in x.
    Without it the readings are independent and normal about the motion: this is too narrow if the
    fit says that its errors are autocorrelated; keep fewer readings then, or give a process. Priors
    are the problem's: `Free`s with a prior, an `Entropic` one; the prior of all other numbers is
    flat in x.

    **Arguments:** `fit` of `identify.fit`; with a process a first guess is enough,
    `fit(problem, starts=1, max_steps=1)`, since a motion without the torque may not explain the
    readings; `process` a `RandomTorque` or `CorrelatedTorque` or `None`; `deviation` of the normal
    prior of the logarithms of its density and time about the given values, `None` for a known
    process. The density scales with the square of a moment if only ratios of moments are
    determined, as by a gyro alone: compare `density / moment**2`, and give the prior in the fit's
    own unit of inertia (`fit.body`).

    **Raises:** `TypeError` for arguments of another type; `ValueError` for a robust loss, which is
    no density, and for directions that neither data nor a prior determine.

    For numpyro: `numpyro.infer.MCMC(NUTS(potential_fn=lambda x: -density(x)), …)`; for blackjax:
    `blackjax.nuts(density, …)`, or `estimate.posterior`. Gradients are computed recording by
    recording in forward mode, also under `jax.grad`. It is a Module of arrays: compile it by
    `equinox.filter_jit(density)`.

    >>> import rigidjax as rj
    >>> ts = jnp.linspace(0.0, 10.0, 80)
    >>> motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    >>> record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), motion.ys.omega))
    >>> found = rj.identify.fit(rj.identify.Problem(record, rj.identify.PrincipalRatios()))
    >>> density = LogDensity(found)
    >>> density.size, bool(density(density.x0) > density(density.x0 + 0.1))
    (5, True)
    """

    problem: Problem
    process: RandomTorque | CorrelatedTorque | None
    deviation: Scalar | None
    x0: Float[Array, " n"]
    covariance: Float[Array, "n n"]
    noises: tuple[Array, ...]
    like: Any
    substeps: int = eqx.field(static=True)

    def __init__(
        self,
        fit: Fit,
        process: RandomTorque | CorrelatedTorque | None = None,
        *,
        deviation: float | None = 2.0,
    ):
        _checks.instance(fit, Fit, "LogDensity: fit", wanted="what identify.fit returns")
        problem = fit.problem
        if process is not None:
            _checks.instance(process, (RandomTorque, CorrelatedTorque), "process")
        if problem.loss is not None:
            raise ValueError("fit: its problem has a robust loss, which is no density; fit without")
        if not np.isfinite(np.asarray(fit.covariance)).all():
            what = " ".join(one.in_words for one in fit.undetermined)
            hint = "" if process is None else _GUESS
            raise ValueError(
                "fit: neither the data nor a prior determine some direction, so there is no "
                f"posterior; give a prior or fewer free numbers{hint}. {what}".rstrip()
            )
        self.problem, self.process, self.noises = problem, process, fit.noises
        known = process is None or deviation is None
        self.deviation = None if known else jnp.asarray(_checks.positive(deviation, "deviation"))
        groups = np.asarray(groups_of(problem))
        factors = tuple(
            jnp.zeros(groups.max() + 1) if reading.sensor.noise is None else None
            for reading in problem.records.readings
        )
        logs = None if known else jnp.zeros(len(jax.tree.leaves(process)))
        self.like = (fit.parameters, factors, logs)
        self.x0 = ravel_pytree(self.like)[0]
        seen = np.asarray(fit.covariance)
        sandwich = fit.covariance_kind.startswith("sandwich")
        if sandwich and (process is None or not _definite(seen)):
            # The density assumes white errors: it is narrower than the fit's intervals. The
            # sandwich covariance of many recordings may be singular: no scale for a search.
            linear = uncertainty.linearise(problem, fit.parameters, fit.noises, near=fit.near)
            seen = uncertainty.of_white(linear).covariance
        rest, total = [], 0
        for factor, reading in zip(factors, problem.records.readings, strict=True):
            rows = np.bincount(groups, np.asarray(reading.seen.sum(axis=1)))
            total += int(rows.sum())
            if factor is not None:
                # The logarithm of a standard deviation is known to 1/√(2n).
                rest.append(0.5 / np.maximum(rows * reading.sensor.components, 1))
        if logs is not None:
            rest.append(np.full(logs.shape, 1 / math.sqrt(total)))
        self.covariance = jax.scipy.linalg.block_diag(seen, *(np.diag(part) for part in rest))
        rate = 1.5 * float(jnp.max(problem.reference.rate))
        widest = max(float(jnp.max(jnp.diff(r.t))) for r in problem.recordings)
        self.substeps = max(1, math.ceil(widest * rate / TURN_A_STEP))

    @property
    def size(self) -> int:
        """The number of numbers in x."""
        return self.x0.size

    def __call__(self, x: Float[Array, " n"]) -> Scalar:
        x = _checks.floating(x, self.x0.shape, "x")
        return terms(self, x).log_density - 0.5 * jnp.sum(prior_residuals(self, x) ** 2)

    def unpack(self, x: Float[Array, " n"]) -> Unpacked:
        """The meaning of x (n,): `Unpacked` with `body`, `state0`, `values`, `noise`, `process`.

        `values` are those of the `Free`s by name; `parameters` the problem's own numbers.
        """
        x = _checks.floating(x, self.x0.shape, "x")
        parameters, _, logs = ravel_pytree(self.like)[1](x)
        noises = grown_noises(self.noises, own_numbers(self, x)[1])
        body, state0 = self.problem.unpack(parameters)
        values, process = self.problem.values(parameters), self.grown(logs)
        return Unpacked(parameters, body, state0, values, noises, process)

    def grown(self, logs: Array | None) -> Any:
        """The process by the logarithms of the factors of its numbers."""
        if logs is None:
            return self.process
        leaves, structure = jax.tree.flatten(self.process)
        grown = [leaf * jnp.exp(log) for leaf, log in zip(leaves, logs, strict=True)]
        return jax.tree.unflatten(structure, grown)


@eqx.filter_jit
def of_draws(
    function: Callable[[Unpacked], Any], density: LogDensity, x: Float[Array, "m n"]
) -> Any:
    """`function(point)` of each draw; compiled once for a function and densities of one form."""
    return jax.vmap(lambda one: function(density.unpack(one)))(x)


def _definite(covariance: np.ndarray) -> bool:
    """Whether a covariance has a Cholesky factor that round-off does not decide."""
    size = np.sqrt(np.diagonal(covariance))
    return bool(np.linalg.eigvalsh(covariance / np.outer(size, size)).min() > 1e-10)
