"""Families of periodic orbits, continued by the derivatives of the orbit; their stability."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.orbits.differential_correction import (
    PeriodicOrbit,
    corrected,
    crossing,
    miss,
    named,
    newton,
    orbit_of,
    together,
    usual_tolerance,
    value_and_jacobian,
)


def at_values(scene: Any, orbit: PeriodicOrbit, values: Any, hold: str) -> PeriodicOrbit:
    """The members of a family at given values of one number: see `ThreeBody.family`."""
    start, index = crossing(orbit), named(hold)
    length = np.shape(values)
    if len(length) != 1 or length[0] < 1:
        raise ValueError(f"values: wanted shape (N,), numbers that {hold} takes, got {length}")
    values = _checks.finite(_checks.floating(values, length, "values"), "values")
    values = values.astype(start.dtype)
    held = 0.5 * values if hold == "period" else values
    numbers, left = _at_values(scene, start, held, index, usual_tolerance(start))
    lost = _lost(start, numbers, left)
    where = ""
    if _checks.known(lost) and bool(lost.any()):
        where = f" at {hold} = {float(values[np.argmax(np.asarray(lost))]):.9g}"
    numbers = _checks.refuse(
        numbers,
        lost.any(),
        f"family: lost{where}; take smaller steps, or the family turns back there: hold another of "
        "x, z, vy, period, or use follow",
    )
    return jax.vmap(orbit_of)(numbers)


def _lost(start: Array, numbers: Array, left: Array) -> Array:
    """Where Newton did not end, or ended at another orbit that solves the equations too."""
    before = jnp.concatenate([start[None], numbers[:-1]])
    ratio = numbers[:, 3] / before[:, 3]
    return ~((left <= usual_tolerance(start)) & (ratio > 0.5) & (ratio < 2))


@eqx.filter_jit
def _at_values(scene: Any, start: Array, held: Array, index: int, tolerance: float) -> Any:
    free = np.array([i for i in range(4) if i != index])
    still = jax.tree.map(
        lambda leaf: lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, scene
    )

    def step(last: Array, value: Scalar) -> Any:
        # Where Newton starts from has no derivative: the orbit found does not depend on it.
        last, aim = lax.stop_gradient(last), lax.stop_gradient(value)
        _, matrix = value_and_jacobian(lambda n: miss(still, n), last)
        slope = -jnp.linalg.solve(matrix[:, free], matrix[:, index])
        guess = last[free] + slope * (aim - last[index])
        found, left = corrected(index, tolerance, scene, guess, value)
        numbers = together(found, value, index)
        return numbers, (numbers, left)

    # A first correction: its tangent is wanted at an orbit, not at a guess.
    found, _ = corrected(index, tolerance, still, start[free], lax.stop_gradient(start[index]))
    _, out = lax.scan(step, together(found, start[index], index), held)
    return out


def slope(scene: Any, orbit: PeriodicOrbit, hold: str) -> PeriodicOrbit:
    """How an orbit changes along its family, per unit of `hold`: see `ThreeBody.family_slope`."""
    change = _slope(scene, crossing(orbit), named(hold))
    turned = ~jnp.isfinite(change.period)
    words = (
        f"family_slope: the family does not go on in {hold} here; take another of x, z, vy, period"
    )
    return _checks.refuse(change, turned, words)


@eqx.filter_jit
def _slope(scene: Any, numbers: Array, index: int) -> PeriodicOrbit:
    free = np.array([i for i in range(4) if i != index])
    _, matrix = value_and_jacobian(lambda n: miss(scene, n), numbers)
    unknown = -jnp.linalg.solve(matrix[:, free], matrix[:, index])
    change = orbit_of(together(unknown, jnp.ones_like(unknown[0]), index))
    # `period` held means the whole of it, the number in `numbers` is the half.
    return jax.tree.map(lambda leaf: 0.5 * leaf, change) if index == 3 else change


def follow(scene: Any, orbit: PeriodicOrbit, step: Any, count: int, rising: str) -> PeriodicOrbit:
    """Members of a family at equal steps of arclength, past its folds: see `ThreeBody.follow`."""
    start, index = crossing(orbit), named(rising)
    step = _checks.floating(step, (), "step").astype(start.dtype)
    step = _checks.refuse(step, ~(jnp.isfinite(step) & (step != 0)), "step: wanted a number not 0")
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"count: wanted how many members, an integer ≥ 1, got {count!r}")
    tolerance = usual_tolerance(start)
    numbers, left = _follow(scene, start, step, count, index, tolerance)
    moved = jnp.diff(jnp.concatenate([start[None], numbers]), axis=0)
    far = jnp.sqrt(jnp.sum(moved * moved, axis=1)) > 2 * jnp.abs(step)
    lost = _lost(start, numbers, left) | far
    where = ""
    if _checks.known(lost) and bool(lost.any()):
        where = f" after {int(np.argmax(np.asarray(lost)))} of {count} members"
    numbers = _checks.refuse(numbers, lost.any(), f"follow: lost{where}; take smaller steps")
    return jax.vmap(orbit_of)(numbers)


@eqx.filter_jit
def _follow(scene: Any, start: Array, step: Array, count: int, index: int, tolerance: float) -> Any:
    def missed(numbers: Array) -> Array:
        return miss(scene, numbers)

    def tangent(matrix: Array, before: Array) -> Array:
        """The direction in which the miss stays 0, on the side of the one before."""
        rows = jnp.concatenate([matrix, before[None]])
        along = jnp.linalg.solve(rows, jnp.zeros(4, start.dtype).at[3].set(1))
        return along / jnp.sqrt(jnp.sum(along * along))

    def forward(carry: Any, _member: Any) -> Any:
        last, before = carry
        _, matrix = value_and_jacobian(missed, last)
        along = tangent(matrix, before)

        def across(numbers: Array) -> Array:
            return jnp.append(missed(numbers), jnp.sum(along * (numbers - last)) - step)

        found = newton(across, last + step * along, tolerance)
        return (found, along), (found, jnp.max(jnp.abs(missed(found))))

    first = jnp.zeros(4, start.dtype).at[index].set(1)
    carry: Any = start, first
    _, out = lax.scan(forward, carry, length=count)
    return out


def stability_indices(monodromy: Float[Array, "6 6"]) -> Complex[Array, "2"]:
    """The two ν = ½(λ + 1/λ) of the multipliers λ that are not 1: `ThreeBody.stability_indices`.

    The pair of multipliers 1 is taken out, and the rest found from tr M and tr M²: eigenvalues
    beside a double one are known to the root of round-off only, these are not.

    >>> stability_indices(jnp.eye(6)).tolist()
    [(1+0j), (1+0j)]
    """
    total = jnp.trace(monodromy) - 2
    squares = jnp.sum(monodromy * monodromy.T) + 2
    half = 0.5 * total
    gap = 0.5 * squares - half * half
    kind = jnp.complex128 if monodromy.dtype == jnp.float64 else jnp.complex64
    half, root = half.astype(kind), jnp.sqrt(gap.astype(kind))
    return 0.5 * jnp.stack([half + root, half - root])
