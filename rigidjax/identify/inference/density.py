"""The posterior density of a problem in unconstrained numbers, for any sampler."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasSpin, Scalar
from rigidjax.identify.answer.result import Fit
from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Recording
from rigidjax.identify.filtering import roots
from rigidjax.identify.filtering.filter import Belief, grid_of, scan_filter
from rigidjax.identify.filtering.roots import Terms
from rigidjax.identify.filtering.steps import TURN_A_STEP, Extended, Model, sensors_of, with_torque
from rigidjax.identify.model.charts import matter
from rigidjax.identify.model.free import Unpacked, local
from rigidjax.identify.model.predict import what_turns
from rigidjax.identify.model.problem import Problem
from rigidjax.identify.model.terms import (
    beside,
    errors_of_one,
    filled,
    over_records,
    standardised,
    with_jacobian,
)
from rigidjax.identify.uncertainty import covariance as uncertainty
from rigidjax.motion.manifold import dimension
from rigidjax.motion.torques import CorrelatedTorque, RandomTorque
from rigidjax.rotation.barrier import batched_as

# The advice if a fit without the torque ended far from the body.
_GUESS = (
    ", or begin from a first guess, fit(problem, starts=1, max_steps=1): the torque may be too "
    "strong for a fit without it"
)


class LogDensity(eqx.Module):
    """The logarithm of the posterior density of a fitted problem, of one vector x.

    Call it with x (n,), real numbers without bounds: the problem's `Parameters` (body chart,
    `Free`s, initial states), then logarithms of factors of the noises that the fit estimates and of
    the process's numbers. `unpack(x)` gives body, states and values, `x0` is the fit. `covariance`
    is Laplace's, for a sampler's start and mass matrix; it is smaller than the fit's if errors are
    autocorrelated.

    With a `process` the filter integrates the unknown torque out. Without it the readings are
    independent and normal about the motion: this is too narrow if errors are autocorrelated; keep
    fewer readings then, or give a process. A sensor's jitter is that of the fit. Priors are the
    problem's: `Free`s with a prior, an `Entropic` one; the prior of all other numbers is flat in x.

    **Arguments:** `fit` of `identify.fit`; with a process a first guess is enough, `fit(problem,
    starts=1, max_steps=1)`; `process` a `RandomTorque` or `CorrelatedTorque` or `None`; `deviation`
    of the normal prior of the logarithms of its density and time about the given values, `None` for
    a known process. The density scales with the square of a moment if only ratios of moments are
    determined, as by a gyro alone: compare `density / moment**2`, and give the prior in the fit's
    own unit of inertia (`fit.body`). **Raises:** `ValueError` for a robust loss, which is no
    density, and for directions that neither data nor a prior determine.

    For numpyro: `numpyro.infer.MCMC(NUTS(potential_fn=lambda x: -density(x)), …)`; for blackjax:
    `blackjax.nuts(density, …)`, or `estimate.posterior`. Gradients are computed recording by
    recording in forward mode, also under `jax.grad`; compile it by `equinox.filter_jit(density)`.

    >>> record, chart = rj.datasets.toutatis.recording(), rj.identify.PrincipalRatios()
    >>> density = LogDensity(rj.identify.fit(rj.identify.Problem(record, chart)))
    >>> density.size, bool(density(density.x0) > density(density.x0 + 0.1))
    (8, True)
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
        groups, factors, rest, total = np.asarray(problem.noise_groups), [], [], 0
        for reading in problem.records.readings:
            rows = np.bincount(groups, np.asarray(reading.seen.sum(axis=1)))
            total += int(rows.sum())
            guessed = reading.sensor.noise is None
            factors.append(jnp.zeros(rows.size) if guessed else None)
            if guessed:
                # The logarithm of a standard deviation is known to 1/√(2n).
                rest.append(0.5 / np.maximum(rows * reading.sensor.components, 1))
        logs = None if known else jnp.zeros(len(jax.tree.leaves(process)))
        self.like = (fit.parameters, tuple(factors), logs)
        self.x0 = ravel_pytree(self.like)[0]
        seen = np.asarray(fit.covariance)
        if fit.covariance_kind.startswith("sandwich"):
            # The density assumes white errors: it is narrower than the fit's intervals. The
            # sandwich covariance of many recordings may be singular: no scale for a search.
            size = np.sqrt(np.diagonal(seen))
            definite = np.linalg.eigvalsh(seen / np.outer(size, size)).min() > 1e-10
            if process is None or not definite:
                linear = uncertainty.linearise(problem, fit.parameters, fit.noises, near=fit.near)
                seen = uncertainty.of_white(linear).covariance
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
        logs = jax.tree.unflatten(jax.tree.structure(self.process), list(logs))
        return jax.tree.map(lambda leaf, log: leaf * jnp.exp(log), self.process, logs)


