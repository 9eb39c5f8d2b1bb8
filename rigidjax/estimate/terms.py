"""The terms of a posterior density, and their derivatives, recording by recording."""

import math
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from rigidjax._types import HasSpin, Scalar
from rigidjax.estimate.belief import Belief
from rigidjax.estimate.filter import Task, scan_filter
from rigidjax.estimate.grid import grid_of
from rigidjax.estimate.scene import Extended, Model
from rigidjax.estimate.sensing import sensors_of
from rigidjax.identify import padding
from rigidjax.identify.jacobian import errors_of_one, filled, over_records, with_jacobian
from rigidjax.identify.parameters import local
from rigidjax.identify.problem import Problem
from rigidjax.identify.recording import Recording
from rigidjax.identify.residual import beside, standardised
from rigidjax.identify.sensor_inputs import what_turns
from rigidjax.identify.several_bodies import matter
from rigidjax.motion.manifold import dimension
from rigidjax.motion.torques import Sum

if TYPE_CHECKING:
    from rigidjax.estimate.density import LogDensity


class Terms(NamedTuple):
    """The numbers read in each recording, each one normal given the earlier ones.

    **Fields:** `error` (R, N) the reading minus its prediction, in standard deviations;
    `log_variance` (R, N) the logarithm of 2π times its variance. Both are zero for a masked
    reading; a channel at its limit counts by its probability, and has no variance.
    """

    error: Float[Array, "*records n"]
    log_variance: Float[Array, "*records n"]

    @property
    def log_density(self) -> Scalar:
        """The sum of the logarithms of the normal densities."""
        return -0.5 * jnp.sum(self.error**2 + self.log_variance)


class Curvature(NamedTuple):
    """The cost, minus a log-density, near a point.

    **Fields:** `cost`; `slope` (n,) its gradient; `gram` (n, n) Fisher's information: the
    expectation of its second derivative over readings that the point itself explains.
    """

    cost: Scalar
    slope: Float[Array, " n"]
    gram: Float[Array, "n n"]


def terms(density: "LogDensity", x: Float[Array, " n"]) -> Terms:
    """The terms of all readings; derivatives recording by recording, in the numbers of each."""

    @jax.custom_jvp
    def of(rows: Array) -> Terms:
        of_one = partial(_of_one, density)
        return over_records(of_one, density.problem, (rows, density.noises))

    @of.defjvp
    def _(rows: tuple, step: tuple) -> tuple[Terms, Terms]:
        out, blocks = _with_blocks(density, rows[0])
        return out, jax.tree.map(lambda b: jnp.einsum("rni,ri->rn", b, step[0]), blocks)

    return of(_rows(density, x))


def curvature(density: "LogDensity", x: Float[Array, " n"]) -> Curvature:
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
    return Curvature(cost, slope + rest @ extra, gram + extra.T @ extra)


def prior_residuals(density: "LogDensity", x: Float[Array, " n"]) -> Float[Array, " m"]:
    """The terms of the priors, as numbers whose halved squares are subtracted from the density."""
    parameters, _, logs = ravel_pytree(density.like)[1](x)
    parts = [leaf.reshape(-1) for leaf in beside(parameters, density.problem, None)]
    if logs is not None and density.deviation is not None:
        parts.append(logs / density.deviation)
    return jnp.concatenate(parts) if parts else jnp.zeros(0, x.dtype)


def groups_of(problem: Problem) -> Int[Array, " records"]:
    """The index of each recording's noise in the fit: all the same unless `noise_each`."""
    groups = problem.noise_groups
    return jnp.zeros(problem.count, jnp.int32) if groups is None else groups


def grown_noises(noises: tuple, steps: tuple) -> tuple[Float[Array, "*records k"], ...]:
    """The noises of the sensors by the logarithms of their factors, `None` for none."""
    return tuple(
        noise if step is None else noise * jnp.exp(step)[..., None]
        for noise, step in zip(noises, steps, strict=True)
    )


