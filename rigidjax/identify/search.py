"""Where the misfit is least: Levenberg–Marquardt from several starts, the record from its start."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rigidjax.identify.checkpoint import Position, Tried
from rigidjax.identify.problem import Parameters, Problem, with_blocks
from rigidjax.identify.residual import Noise, assembled, residuals

# The record is fitted from its beginning first: a long one is a forest of wrong minima (the phase
# slips by whole turns), a short one is not.
HORIZONS = (0.25, 0.5, 1.0)
# Steps between two looks at the clock, the keyboard and the checkpoint.
STRIDE = 25
# How many standard deviations (all else at rest) a unit of the search is. Levenberg's damping
# starts at 1, the curvature is this squared in every direction: small steps far away, whole ones
# near the bottom, which a narrow valley needs.
CAREFUL, BOLD = 1.0 / 30.0, 30.0
# A stride that lowers the misfit by less than this share has come to the bottom.
SETTLED = 1e-7
# A part of the record may be fitted at the expense of the whole, but not by more than this factor.
WILD = 100.0


def least_squares(
    start: Parameters,
    problem: Problem,
    noise: Noise,
    weights: Float[Array, "records times"],
    solver: Any,
    max_steps: int,
    bold: float,
) -> Tried:
    """At most `max_steps` steps of the solver from `start`."""
    # By the program that everything else runs as well: less to compile.
    sizes = _sizes(start, problem, noise, weights, evaluate(start, problem)[1], jnp.asarray(bold))
    value, done = _solve(start, sizes, problem, noise, weights, solver, max_steps)
    cost = _cost(value, problem, noise, weights, evaluate(value, problem)[0])
    return _safe(start, value, cost, done)


@eqx.filter_jit
def _sizes(
    parameters: Parameters,
    problem: Problem,
    noise: Noise,
    weights: Any,
    blocks: Any,
    bold: Array,
) -> Parameters:
    """The step of each parameter that the data feel alike, all else at rest.

    Levenberg's damping is the same for all parameters: in these units it is Marquardt's
    (Moré 1978, doi:10.1007/BFb0067700).
    """
    first = jax.tree.map(lambda leaf: leaf[0], parameters.own)
    _, restore = ravel_pytree((parameters.body, parameters.shared, first))
    squares = jnp.zeros((problem.count, 1), weights.dtype)
    for block, sigma in zip(blocks[0], noise, strict=True):
        felt = (block / sigma[:, None, :, None] * weights[..., None, None]) ** 2
        squares = squares + felt.sum(axis=(1, 2))
    body, shared, own = jax.vmap(restore)(squares)
    found = Parameters(body.sum(axis=0), jax.tree.map(lambda leaf: leaf.sum(axis=0), shared), own)
    of_all, of_each = iter(found.shared), iter(found.own.each)
    moved = {True: [], False: []}
    for slot in problem.slots:
        felt = next(of_each if slot.each else of_all)
        held = 0.0 if slot.prior is None else 1.0 / slot.prior**2
        moved[slot.each].append(felt + held)
    found = eqx.tree_at(
        lambda p: (p.shared, p.own.each), found, (tuple(moved[False]), tuple(moved[True]))
    )
    most = ravel_pytree(found)[0].max()
    floor = jnp.where(most > 0, 1e-12 * most, 1.0)

    def size(felt: Array) -> Array:
        return bold / jnp.sqrt(jnp.maximum(felt, floor))

    good = jnp.isfinite(most)
    units = jax.tree.map(lambda felt: jnp.where(good, size(felt), 1.0), found)

    # What the data hardly feel must not be flung about: of the numbers that are of order one by
    # their making (the unit of a `Free` is a user's guess) none moves faster than that.
    def made(p: Parameters) -> tuple[Any, ...]:
        return p.body, p.own.spin, p.own.turn, p.own.place, p.own.speed

    slow = tuple(None if unit is None else jnp.minimum(unit, 1.0) for unit in made(units))
    return eqx.tree_at(made, units, slow, is_leaf=lambda leaf: leaf is None)


@eqx.filter_jit
def evaluate(parameters: Parameters, problem: Problem) -> Any:
    """Errors and last states with their derivatives (see `with_blocks`).

    The one program outside the search that follows the motion: all else is made of it.
    """
    return with_blocks(parameters, problem)


@eqx.filter_jit
def _cost(
    parameters: Parameters, problem: Problem, noise: Noise, weights: Any, found: Any
) -> Float[Array, ""]:
    return half_sum(assembled(parameters, (problem, noise, weights), *found))


@eqx.filter_jit
def many(
    starts: Parameters,
    problem: Problem,
    noise: Noise,
    weights: Float[Array, "records times"],
    solver: Any,
    max_steps: int,
) -> Tried:
    """`least_squares` from many starts at once (a leading axis on `starts`)."""

    def one(start: Parameters) -> Tried:
        blocks = with_blocks(start, problem)[1]
        sizes = _sizes(start, problem, noise, weights, blocks, jnp.asarray(CAREFUL))
        value, done = _one(start, sizes, problem, noise, weights, solver, max_steps)
        return _safe(start, value, misfit(value, (problem, noise, weights)), done)

    return jax.vmap(one)(starts)


def _one(
    start: Parameters,
    sizes: Parameters,
    problem: Problem,
    noise: Noise,
    weights: Any,
    solver: Any,
    max_steps: int,
) -> tuple[Parameters, Array]:
    least: Any = optx.least_squares
    out = least(
        _in_units,
        solver,
        jax.tree.map(jnp.zeros_like, start),
        (start, sizes, (problem, noise, weights)),
        options={"jac": "fwd"} if isinstance(solver, optx.AbstractLeastSquaresSolver) else {},
        max_steps=max_steps,
        throw=False,
    )
    return _stepped(start, sizes, out.value), out.result == optx.RESULTS.successful


_solve = eqx.filter_jit(_one)


def _stepped(start: Parameters, sizes: Parameters, steps: Parameters) -> Parameters:
    return jax.tree.map(lambda p, size, step: p + size * step, start, sizes, steps)


def _in_units(steps: Parameters, args: Any) -> Any:
    start, sizes, rest = args
    return residuals(_stepped(start, sizes, steps), rest)


def _safe(start: Parameters, value: Parameters, cost: Array, done: Array) -> Tried:
    # A wild step can end in NaN: the start is then the better point.
    lost = ~jnp.isfinite(cost)
    value = jax.tree.map(lambda a, b: jnp.where(lost, b, a), value, start)
    return Tried(value, jnp.where(lost, jnp.inf, cost), done & ~lost)


def cost_of(parameters: Parameters, problem: Problem, noise: Noise) -> float:
    """The misfit over the whole of the records."""
    whole = jnp.ones_like(problem.records.t)
    return float(_cost(parameters, problem, noise, whole, evaluate(parameters, problem)[0]))


def misfit(parameters: Parameters, args: Any) -> Float[Array, ""]:
    """Half the sum of the squares of all residuals."""
    return half_sum(residuals(parameters, args))


def half_sum(tree: Any) -> Float[Array, ""]:
    """Half the sum of the squares of all leaves."""
    return 0.5 * sum((jnp.sum(leaf**2) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))


def solver_for(tolerance: float) -> optx.LevenbergMarquardt:
    """Levenberg–Marquardt of optimistix that stops at steps of `tolerance` standard deviations.

    An array, so as not to compile again.
    """
    limit: Any = jnp.asarray(tolerance)
    return optx.LevenbergMarquardt(rtol=jnp.asarray(1e-12), atol=limit)  # pyright: ignore


def horizons(problem: Problem) -> tuple[Float[Array, "records times"], ...]:
    """Weights that show the first quarter, the first half and the whole of each record."""
    t = problem.records.t
    since, length = t - t[:, :1], t[:, -1:] - t[:, :1]
    return tuple((since <= part * length).astype(t.dtype) for part in HORIZONS)


def settle(
    tried: Tried,
    problem: Problem,
    noise: Noise,
    weights: Float[Array, "records times"],
    solver: Any,
    max_steps: int,
    look: Callable[[Tried, int, bool], None] = lambda tried, strides, over: None,
    *,
    near: bool = False,
    strides: int = 0,
) -> Tried:
    """Strides from where `tried` ended until one more of them changes nothing.

    A search that says it has converged may only have been damped too much: it has converged where a
    fresh start from there ends there. `tried.cost` is the misfit at its end, infinite if unknown;
    `near` says that it is near the bottom already; `strides` how many led to it. `look` is called
    after each, with how many there are by then and whether that was the last.
    """
    for first in range(strides * STRIDE, max_steps, STRIDE):
        before = float(tried.cost)
        count = min(STRIDE, max_steps)
        strides += 1
        bold = BOLD if first or near else CAREFUL
        after = least_squares(tried.parameters, problem, noise, weights, solver, count, bold)
        if not np.isfinite(float(after.cost)):
            # The motion was lost on the way: what is known is where this stride began.
            cost = jnp.asarray(cost_of(tried.parameters, problem, noise))
            tried = Tried(tried.parameters, cost, jnp.asarray(False))
            look(tried, strides, True)
            break
        tried = after
        # At the very bottom round-off refuses every step: whether it moved is what counts.
        settled = before - float(tried.cost) < SETTLED * (1.0 + abs(before))
        tried = Tried(tried.parameters, tried.cost, jnp.asarray(settled))
        look(tried, strides, settled or first + STRIDE >= max_steps)
        if settled:
            break
    return tried


def fresh(point: Parameters) -> Tried:
    """A start whose misfit is not known yet."""
    return Tried(point, jnp.asarray(jnp.inf), jnp.asarray(False))


def climb(
    start: Position,
    problem: Problem,
    noise: Noise,
    solver: Any,
    max_steps: int,
    *,
    look: Callable[[Position], None] = lambda position: None,
) -> Tried:
    """One start through the horizons; `look` is called after each stride with where it stands."""
    tried = start.tried
    for stage, seen in enumerate(horizons(problem)):
        if stage < start.stage:
            continue
        if stage < len(HORIZONS) - 1:
            # A part of the record need not be fitted to the end, only to come near.
            count, before = min(STRIDE, max_steps), tried.parameters
            after = least_squares(before, problem, noise, seen, solver, count, CAREFUL).parameters
            # What explains a part alone may be nonsense beyond it: a drag that drives.
            worse = cost_of(after, problem, noise) / max(cost_of(before, problem, noise), 1e-300)
            tried = fresh(after if worse < WILD else before)
            look(Position(stage + 1, 0, tried))
            continue

        def at_last(now: Tried, strides: int, over: bool, stage: int = stage) -> None:
            look(Position(stage + over, strides, now))

        done = start.strides if stage == start.stage else 0
        tried = settle(tried, problem, noise, seen, solver, max_steps, at_last, strides=done)
    return tried


def climb_together(
    points: Parameters, problem: Problem, noise: Noise, solver: Any, max_steps: int
) -> list[Tried]:
    """Many starts through the horizons in one `vmap` (a leading axis on `points`)."""
    tried = None
    stages = horizons(problem)
    for seen in stages:
        tried = many(points, problem, noise, seen, solver, max_steps)
        points = tried.parameters
    assert tried is not None
    count = int(tried.cost.shape[0])
    return [jax.tree.map(lambda leaf, i=i: leaf[i], tried) for i in range(count)]
