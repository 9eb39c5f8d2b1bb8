"""Define sensor errors that drift during a recording, which the filter follows."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import NumbersLike
from rigidjax.identify.model.free import leaf_at, overlap
from rigidjax.identify.model.scene import Scene


class Walk(eqx.Module):
    """Define an unknown sensor error x that drifts as a random walk, `dx = √density dW`, where W is
    a Wiener process.

    **Arguments:**

    - `where`: a function that picks the error from a `Scene`, such as
      `lambda s: s.sensors[0].bias`. The value in the scene is the initial value.
    - `deviation`: the standard deviation of the initial value, in the unit of the error, one number
      or one for each component.
    - `density`: the variance by which the error spreads in a second, in the square of its unit per
      second, one number or one for each component; zero for a constant error.

    **Raises** `ValueError` for a deviation or density below zero.

    >>> Walk(lambda s: s.sensors[0].bias, 0.01).density.tolist()
    0.0
    """

    where: Callable[[Scene], Any] = eqx.field(static=True)
    deviation: Array
    density: Array

    def __init__(
        self, where: Callable[[Scene], Any], deviation: NumbersLike, density: NumbersLike = 0.0
    ):
        words = "of a scene, such as lambda s: s.sensors[0].bias"
        self.where = _checks.require_function(where, "where", words)
        self.deviation = nonnegative(deviation, "deviation")
        self.density = nonnegative(density, "density")


class Drift(eqx.Module):
    """Hold a `Walk` together with the path of its leaf in a `Scene`.

    It contains no function: a new `where` in a second model would force a new compilation.
    """

    path: tuple[Any, ...] = eqx.field(static=True)
    # Those of the `Walk`, broadcast to the shape of the leaf.
    deviation: Float[Array, "*shape"]
    density: Float[Array, "*shape"]


def find_drifts(walks: Walk | Sequence[Walk], scene: Scene) -> tuple[Drift, ...]:
    """Return the `Drift` of each `Walk`; two of them may not pick the same numbers."""
    wanted = "a sequence of Walk(where, deviation)"
    _checks.require_instance(walks, (Walk, Sequence), "walks", requirement=wanted)
    drifts: list[Drift] = []
    for walk in (walks,) if isinstance(walks, Walk) else tuple(walks):
        _checks.require_instance(walk, Walk, "walks", requirement=wanted)
        path, value = leaf_at(walk.where, scene, "Walk", "the sensor")
        if path[0].name != "sensors":
            raise ValueError(
                f"Walk: wanted a number of a sensor, such as s.sensors[0].bias, got one of the "
                f"{path[0].name}; give an unknown torque as process="
            )
        if any(overlap(drift.path, path) for drift in drifts):
            raise ValueError("Walk: another Walk moves the same numbers; give each array one Walk")
        value = jnp.asarray(value)
        parts = (
            broadcast_to(number, value.shape, name).astype(value.dtype)
            for number, name in ((walk.deviation, "deviation"), (walk.density, "density"))
        )
        drifts.append(Drift(path, *parts))
    return tuple(drifts)


def nonnegative(value: NumbersLike, name: str) -> Array:
    """Return `value` as an array, after a check that its numbers are finite and not below zero."""
    array, wanted = _checks.numeric_array(value, name), "a finite number that is not below zero"
    if not array.size:
        raise ValueError(f"{name}: wanted {wanted}, got none")
    return _checks.require_positive(array, name, wanted, allow_zero=True)


def broadcast_to(value: NumbersLike, shape: tuple[int, ...], name: str) -> Array:
    """Return `value`, one number or an array of this `shape`, as an array of this `shape`.

    An error is raised as by `nonnegative`.
    """
    numbers = nonnegative(value, name)
    if numbers.shape not in ((), shape):
        raise ValueError(f"{name}: wanted one number or shape {shape}, got {numbers.shape}")
    return jnp.broadcast_to(numbers, shape)