def own_numbers(density: "LogDensity", x: Array) -> Any:
    """The numbers of x that each recording depends on, with a leading axis.

    They are the problem's numbers, the logarithms of the noises' factors, and the process's
    numbers.
    """
    problem = density.problem
    parameters, factors, logs = ravel_pytree(density.like)[1](x)
    groups = groups_of(problem)
    steps = tuple(None if factor is None else factor[groups] for factor in factors)
    laws = None if logs is None else jnp.broadcast_to(logs, (problem.count, logs.size))
    return local(problem, parameters), steps, laws


def _rows(density: "LogDensity", x: Array) -> Float[Array, "records m"]:
    """The same as a row for each recording: a linear function of x."""
    return jax.vmap(lambda one: ravel_pytree(one)[0])(own_numbers(density, x))


def _with_blocks(density: "LogDensity", rows: Array) -> tuple[Terms, Terms]:
    """The terms, and their derivatives (R, N, m) by the row of their recording."""

    def value_and_slope(mine: tuple[Array, Any], *rest: Any) -> Any:
        row, noises = mine
        # A dozen numbers and one long loop: forward mode is cheaper to compile and to run.
        blocks, out = with_jacobian(lambda row: _of_one(density, (row, noises), *rest), row)
        return out, blocks

    return over_records(value_and_slope, density.problem, (rows, density.noises))


def _of_one(
    density: "LogDensity", own: tuple[Array, Any], record: Recording, ref: Any, which: Any
) -> Terms:
    """The terms of one recording, the unknown torque integrated out by the filter.

    **Arguments:** `own` its row of `_rows`, and the noises (k,) of its sensors at the fit.
    """
    problem = density.problem
    restore = ravel_pytree(padding.one(own_numbers(density, density.x0), 0))[1]
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
    state: HasSpin = ref.moved(mine)
    process = density.grown(logs)
    law = process if record.torque is None else Sum(record.torque, process)
    model = Model(body, law)
    sensors = [reading.sensor for reading in record.readings]
    torques = tuple(jnp.zeros(3, state.omega.dtype) for _ in model.coloured)
    x = Extended(state, torques, ())
    known = jnp.zeros(dimension(state), state.omega.dtype)
    spread = jnp.concatenate([known, *(law.deviation for law in model.coloured)])
    first = Belief(record.t[0], x, jnp.diag(spread))
    grid = grid_of(model, record, first, density.substeps)
    task = Task(model, sensors_of(sensors, model), record, first, grid)
    reads = scan_filter(task, lambda belief, read: read)[1][1]
    error = [jnp.where(r.seen, r.innovation * lax.rsqrt(r.variance), 0) for r in reads]
    log_variance = [jnp.where(r.seen, jnp.log(2 * math.pi * r.variance), 0) for r in reads]
    return _flat(error, log_variance)


def _of_motion(
    problem: Problem, mine: Any, noises: Any, record: Recording, ref: Any, which: Any
) -> Terms:
    """The terms of one recording without an unknown torque: normal about the motion."""
    errors, _ = errors_of_one(problem, mine, record, ref, which)
    scaled, log_variance = [], []
    for reading, error, noise in zip(record.readings, errors, noises, strict=True):
        limit = getattr(reading.sensor, "limit", None)
        one, full = standardised(reading.values, reading.mask, error, noise, limit)
        scaled.append(one)
        # What a channel at its limit counts is a probability, not a density.
        seen = reading.mask[:, None] & ~full
        log_variance.append(jnp.where(seen, jnp.log(2 * math.pi * noise**2)[None], 0))
    return _flat(scaled, log_variance)


def _flat(error: list[Array], log_variance: list[Array]) -> Terms:
    return Terms(
        *(jnp.concatenate([a.reshape(-1) for a in part]) for part in (error, log_variance))
    )
