"""Compare a derivative with a difference of values, to show what the derivative does not see.

The effect of a torque that switches at a time or at a state depends on this time or state, but the
derivatives of `jnp.where`, `jnp.sign` and the like leave this dependence out. Two values, one on
each side of x, show it.
"""

import warnings
from collections.abc import Callable
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax import _checks

# The longest step relative to each number, by the bytes of one number. It is half of the change of
# length that a unit quaternion is accepted with.
_STEP = {8: 5e-7, 4: 5e-4}
# The least size of values, relative to their rise along x: a value may happen to be zero at x.
_SLOW = 1e-3
# The uncertainty of the values of a second run, relative to the error of the first run.
_CLOSER = 0.01
# The slopes count as different where their distance is this many times its uncertainty.
_UNSURE = 10.0


class Slopes(NamedTuple):
    """Hold the slopes of a function along one direction, in the shape of its value.

    **Fields:**

    - `derivative`: the slope by the derivative.
    - `difference`: the slope by a difference of values.
    - `differ`: whether the two slopes do not agree.
    - `ways`: how far each number of x moves in one unit of the direction.
    """

    derivative: Array
    difference: Array
    differ: Array
    ways: Any


def size_of(leaf: Array) -> Array:
    """Return the size of each number of an array: its absolute value, or 1 if all are zero.

    An array of zeros alone is taken as a small change of numbers whose size is not known here.
    """
    return jnp.where(jnp.all(leaf == 0), jnp.ones_like(leaf), jnp.abs(leaf))


@jax.jit
def sides_of(x: Any, value: Array, value_error: Array, derivative: Any) -> tuple[Array, Any]:
    """Return the length of a step, and the two points one step from `x` in a random direction.

    The points before and after `x` are stacked in a new first axis. `value`, `value_error` and
    `derivative` are those of the function at `x`.
    """
    rng = np.random.default_rng(2)

    def random_way(leaf: Array) -> Array:
        way = rng.uniform(0.5, 1.0, leaf.shape) * rng.choice([-1.0, 1.0], leaf.shape)
        if leaf.ndim > 1 and leaf.shape[-1] == leaf.shape[-2]:
            way = 0.5 * (way + np.swapaxes(way, -1, -2))
        size = size_of(leaf)
        return jnp.where(size == 0, jnp.max(size), size) * jnp.asarray(way, leaf.dtype)

    way = jax.tree.map(random_way, x)
    rise = jnp.max(jnp.abs(_change(derivative, way)))
    size = jnp.maximum(jnp.max(jnp.abs(value)), _SLOW * rise)
    unsure = jnp.maximum(jnp.max(value_error), float(jnp.finfo(value.dtype).eps) * size)
    # The values change by the geometric mean of their size and their uncertainty, unless the step
    # would be longer than `longest`.
    step = jnp.sqrt(unsure * size) / jnp.where(rise > 0, rise, 1)
    longest = _STEP[value.dtype.itemsize]
    step = jnp.where((rise > 0) & (step > 0), jnp.minimum(step, longest), longest)

    def both(leaf: Array, way: Array) -> Array:
        h = step.astype(leaf.dtype)
        return jnp.stack([leaf - h * way, leaf + h * way])

    return step, jax.tree.map(both, x, way)


def values_at(value: Callable[[Any, Any], Array], sides: Any, tolerances: Array) -> Array:
    """Return the values on both sides of x; NaN on a side whose known numbers the function refuses.

    Under `jit` the numbers are not known, and the function cannot refuse them.
    """
    if not _checks.is_known((sides, tolerances)):
        return lax.map(lambda x: value(x, tolerances), sides)
    values: list[Any] = []
    for side in (jax.tree.map(itemgetter(i), sides) for i in range(2)):
        try:
            values.append(value(side, tolerances))
        except RuntimeError:
            # A flat body is at the limit of what a body can be: one of the two sides is beyond it.
            values.append(np.nan)
    return jnp.stack(jnp.broadcast_arrays(*values))


@jax.jit
def slopes_of(x: Any, middle: Array, step: Array, sides: Any, values: Array, error: Any) -> Slopes:
    """Return the slope of a function by its derivative, and by its values on both sides of `x`.

    The derivative, and the errors of value and derivative, are those of the `FunctionError` that
    `error` is. `step` and `sides` are the results of `sides_of`, and `values` are the values at the
    two `sides`. `middle` is the value at `x` under the tolerances of `values`.
    """
    # The numbers of the sides have been rounded: their change is no longer along the direction.
    moved = jax.tree.map(lambda side, leaf: side - leaf[None], sides, x)
    rises = jax.vmap(lambda way: _change(error.derivative, way))(moved)
    there = jnp.isfinite(values)
    # A value that is missing is replaced by the other one, mirrored at `middle`.
    values = jnp.where(there, values, 2 * middle[None] - values[::-1])
    rises = jnp.where(there, rises, -rises[::-1])
    derivative, difference = ((a[1] - a[0]) / (2 * step) for a in (rises, values))
    bend = jnp.abs(values[0] + values[1] - 2 * middle)
    size, rise = jnp.max(jnp.abs(error.value)), jnp.max(jnp.abs(derivative))
    eps = jnp.finfo(error.value.dtype).eps
    unsure = jnp.max(bend + _CLOSER * error.value_error) + 8 * float(eps) * size
    ways = jax.tree.map(lambda side: jnp.abs(side[1] - side[0]) / (2 * step), sides)
    of_derivative = _change(error.derivative_error, ways)
    curved = rise * rise * step / jnp.maximum(size, _SLOW * rise)
    curved = jnp.where(rise > 0, curved, 0)
    allowed = _UNSURE * (unsure / step + of_derivative + curved)
    differ = jnp.abs(difference - derivative) > allowed
    return Slopes(derivative, difference, differ, ways)


@jax.jit
def errors_of_numbers(slopes: Slopes) -> Any:
    """Return the error of the derivative with respect to each number of x.

    The difference of the slopes is attributed to each number in full, as if it were the only cause.
    """
    slope = jnp.where(slopes.differ, jnp.abs(slopes.difference - slopes.derivative), 0)

    def of_leaf(way: Array) -> Array:
        inverse = 1 / jnp.where(way > 0, way, 1)
        return jnp.tensordot(slope, inverse.astype(slope.dtype), axes=0)

    return jax.tree.map(of_leaf, slopes.ways)


def warn_of_slopes(slopes: Slopes) -> None:
    """Warn that the derivative misses a change of values, if the slopes are known and differ."""
    if not _checks.is_known(slopes) or not np.any(slopes.differ):
        return
    index = np.argmax(np.ravel(slopes.differ))
    derivative, difference = (float(np.ravel(a)[index]) for a in slopes[:2])
    warnings.warn(
        f"error_of: along a random direction the derivative is {derivative:.6g}, and a difference "
        f"of values {difference:.6g}. The likely cause is a torque that switches at a time or a "
        "state which x moves (jnp.where, jnp.sign): derivatives do not see the switch. Take "
        "torques.Pulses or jump_times of the law for a switch by time; for one by state end the "
        "run at an Event and go on with another law",
        stacklevel=3,
    )


def _change(derivative: Any, way: Any) -> Array:
    """Return the change of the value for the change `way` of x: the derivative times `way`."""

    def of_leaf(derivative: Array, way: Array) -> Array:
        many = derivative.ndim - way.ndim
        way = way.reshape(*[1] * many, *way.shape)
        return jnp.sum(derivative * way, tuple(range(many, derivative.ndim)))

    return jnp.sum(jnp.stack(jax.tree.leaves(jax.tree.map(of_leaf, derivative, way))), 0)