@eqx.filter_jit
def of_draws(
    function: Callable[[Unpacked], Any], density: LogDensity, x: Float[Array, "m n"]
) -> Any:
    """`function(point)` of each draw; compiled once for a function and densities of one form."""
    return jax.vmap(lambda one: function(density.unpack(one)))(x)


class Curvature(NamedTuple):
    """The cost, minus a log-density; Fisher's information `gram`; the gradient `slope`."""

    cost: Scalar
    gram: Float[Array, "n n"]
    slope: Float[Array, " n"]


def terms(density: LogDensity, x: Float[Array, " n"]) -> Terms:
    """The terms of all readings; derivatives recording by recording, in the numbers of each."""
    return _terms_of(_rows(density, x), density)


@eqx.filter_custom_jvp
def _terms_of(rows: Array, density: LogDensity) -> Terms:
    out = over_records(partial(_of_one, density), density.problem, (rows, density.noises))
    return batched_as(out, (rows, eqx.filter(density, eqx.is_inexact_array)))


@_terms_of.def_jvp
def _(primals: Any, tangents: Any) -> tuple[Terms, Terms]:
    (rows, density), (step, beside) = primals, tangents
    if jax.tree.leaves(beside):
        raise TypeError(
            "LogDensity: wanted derivatives in x alone, not in the density's own numbers"
        )
    out, blocks = _with_blocks(density, rows)
    moved = jax.tree.map(lambda b: jnp.einsum("rni,ri->rn", b, step), blocks)
    return batched_as(out, (rows, eqx.filter(density, eqx.is_inexact_array))), moved


def curvature(density: LogDensity, x: Float[Array, " n"]) -> Curvature:
    """Cost, gradient and Fisher's information: normal errors with variances that x moves, too.

    `Σ ∂ν ∂νᵀ/s + ½ ∂(log s) ∂(log s)ᵀ` over innovations ν of variance s (Gupta and Mehra 1974,
    doi:10.1109/TAC.1974.1100714, for the filter), and priors.
    """
    rows, push = jax.linearize(lambda x: _rows(density, x), x)
    placed = jax.vmap(push, out_axes=-1)(jnp.eye(x.size, dtype=x.dtype))
    found, blocks = _with_blocks(density, rows)
    # d(ν/√s) = dν/√s − ½ ν/√s d(log s).
    moved = blocks.error + 0.5 * found.error[..., None] * blocks.log_variance
    both = jnp.concatenate([moved, 0.5**0.5 * blocks.log_variance], axis=1)
    inner = jnp.einsum("rni,rnj->rij", both, both)
    gram = jnp.einsum("rin,rij,rjm->nm", placed, inner, placed, optimize="optimal")
    each = jnp.einsum("rn,rni->ri", found.error, blocks.error) + 0.5 * jnp.sum(
        blocks.log_variance, 1
    )
    slope = jnp.einsum("rin,ri->n", placed, each)

    extra, rest = with_jacobian(lambda x: prior_residuals(density, x), x)
    cost = 0.5 * jnp.sum(rest**2) - found.log_density
    return Curvature(cost, gram + extra.T @ extra, slope + rest @ extra)


def prior_residuals(density: LogDensity, x: Float[Array, " n"]) -> Float[Array, " m"]:
    """The terms of the priors, as numbers whose halved squares are subtracted from the density."""
    parameters, _, logs = ravel_pytree(density.like)[1](x)
    rest = jax.tree.leaves(beside(parameters, density.problem, None))
    parts = [leaf.reshape(-1) for leaf in rest]
    if logs is not None and density.deviation is not None:
        parts.append(logs / density.deviation)
    return jnp.concatenate(parts) if parts else jnp.zeros(0, x.dtype)


