"""Compare a derivative with a finite difference, to show what the derivative leaves out.

If a torque switches at a certain time or state, the motion depends on this time or state, but the
derivatives of `jnp.where`, `jnp.sign` and similar functions leave this dependence out. A difference
of two values of the function that is differentiated includes it. One value is taken on each side of
x, the argument of the function.
"""

import warnings
from collections.abc import Callable
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree

from rigidjax import _checks

# The step from x to each of the two points of the difference is at most this fraction of each
# number of x, for float64 and for float32. It is half of the error of |q| up to which a quaternion
# q is accepted as a unit quaternion, so that a quaternion in x stays acceptable.
_STEP = {8: 5e-7, 4: 5e-4}
# The value of the function may happen to be zero at x, and then does not show its usual size. The
# size is therefore taken to be at least this fraction of the change of the value when each number
# of x changes by its own size.
_SLOW = 1e-3
# `error_of` computes the function at x with given tolerances, and again with smaller ones. The
# values at the two points are computed with the smaller ones. Their error is taken to be this
# fraction of the error that the value at x has with the given tolerances.
_CLOSER = 0.01
# Two slopes count as different if their difference is more than this many times its uncertainty.
_UNSURE = 10.0


class Slopes(NamedTuple):
    """Hold two slopes of a function f at a point x along one direction.

    The slope is the change of f(x) divided by the length of the step in this direction.
    """

    derivative: Array  # the slope by the derivative, in the shape of f(x)
    difference: Array  # the slope by a difference of values, in the shape of f(x)
    differ: Array  # for each number of f(x), whether its slopes differ clearly
    direction: Any  # like x: |change of each number| over the length of the step


def absolute_or_one_if_all_zero(array: Array) -> Array:
    """Return the natural size of each number of an array: its absolute value; 1 if all are zero."""
    return jnp.where(jnp.all(array == 0), jnp.ones_like(array), jnp.abs(array))


@jax.jit
def step_and_two_points(
    x: PyTree, value: Array, value_error: Array, derivative: PyTree
) -> tuple[Array, PyTree]:
    """Return the length h of a step, and the two points x − h d and x + h d, where d is random.

    The length is relative to the sizes of the numbers of `x`; the points stand in a new first axis
    of each array. The values of a function there give its slope along d.
    """
    rng = np.random.default_rng(2)

    def random_way(leaf: Array) -> Array:
        way = rng.uniform(0.5, 1.0, leaf.shape) * rng.choice([-1.0, 1.0], leaf.shape)
        if leaf.ndim > 1 and leaf.shape[-1] == leaf.shape[-2]:
            way = 0.5 * (way + np.swapaxes(way, -1, -2))
        size = absolute_or_one_if_all_zero(leaf)
        return jnp.where(size == 0, jnp.max(size), size) * jnp.asarray(way, leaf.dtype)

    way = jax.tree.map(random_way, x)
    rise = jnp.max(jnp.abs(_directional_change(derivative, way)))
    size = jnp.maximum(jnp.max(jnp.abs(value)), _SLOW * rise)
    unsure = jnp.maximum(jnp.max(value_error), float(jnp.finfo(value.dtype).eps) * size)
    # The length of the step is chosen such that the value changes by the geometric mean of its size
    # and its uncertainty; but no step is longer than `longest`.
    step = jnp.sqrt(unsure * size) / jnp.where(rise > 0, rise, 1)
    longest = _STEP[value.dtype.itemsize]
    step = jnp.where((rise > 0) & (step > 0), jnp.minimum(step, longest), longest)

    def both(leaf: Array, way: Array) -> Array:
        h = step.astype(leaf.dtype)
        return jnp.stack([leaf - h * way, leaf + h * way])

    return step, jax.tree.map(both, x, way)


