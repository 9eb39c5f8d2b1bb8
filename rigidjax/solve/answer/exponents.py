"""Compute Lyapunov exponents: the long-term growth rates of small errors in every direction."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._names import suggest_arguments
from rigidjax._types import ScalarLike
from rigidjax.motion.coupled import Coupled
from rigidjax.motion.equations import project_to_group
from rigidjax.motion.manifold import dimension, minus_small, plus
from rigidjax.solve.answer import validation
from rigidjax.solve.engine.adaptive import adaptive
from rigidjax.solve.steps.explicit import AbstractExplicit, require_explicit

# The growth rates in neighbouring intervals are not independent, so that their scatter does not
# give the error of an exponent. The error is computed from the means over this many long parts of
# the run instead.
_PARTS = 20


class Exponents(eqx.Module):
    """Hold the result of `lyapunov_exponents`.

    **Fields:**

    - `values`: (k,) the exponents, 1/s, the largest first.
    - `errors`: (k,) the error of each exponent, 1/s, one standard deviation. It combines, as the
      root of the sum of squares: the scatter of the means over twenty parts of the run; the effect
      of the intervals that belong to none of these parts; and the sum of the tolerances of all
      steps, divided by the time.
    - `times`: (N,) the ends of the intervals after the transient, s.
    - `running`: (N, k) the exponents, 1/s, of the run up to each of these times.
    - `state`: the state at the end of the run.
    - `result`: a `diffrax.RESULTS`: `successful`, or the reason why the run failed.

    >>> still = lambda t, y, args: jnp.array([0.5, -1.0]) * y
    >>> lyapunov_exponents(still, jnp.zeros(2), 40.0, intervals=40, transient=20).running.shape
    (20, 2)
    """

    values: Float[Array, " k"]
    errors: Float[Array, " k"]
    times: Float[Array, " N"]
    running: Float[Array, "N k"]
    state: Any
    result: dfx.RESULTS


@suggest_arguments
def lyapunov_exponents(
    field: Callable[..., Any],
    state0: Any,
    time: ScalarLike,
    *,
    number: int | None = None,
    intervals: int = 1000,
    transient: int = 100,
    t0: ScalarLike = 0.0,
    solver: AbstractExplicit | None = None,
    rtol: ScalarLike | None = None,
    atol: ScalarLike | None = None,
    max_steps: int = 100_000,
) -> Exponents:
    """Return the spectrum of Lyapunov exponents along a motion, the largest exponent first.

    Tangent vectors are small changes of the state; those of an attitude are small turns in body
    axes. An orthonormal frame of tangent vectors is solved along with the motion (continuous QR).
    The exponents are the mean rates at which these vectors would grow if they were not kept at
    length 1.

    **Arguments:**

    - `field`: a vector field `f(t, y, args)`: for example the result of
      `rj.equations_of_motion(body, state0, torque)`, `scene.field`, or a function of your own on
      any array or Module of one dtype.
    - `state0`: the state at `t0`.
    - `time`: the length of the run, s.
    - `number`: k, the number of exponents; `None` computes all, which are 6 for an `Attitude`.
    - `intervals`: the number of equal intervals into which the run is divided. At the end of each
      interval the frame is made orthonormal to round-off.
    - `transient`: the number of intervals at the beginning whose growth is not counted.
    - `t0`: the time at which the run begins, s.
    - `solver`, `rtol`, `atol`: as for `simulate`.
    - `max_steps`: the largest number of steps in one interval.

    Each conserved quantity gives an exponent of zero, and so does the direction of the motion
    itself. The computed value of such an exponent is not zero: it decreases with the length t of
    the run as (log t)/t. The estimated error of an exponent (`errors` of the result) does not
    include this trend; the exponents as they were after each interval (`running` of the result)
    show it.

    **Returns** an `Exponents`. Its numbers are NaN if the run fails, and `result` says why.

    Source: Dieci, Russell and Van Vleck 1997, doi:10.1137/S0036142993247311; for orthonormal
    frames: Christiansen and Rugh 1997, doi:10.1088/0951-7715/10/5/004.

    **Raises:** `TypeError` and `ValueError` for invalid arguments.

    >>> still = lambda t, y, args: jnp.array([0.5, -1.0]) * y
    >>> found = lyapunov_exponents(still, jnp.zeros(2), 40.0, intervals=40, transient=20)
    >>> [round(float(value), 9) for value in found.values]
    [0.5, -1.0]
    """
    _checks.require_function(field, "field", "f(t, y, args)")
    intervals = _checks.integer(intervals, "intervals", _PARTS)
    transient = _checks.integer(transient, "transient", 0)
    max_steps = _checks.integer(max_steps, "max_steps", 1)
    if intervals - transient < _PARTS:
        raise ValueError(
            f"intervals: wanted at least {_PARTS} after the transient, got {intervals} in all and "
            f"a transient of {transient}"
        )
    if not isinstance(state0, eqx.Module):
        state0 = _checks.numeric_array(state0, "state0")
    for leaf in jax.tree.leaves(state0):
        _checks.require_finite(_checks.numeric_array(leaf, "state0"), "state0")
    size = dimension(state0)
    if not size:
        raise ValueError("state0: wanted an array or a state that holds numbers, got an empty one")
    many = size if number is None else _checks.integer(number, "number", 1)
    if many > size:
        raise ValueError(
            f"number: wanted at most {size} exponents, one for each dimension of the state, got "
            f"{many}"
        )
    dtype = _checks.common_dtype(state0, "state0")
    length = _checks.checked_time(time, "time").astype(dtype)
    length = _checks.error_if(length, ~(length > 0), "time: wanted a positive time, s")
    rtol, atol = validation.checked_tolerances(rtol, atol, dtype)
    solver = require_explicit(solver)
    begin = _checks.checked_time(t0, "t0").astype(dtype)
    shapes = eqx.filter_eval_shape(lambda t, y: field(t, y, None), begin, state0)
    wanted, found = (jax.tree.map(jnp.shape, tree) for tree in (state0, shapes))
    if jax.tree.structure(shapes) != jax.tree.structure(state0) or found != wanted:
        raise TypeError(
            f"field: wanted dy/dt of the shape of state0, {wanted}, got {found}; it is called as "
            "f(t, y, None)"
        )
    how = (solver, many, intervals, transient, max_steps)
    return _exponents(how, field, state0, begin, length, rtol, atol)


def _product(a: Array, b: Array) -> Array:
    """Return the product `a @ b` of small matrices, in a form that XLA fuses with other code."""
    return jnp.sum(a[:, :, None] * b[None], 1)


@eqx.filter_jit
def _exponents(
    options: tuple[AbstractExplicit, int, int, int, int],
    field: Callable[..., Any],
    state0: Any,
    t0: Array,
    length: Array,
    rtol: Any,
    atol: Any,
) -> Exponents:
    """Return the Lyapunov exponents along a motion of the duration `length`.

    The static `options` are the solver, the number of exponents, the number of intervals, how many
    of them come before exponents are counted, and the `max_steps` of an interval.
    """
    # The options are no arrays: `filter_jit` takes them as static, and compiles again if one of
    # them changes.
    solver, many, intervals, transient, max_steps = options
    state0 = project_to_group(state0)
    step = length / intervals

    def along(t: Array, y: Coupled, args: None) -> Coupled:
        frame, _ = y.own
        slope = field(t, y.motion, args)

        def rate(change: Array) -> Array:
            near = plus(y.motion, change)
            both = (field(t, near, args), slope)
            return jax.jvp(minus_small, (near, y.motion), both)[1]

        # Small errors make the frame lose its orthonormality, and the equations of a frame that is
        # not orthonormal are unstable. This formula restores it, up to the square of the errors.
        frame = 1.5 * frame - 0.5 * _product(frame, _product(frame.T, frame))
        push = jax.linearize(rate, jnp.zeros(frame.shape[0], t.dtype))[1]
        pushed = jax.vmap(push, -1, -1)(frame)
        grown = _product(frame.T, pushed)
        upper = jnp.triu(grown) + jnp.tril(grown, -1).T
        return Coupled(slope, (pushed - _product(frame, upper), jnp.diagonal(grown)))

    def interval(carry: Any, i: Array) -> Any:
        state, frame = carry
        ts = t0 + jnp.stack([i, i + 1]).astype(t0.dtype) * step
        # The logarithm of the growth in an interval starts at 1, and 1 is subtracted at the end of
        # the interval. Near 0 a relative tolerance would ask for too many digits of the logarithm.
        # Near 1 it allows the error `rtol` of the logarithm, which is a relative error `rtol` of
        # the growth.
        start = Coupled(state, (frame, jnp.ones(many, t0.dtype)))
        run = adaptive(solver, along, ts, start, rtol=rtol, atol=atol, max_steps=max_steps)
        there = jax.tree.map(lambda leaf: leaf[-1], run.ys)
        frame, logs = there.own
        off = run.num_steps.astype(t0.dtype) * (rtol * (1 + jnp.abs(logs - 1)) + atol)
        return (there.motion, jnp.linalg.qr(frame)[0]), (logs - 1, off, run.result)

    # The tangent vectors at the start have random directions. Along the axes of the state they
    # could lie in a subspace that no tangent vector leaves, and would not show the growth outside
    # of it.
    shape = (dimension(state0), many)
    frame = jnp.linalg.qr(jax.random.normal(jax.random.key(0), shape, t0.dtype))[0]
    numbers = jnp.arange(intervals, dtype=jnp.int32)
    (state, _), (logs, off, results) = lax.scan(interval, (state0, frame), numbers)
    rates = logs[transient:] / step
    count = rates.shape[0]
    times = t0 + jnp.arange(transient + 1, intervals + 1).astype(t0.dtype) * step
    running = jnp.cumsum(rates, axis=0) / jnp.arange(1, count + 1).astype(t0.dtype)[:, None]
    whole = count // _PARTS * _PARTS
    means = jnp.mean(rates[count - whole :].reshape(_PARTS, -1, many), axis=1)
    apart = jnp.var(means, axis=0, ddof=1) / _PARTS
    # Twenty equal parts leave out up to 19 intervals, the first after the transient. The amount by
    # which these intervals change the mean is one of the errors whose squares are added.
    left = running[-1] - jnp.mean(means, axis=0)
    errors = jnp.sqrt(apart + left**2 + (jnp.mean(off[transient:], axis=0) / step) ** 2)
    first = jnp.argmax(jax.vmap(lambda result: result != dfx.RESULTS.successful)(results))
    result = jax.tree.map(lambda leaf: leaf[first], results)
    return Exponents(running[-1], errors, times, running, state, result)