def grown_noises(noises: tuple, steps: tuple) -> tuple[Float[Array, "*records k"], ...]:
    """The noises of the sensors by the logarithms of their factors, `None` for none."""
    pairs = zip(noises, steps, strict=True)
    return tuple(n if step is None else n * jnp.exp(step)[..., None] for n, step in pairs)


def own_numbers(density: LogDensity, x: Array) -> Any:
    """The problem's numbers, factors of noises and the process's numbers of each recording."""
    problem = density.problem
    parameters, factors, logs = ravel_pytree(density.like)[1](x)
    steps = tuple(None if f is None else f[problem.noise_groups] for f in factors)
    laws = None if logs is None else jnp.broadcast_to(logs, (problem.count, logs.size))
    return local(problem, parameters), steps, laws


def _rows(density: LogDensity, x: Array) -> Float[Array, "records m"]:
    """The same as a row for each recording: a linear function of x."""
    return jax.vmap(lambda one: ravel_pytree(one)[0])(own_numbers(density, x))


def _with_blocks(density: LogDensity, rows: Array) -> tuple[Terms, Terms]:
    """The terms, and their derivatives (R, N, m) by the row of their recording."""

    def value_and_slope(mine: tuple[Array, Any], *rest: Any) -> Any:
        row, noises = mine
        # A dozen numbers and one long loop: forward mode is cheaper to compile and to run.
        blocks, out = with_jacobian(lambda row: _of_one(density, (row, noises), *rest), row)
        return out, blocks

    return over_records(value_and_slope, density.problem, (rows, density.noises))


def _of_one(
    density: LogDensity, own: tuple[Array, Any], record: Recording, ref: Any, which: Any
) -> Terms:
    """The terms of one recording, of its row `own` and the noises at the fit; the filter integrates
    the unknown torque out.
    """
    problem = density.problem
    restore = ravel_pytree(stacking.one(own_numbers(density, density.x0), 0))[1]
    mine, steps, logs = restore(own[0])
    noises = grown_noises(own[1], steps)
    if density.process is None:
        return _of_motion(problem, mine, noises, record, ref, which)
    # Values first: a noise in the place of `None` moves the leaves that the slots count.
    record = eqx.tree_at(
        lambda r: [reading.sensor.noise for reading in r.readings],
        filled(problem, mine, record),
        list(noises),
        is_leaf=lambda node: node is None,
    )
    body = what_turns(matter(problem.body, mine.body, which), problem.rung)
    state: HasSpin = ref.moved(mine.own)
    model = with_torque(Model(body, density.grown(logs)), record.torque)
    sensors = sensors_of([reading.sensor for reading in record.readings], model)
    torques = tuple(jnp.zeros(3, state.omega.dtype) for _ in model.coloured)
    known = jnp.zeros(dimension(state), state.omega.dtype)
    spread = jnp.concatenate([known, *(law.deviation for law in model.coloured)])
    first = Belief(record.t[0], Extended(state, torques, ()), jnp.diag(spread))
    grid = grid_of(model, record, first, density.substeps)
    _, _, read = scan_filter((model, sensors, record, first, grid), lambda _, read: read)
    return jax.tree.map(jnp.ravel, roots.terms(*read))


def _of_motion(
    problem: Problem, mine: Any, noises: Any, record: Recording, ref: Any, which: Any
) -> Terms:
    """The terms of one recording without an unknown torque: normal about the motion."""
    errors, _ = errors_of_one(problem, mine, record, ref, which)
    scaled, log_variance = [], []
    for reading, error, noise in zip(record.readings, errors, noises, strict=True):
        limit = getattr(reading.sensor, "limit", None)
        given = reading.values, reading.mask, error, noise, limit, reading.late
        one, full, wider = standardised(*given)
        scaled.append(one)
        # What a channel at its limit counts is a probability, not a density.
        seen = reading.mask[:, None] & ~full
        logs = jnp.log(2 * math.pi * noise**2)[None]
        log_variance.append(jnp.where(seen, logs if wider is None else logs + wider, 0))
    return Terms(
        *(jnp.concatenate([a.reshape(-1) for a in part]) for part in (scaled, log_variance))
    )