def values_at_two_points(
    function: Callable[[Any, Array], Array], points: PyTree, tolerances: Array
) -> Array:
    """Return the values `function(x, tolerances)` at two `points`, in the first axis of each array.

    The value is NaN at a point for which the function raises a `RuntimeError`, because the point is
    no valid argument. Under `jit` the numbers of the points are not known, and no error is raised.
    """
    if not _checks.is_known((points, tolerances)):
        return lax.map(lambda x: function(x, tolerances), points)
    values: list[Any] = []
    for side in (jax.tree.map(itemgetter(i), points) for i in range(2)):
        try:
            values.append(function(side, tolerances))
        except RuntimeError:
            # The inertia of a flat body is at the limit of what a real body can have. If x is such
            # an inertia, one of the two points on both sides of x is beyond this limit.
            values.append(np.nan)
    return jnp.stack(jnp.broadcast_arrays(*values))


@jax.jit
def derivative_and_difference(
    x: PyTree, value_at_x: Array, step: Array, points: PyTree, values: Array, error: Any
) -> Slopes:
    """Return the slope of a function along one line through `x`, by its derivative and by a
    difference of its values at two `points` on both sides of `x`.

    The points stand in a new first axis of each array, at the distance `step`, relative to the
    sizes of the numbers of `x`. All values are computed with the same tolerances, and are NaN at a
    point that the function refuses; `error` is the `FunctionError` at `x`.
    """
    # The numbers of the two points have been rounded, so that the way from `x` to them is not
    # exactly along the wanted direction. The derivative is therefore taken along the true way.
    moved = jax.tree.map(lambda side, leaf: side - leaf[None], points, x)
    rises = jax.vmap(lambda way: _directional_change(error.derivative, way))(moved)
    there = jnp.isfinite(values)
    # If the function refuses one of the points, the value there is replaced by 2 `value_at_x` minus
    # the other value, so that the slope is that between `x` and the other point.
    values = jnp.where(there, values, 2 * value_at_x[None] - values[::-1])
    rises = jnp.where(there, rises, -rises[::-1])
    derivative, difference = ((a[1] - a[0]) / (2 * step) for a in (rises, values))
    bend = jnp.abs(values[0] + values[1] - 2 * value_at_x)
    size, rise = jnp.max(jnp.abs(error.value)), jnp.max(jnp.abs(derivative))
    eps = jnp.finfo(error.value.dtype).eps
    unsure = jnp.max(bend + _CLOSER * error.value_error) + 8 * float(eps) * size
    direction = jax.tree.map(lambda side: jnp.abs(side[1] - side[0]) / (2 * step), points)
    of_derivative = _directional_change(error.derivative_error, direction)
    curved = rise * rise * step / jnp.maximum(size, _SLOW * rise)
    curved = jnp.where(rise > 0, curved, 0)
    allowed = _UNSURE * (unsure / step + of_derivative + curved)
    differ = jnp.abs(difference - derivative) > allowed
    return Slopes(derivative, difference, differ, direction)


@jax.jit
def derivative_error_from_slopes(slopes: Slopes) -> PyTree:
    """Return the error of a function's derivative by each number of its argument, from two slopes.

    The whole difference of the slopes may come from any one of these derivatives: the error of each
    is so large that it alone explains the difference, and 0 where the slopes agree. The axes of an
    array are those of the value, then those of the array in x.
    """
    slope = jnp.where(slopes.differ, jnp.abs(slopes.difference - slopes.derivative), 0)

    def of_leaf(way: Array) -> Array:
        inverse = 1 / jnp.where(way > 0, way, 1)
        return jnp.tensordot(slope, inverse.astype(slope.dtype), axes=0)

    return jax.tree.map(of_leaf, slopes.direction)


def warn_if_slopes_differ(slopes: Slopes) -> None:
    """Warn that a derivative misses something if the two slopes of a function differ.

    Nothing is compared under `jit`, where the slopes are not known.
    """
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


def _directional_change(derivative: PyTree, direction: PyTree) -> Array:
    """Return df/dx · direction, the change of f(x) if x changes by `direction`.

    The axes of an array of df/dx are those of f(x), then those of the array in x.
    """

    def of_leaf(derivative: Array, direction: Array) -> Array:
        many = derivative.ndim - direction.ndim
        direction = direction.reshape(*[1] * many, *direction.shape)
        return jnp.sum(derivative * direction, tuple(range(many, derivative.ndim)))

    return jnp.sum(jnp.stack(jax.tree.leaves(jax.tree.map(of_leaf, derivative, direction))), 0)
