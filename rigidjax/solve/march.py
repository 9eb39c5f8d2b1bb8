"""Steps as long as the tolerances allow, written down in blocks.

XLA on CPU makes one kernel of a loop whose state is smaller than a kilobyte. So the inner loop
writes a few steps into a block that small, and an outer one copies blocks into the record.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve.explicit import Atoms
from rigidjax.solve.together import anywhere

# What diffrax.PIDController does unless told: the same steps, so that figures can be compared.
_SAFETY, _SMALLEST, _LARGEST = 0.9, 0.2, 10.0
# Bytes that a block may take: the state, the counters and the field's own numbers come beside it.
_BLOCK = 560


class Stops(NamedTuple):
    """Times that steps end on, s: where the next step begins, and the last moment before it.

    At a jump of the torque the two differ by one unit in the last place: a stage at the end of a
    step sees the torque before the jump, the first of the next the one after.
    """

    begin: Array
    end: Array


class Control(NamedTuple):
    """Tolerances, order of the estimate, and when to give up.

    `least` s: where t is nought, so is its round-off; then that of the run's length counts.
    """

    rtol: Any
    atol: Any
    least: Any
    order: int
    max_steps: int


class Walk(NamedTuple):
    """Where the loop is."""

    t: Array
    h: Array
    y: Atoms
    stop: Array
    steps: Array
    rejected: Array


class Rows(NamedTuple):
    """Accepted steps: their start, length, and state at the start; the stop ahead.

    `code` is twice the index of that stop, and one more for the step that ends on it.
    """

    t: Array
    h: Array
    y: Array
    code: Array


Step = Callable[[Any, Any, Any, Atoms], tuple[Atoms, Atoms]]


def start(t0: Array, h0: Array, y0: Atoms) -> Walk:
    """A loop about to begin."""
    zero = jnp.zeros((), jnp.int32)
    return Walk(t0, h0, y0, zero, zero, zero)


def going(walk: Walk, stops: Stops, control: Control) -> Array:
    """Whether there is a way to go, and a step to take."""
    ahead = walk.stop < stops.begin.shape[0]
    return ahead & (walk.steps < control.max_steps) & (walk.h > 0)


def _one(step: Step, control: Control, walk: Walk, begin: Array, end: Array) -> tuple[Walk, Any]:
    left = end - walk.t
    # The step kept is the controller's own, not the one cut short at a stop.
    last = walk.h >= left
    h = jnp.where(last, left, walk.h)
    late = jnp.where(last, end, walk.t + h)
    y, error = step(walk.t, late, h, walk.y)
    size = size_of(error, walk.y, y, control.rtol, control.atol)
    # NaN in a step too long says as little as infinity: try a shorter one.
    size = jnp.where(jnp.isnan(size), jnp.full_like(size, jnp.inf), size)
    accept = size < 1
    factor = jnp.clip(_SAFETY * size ** (-1 / control.order), _SMALLEST, _LARGEST)
    following = lax.stop_gradient(h * factor.astype(h.dtype))
    following = jnp.where(last & accept, jnp.maximum(following, walk.h), following)
    # Where no step is left to try the loop ends: h = 0, or NaN where it met one.
    unit = 8 * jnp.finfo(h.dtype).eps * jnp.maximum(jnp.abs(walk.t), control.least)
    why = jnp.where(jnp.isfinite(size), 0.0, jnp.nan).astype(h.dtype)
    following = jnp.where(~accept & ~(following > unit), why, following)
    after = Walk(
        jnp.where(accept, jnp.where(last, begin, late), walk.t),
        following,
        tuple(jnp.where(accept, b, a) for a, b in zip(walk.y, y, strict=True)),
        walk.stop,
        walk.steps + 1,
        walk.rejected + jnp.where(accept, 0, 1),
    )
    return after, (h, last, accept)


def unrecorded(step: Step, control: Control, stops: Stops, walk: Walk) -> Walk:
    """The state at the last stop, or where the loop gave up."""

    def leg(walk: Walk, ends: Stops) -> tuple[Walk, None]:
        def go_on(walk: Walk) -> Array:
            return (walk.t < ends.begin) & (walk.steps < control.max_steps) & (walk.h > 0)

        def body(walk: Walk) -> Walk:
            return _one(step, control, walk, ends.begin, ends.end)[0]

        walk = lax.while_loop(go_on, body, walk)
        return walk._replace(stop=walk.stop + jnp.where(walk.t >= ends.begin, 1, 0)), None

    return lax.scan(leg, walk, stops)[0]


def block_size(y0: Atoms) -> int:
    """How many steps a block holds."""
    return max(1, min(8, _BLOCK // (y0[0].dtype.itemsize * (len(y0) + 2) + 4)))


def empty(walk: Walk, room: int) -> Rows:
    """Space for `room` steps, and for a block that those who are through write in vain."""
    return _rows(walk, room + block_size(walk.y))


def recorded(
    step: Step, control: Control, stops: Stops, walk: Walk, rows: Rows, count: Array
) -> tuple[Walk, Rows, Array]:
    """As many steps from here on as there is room for, after `count`; and how many there are now.

    Less than a block stays free. A walk that has nowhere to go leaves all as it was.
    """
    size = block_size(walk.y)
    room = rows.t.shape[0] - size

    def more(state: Any) -> Array:
        walk, _, count = state
        return going(walk, stops, control) & (count + size <= room)

    def block(state: Any) -> Any:
        walk, rows, count = state
        alive = more(state)
        index = jnp.minimum(walk.stop, stops.begin.shape[0] - 1)
        begin, end = stops.begin[index], stops.end[index]

        def go_on(state: Any) -> Array:
            walk, _, many = state
            able = alive & (walk.steps < control.max_steps) & (walk.h > 0)
            return able & (walk.t < begin) & (many < size)

        def body(state: Any) -> Any:
            walk, rows, many = state
            after, (h, last, accept) = _one(step, control, walk, begin, end)
            # A step refused is overwritten by the next.
            code = 2 * walk.stop + last.astype(jnp.int32)
            row = Rows(walk.t, h, jnp.stack(walk.y), code)
            rows = jax.tree.map(lambda a, b: a.at[many].set(b), rows, row)
            return after, rows, many + accept.astype(jnp.int32)

        few = _rows(walk, size)
        walk, few, many = lax.while_loop(go_on, body, (walk, few, jnp.zeros((), jnp.int32)))
        rows = jax.tree.map(lambda a, b: lax.dynamic_update_slice_in_dim(a, b, count, 0), rows, few)
        reached = (alive & (walk.t >= begin)).astype(jnp.int32)
        return walk._replace(stop=walk.stop + reached), rows, count + many

    return lax.while_loop(lambda state: anywhere(more(state)), block, (walk, rows, count))


def _rows(walk: Walk, many: int) -> Rows:
    none = jnp.zeros(many, walk.t.dtype)
    return Rows(
        none,
        none,
        jnp.zeros((many, len(walk.y)), walk.y[0].dtype),
        jnp.zeros(many, jnp.int32),
    )


def size_of(error: Atoms, left: Atoms, right: Atoms, rtol: Any, atol: Any) -> Array:
    """Root mean square of error over tolerance, as `diffrax.PIDController` takes it."""
    total = jnp.zeros((), error[0].dtype)
    for e, a, b in zip(error, left, right, strict=True):
        scale = jnp.asarray(atol, e.dtype) + jnp.asarray(rtol, e.dtype) * jnp.maximum(
            jnp.abs(a), jnp.abs(b)
        )
        total = total + (e / scale) ** 2
    tiny = float(jnp.finfo(total.dtype).tiny)
    return lax.stop_gradient(jnp.sqrt(total / len(error) + tiny))
