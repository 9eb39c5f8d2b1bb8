"""The errors of all readings, and their derivatives recording by recording."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from rigidjax.identify import padding
from rigidjax.identify.body_charts import Bodies, matter
from rigidjax.identify.parameters import Parameters, by_slot, columns, local, places, put
from rigidjax.identify.propagation import errors_along, sensor_inputs, states_at, what_turns
from rigidjax.identify.recording import Recording
from rigidjax.identify.reference_states import ReferenceStates
from rigidjax.motion.coupled import motion_of
from rigidjax.rotation.barrier import batched_as

if TYPE_CHECKING:
    from rigidjax.identify.problem import Problem


# The index of a recording's body; `None` of one body.
Which = Array | None


def filled(problem: "Problem", mine: Parameters, record: Recording) -> Recording:
    """One recording with the values of the free numbers in it."""
    values = [
        slot.move(slot.read(record), step)
        for slot, step in zip(problem.slots, mine.shared, strict=True)
    ]
    return put(record, problem.slots, values)


def states_of_one(
    problem: "Problem", mine: Parameters, record: Recording, ref: ReferenceStates, which: Which
) -> tuple[Recording, Any, Any, Any]:
    """One recording with its values filled in, its body, initial state and states."""
    record = filled(problem, mine, record)
    body = matter(problem.body, mine.body, which)
    state0 = ref.moved(mine.own)
    turned = what_turns(body, problem.rung)
    states = states_at(problem.integrator, turned, state0, record.t, record.torque)
    return record, body, state0, states


def errors_of_one(
    problem: "Problem",
    mine: Parameters,
    record: Recording,
    ref: ReferenceStates,
    which: Which,
    late: Array | None = None,
) -> tuple[tuple[Array, ...], Any]:
    """The errors (T, k) of each sensor in one recording, all clocks `late` s more behind, and the
    last state.
    """
    record, body, state0, states = states_of_one(problem, mine, record, ref, which)
    out, motion = [], (body, record.torque, record.t, state0, states)
    for reading in record.readings:
        sensor = reading.sensor
        errors = errors_along(sensor, reading.values, *sensor_inputs(sensor, *motion, late))
        out.append(jnp.where(reading.mask[:, None], errors, 0.0))
    return tuple(out), jax.tree.map(lambda leaf: leaf[-1], motion_of(states))


def over_records(function: Any, problem: "Problem", mine: Any) -> Any:
    """`function(mine, record, reference, which)` of every recording.

    On a CPU one after another: XLA makes one kernel of a loop over a few dozen numbers, and scalars
    within an inner loop run at half the speed.
    """
    trees = mine, problem.records, problem.reference, problem.which
    if problem.count == 1:
        # Without the outer loop it compiles to a smaller program.
        out = function(*(padding.one(tree, 0) for tree in trees))
        return jax.tree.map(lambda leaf: leaf[None], out)
    arrays, rest = eqx.partition(trees, eqx.is_array)
    of_one = lambda each: function(*eqx.combine(each, rest))  # noqa: E731
    if jax.default_backend() == "cpu":
        return lax.map(of_one, arrays, batch_size=1)
    return jax.vmap(of_one)(arrays)


@eqx.filter_custom_jvp
def all_errors(parameters: Parameters, problem: "Problem") -> tuple[tuple[Array, ...], Any]:
    """The errors (R, T, k) of each sensor, and the last states; derivatives by recordings."""

    def of_one(*trees: Any) -> Any:
        return errors_of_one(problem, *trees)

    return batched_as(over_records(of_one, problem, local(problem, parameters)), parameters)


@all_errors.def_jvp
def _all_errors_jvp(primals: Any, tangents: Any) -> Any:
    parameters, problem = primals
    step, beside = tangents
    if jax.tree.leaves(beside):
        raise TypeError(
            "all_errors: only derivatives in the parameters are taken block by block; use "
            "errors_of_one for those in the problem"
        )
    out, blocks = with_blocks(parameters, problem)
    zeros = jax.tree.map(
        lambda p, s: jnp.zeros_like(p) if s is None and p is not None else s,
        parameters,
        step,
        is_leaf=lambda node: node is None,
    )
    return batched_as(out, parameters), along(problem, blocks, zeros)


@eqx.filter_jit
def changes(parameters: Parameters, problem: "Problem") -> tuple[Float[Array, "..."], ...]:
    """The time derivative (R, T, k) of the errors of each sensor."""

    def of_one(*trees: Any) -> Any:
        now = jnp.zeros((), problem.records.t.dtype)
        return jax.jvp(lambda s: errors_of_one(problem, *trees, late=s)[0], (now,), (now + 1,))[1]

    return over_records(of_one, problem, local(problem, parameters))


def along(problem: "Problem", blocks: Any, step: Parameters) -> Any:
    """The derivatives of `with_blocks` along a step of all parameters."""
    flat = ravel_pytree(step)[0]
    where = places(problem, step)
    moved = jnp.concatenate([flat, jnp.zeros(1, flat.dtype)])[where]
    return jax.tree.map(lambda block: jnp.einsum("r...n,rn->r...", block, moved), blocks)


def with_blocks(parameters: Parameters, problem: "Problem") -> tuple[Any, Any]:
    """Errors and last states, and derivatives (…, n) in the numbers of a recording (`places`)."""
    mine = local(problem, parameters)
    single = padding.one(mine, 0)
    twice = columns(problem, single)

    def of_one(one: Parameters, record: Recording, ref: ReferenceStates, which: Which) -> Any:
        flat, restore = ravel_pytree(one)
        blocks, out = with_jacobian(
            lambda vector: errors_of_one(problem, restore(vector), record, ref, which), flat
        )
        if twice.size > flat.size:
            blocks = jax.tree.map(lambda block: block[..., twice], blocks)
        return out, blocks

    return over_records(of_one, problem, mine)


def with_jacobian(function: Callable[[Array], Any], at: Float[Array, " n"]) -> tuple[Any, Any]:
    """The derivative (…, n) of a function, in forward mode, and its value (…)."""

    def twice(at: Array) -> tuple[Any, Any]:
        found = function(at)
        return found, found

    return jax.jacfwd(twice, has_aux=True)(at)


# One (R, k) for each sensor: R recordings, k components.
Noise = tuple[Float[Array, "records _"], ...]


def whitened(problem: "Problem", errors: tuple, noise: Noise) -> tuple[Float[Array, "..."], ...]:
    """Errors in standard deviations, (R, T, k) for each sensor: see `standardised`."""
    out = []
    for reading, error, sigma in zip(problem.records.readings, errors, noise, strict=True):
        limit = getattr(reading.sensor, "limit", None)
        given = reading.values, reading.mask, error, sigma, limit, reading.late
        out.append(jax.vmap(standardised)(*given)[0])
    return tuple(out)


def independent(
    e: Float[Array, "*rows k"], v: Float[Array, "*rows k"]
) -> tuple[Float[Array, "*rows k"], Float[Array, "*rows k"]]:
    """Errors of covariance `1 + v vᵀ` made independent, of variance one: `L⁻¹ e`, L the factor of
    Cholesky; and the logarithms of its squared diagonal, the variance of each given those before.
    """
    told, total = jnp.cumsum(v * e, axis=-1), 1.0 + jnp.cumsum(v * v, axis=-1)
    none = jnp.zeros_like(total[..., :1])
    told = jnp.concatenate([none, told[..., :-1]], axis=-1)
    before = jnp.concatenate([none + 1.0, total[..., :-1]], axis=-1)
    return (e - v * told / before) * jnp.sqrt(before / total), jnp.log(total / before)


def in_deviations(x: Any, sigma: Array, late: Array | None) -> Float[Array, "..."]:
    """Changes (R, T, k, n) of a sensor's errors in standard deviations, as `standardised`."""
    x = x / sigma[:, None, :, None]
    if late is None:
        return x
    return jax.vmap(lambda e: independent(e, late / sigma[:, None])[0], -1, -1)(x)


def standardised(
    values: Float[Array, "times *components"],
    mask: Bool[Array, " times"],
    error: Float[Array, "times k"],
    sigma: Float[Array, " k"],
    limit: Float[Array, " k"] | None,
    late: Float[Array, "times k"] | None,
) -> tuple[Float[Array, "times k"], Bool[Array, "times k"], Float[Array, "times k"] | None]:
    """Errors in standard deviations, and the mask of saturated channels: these say "at least that
    much", and count as `√(−2 log Φ(z))`, z the prediction's excess over the limit (Tobin 1958,
    doi:10.2307/1907382). `late` is the error by a time stamp one standard deviation off; the last
    part is the logarithm of what it multiplies the variances by.
    """
    scaled, wider = error / sigma[None], None
    full = jnp.zeros(scaled.shape, bool)
    if limit is not None:
        full = (jnp.abs(values) >= limit[None] * (1 - 1e-6)) & mask[:, None]
    if late is not None:
        v = late / sigma[None]
        # A channel at full scale hardly shows the time.
        white, wider = independent(scaled, jnp.where(full, 0.0, v))
        scaled = jnp.where(full, scaled / jnp.sqrt(1.0 + v * v), white)
    if limit is None:
        return scaled, full, wider
    side = jnp.sign(values)
    z = jnp.where(full, -side * scaled, 0.0)
    # The term vanishes beyond five standard deviations, and the root has no derivative there.
    root = jnp.sqrt(-2.0 * jax.scipy.special.log_ndtr(jnp.minimum(z, 5.0)))
    return jnp.where(full, -side * jnp.where(z < 5.0, root, 0.0), scaled), full, wider


def residuals(parameters: Parameters, args: Any) -> Any:
    """All residuals of a fit, as a tree, of `args`: problem, noise of sensors, weights (R, T)."""
    problem, noise, weights = args
    errors, ends = all_errors(parameters, problem)
    return seen(problem, errors, noise, weights), beside(parameters, problem, ends)


def seen(problem: "Problem", errors: tuple, noise: Noise, weights: Array) -> tuple[Array, ...]:
    """The readings' residuals (R, T, k) for least squares."""
    read = []
    for scaled in whitened(problem, errors, noise):
        if problem.loss is not None:
            scaled = jax.vmap(jax.vmap(problem.loss.shrink))(scaled)
        read.append(scaled * weights[..., None])
    return tuple(read)


def with_rows(of: Callable[[tuple], tuple], errors: tuple, blocks: tuple) -> tuple[tuple, tuple]:
    """`of(errors)`, and its derivatives (R, T, k, n) of those of the errors, `blocks`."""
    # Each residual depends on the errors of its reading alone: a product of small matrices.
    read, push = jax.linearize(of, errors)
    return read, jax.vmap(push, in_axes=-1, out_axes=-1)(blocks)


def beside(parameters: Parameters, problem: "Problem", ends: Any) -> tuple[Array, ...]:
    """Residuals that are no readings: of `firm`, and those of `linked`."""
    pulled = jax.tree.map(jnp.multiply, firm(parameters, problem), parameters)
    return (*jax.tree.leaves(pulled), *linked(parameters, problem, ends))


def firm(parameters: Parameters, problem: "Problem") -> Parameters:
    """One over the deviation of each number about zero, by its prior or spread; zero without."""
    shared, each = [], []
    for slot, of_all, of_each in by_slot(problem, parameters):
        if of_all is not None:
            shared.append(_pull(of_all, slot.prior))
        if of_each is not None:
            each.append(_pull(of_each, slot.prior if of_all is None else slot.spread))
    none = jax.tree.map(jnp.zeros_like, parameters)
    return eqx.tree_at(lambda p: (p.shared, p.own.each), none, (tuple(shared), tuple(each)))


def _pull(number: Array, width: Array | None) -> Array:
    return jnp.zeros_like(number) if width is None else jnp.ones_like(number) / width


def linked(parameters: Parameters, problem: "Problem", ends: Any) -> tuple[Array, ...]:
    """Residuals of several numbers at once: the prior of the body, and the problem's own rows."""
    out = []
    if problem.prior is not None:
        assert not isinstance(problem.body, Bodies)
        body = problem.body.body(parameters.body)
        out.append(problem.prior.residuals(body, scaled=problem.body.unit != ""))
    if problem.rows is not None:
        out.append(problem.rows(problem, parameters, ends))
    return tuple(out)


def weights_of(problem: "Problem", errors: tuple, noise: Noise) -> tuple[Float[Array, "..."], ...]:
    """The weight (R, T) of each reading in the normal equations: the loss's, zero if masked."""
    masks = [reading.mask for reading in problem.records.readings]
    if problem.loss is None:
        return tuple(mask.astype(e.dtype) for mask, e in zip(masks, errors, strict=True))
    weight = jax.vmap(jax.vmap(problem.loss.weight))
    scaled = whitened(problem, errors, noise)
    return tuple(jnp.where(mask, weight(e), 0.0) for mask, e in zip(masks, scaled, strict=True))


def half_sum(tree: Any) -> Float[Array, ""]:
    """Half the sum of the squares of all leaves."""
    return 0.5 * sum((jnp.sum(leaf**2) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))
