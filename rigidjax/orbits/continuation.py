"""Follow families of periodic orbits: find their members, their stability and their branch
points.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from rigidjax import _checks
from rigidjax._types import Scalar, ScalarLike
from rigidjax.orbits import differential_correction as correction
from rigidjax.orbits.differential_correction import (
    PeriodicOrbit,
    held_index,
    numbers_of,
    orbit_of,
)

if TYPE_CHECKING:
    from rigidjax.orbits.reversible_scene import AbstractReversible

# The search for a branch point takes at most this number of steps.
_MOST = 60


def family(
    scene: "AbstractReversible",
    orbit: PeriodicOrbit,
    values: Float[ArrayLike, " members"] | Sequence[float],
    *,
    hold: str = "x",
) -> PeriodicOrbit:
    """Return the members of the family of `orbit` at which the quantity `hold` has the given
    `values`.

    The members are computed one after another. From each member, the tangent of the family predicts
    the next member. Newton's method then corrects the prediction as in `periodic_orbit`.

    **Arguments:**

    - `orbit`: a `PeriodicOrbit` near the first member.
    - `values`: (N,) the values of `hold`, each near the value before it.
    - `hold`: `"x"`, `"z"`, `"vy"` or `"period"`, a quantity that must be monotone along the family
      (use `follow` past a fold).

    **Returns** a `PeriodicOrbit` with a leading axis N. It can be differentiated with respect to
    the numbers of the scene (such as the mass ratio μ) and `values` in forward and reverse mode;
    the derivatives are exact (implicit function theorem). **Raises:** `ValueError`
    (`EquinoxRuntimeError` under `jit`) with the first value at which Newton's method found no
    member.

    >>> moon = rj.orbits.cr3bp(0.0121505856)
    >>> start = moon.lyapunov_guess(1, 0.01)
    >>> found = moon.family(start, start.state.x[0] - jnp.array([0.0, 0.01]))
    >>> [round(float(p), 3) for p in found.period]
    [2.712, 2.811]
    """
    start, index = numbers_of(orbit), held_index(hold)
    length = np.shape(values)
    if len(length) != 1 or length[0] < 1:
        raise ValueError(f"values: wanted shape (N,), values of {hold}, got shape {length}")
    values = _checks.require_finite(_checks.array_of_shape(values, length, "values"), "values")
    values = values.astype(start.dtype)
    held = 0.5 * values if hold == "period" else values
    numbers, residuals = _members(scene, start, held, index, correction.usual_tolerance(start))
    where = lambda i: f" at {hold} = {values[i]:.9g}"  # noqa: E731
    advice = "; take smaller steps, or the family turns back there: hold another of x, z, vy, "
    lost = _is_lost(start, numbers, residuals)
    return _unless_lost(
        numbers, lost, where, "family: lost the family", advice + "period, or use follow"
    )


def _is_lost(start: Array, numbers: Array, residuals: Array) -> Bool[Array, " members"]:
    """Return for each member whether Newton's method failed, or found another orbit: one whose
    period is less than half or more than twice that of the member before it.
    """
    before = jnp.concatenate([start[None], numbers[:-1]])
    ratio = numbers[:, 3] / before[:, 3]
    return ~((residuals <= correction.usual_tolerance(start)) & (ratio > 0.5) & (ratio < 2))


def _unless_lost(
    numbers: Array, is_lost: Array, describe_member: Callable[[int], str], message: str, advice: str
) -> PeriodicOrbit:
    """Return the members of a family, or raise an error for the first lost one, in the words of
    `describe_member`, which is called only if `is_lost` is not traced.
    """
    known = _checks.is_known(is_lost) and bool(is_lost.any())
    member = describe_member(int(np.argmax(np.asarray(is_lost)))) if known else ""
    words = message + member + advice
    return jax.vmap(orbit_of)(_checks.error_if(numbers, is_lost.any(), words))


class Members(NamedTuple):
    """Hold members of a family of periodic orbits."""

    numbers: Float[Array, "members 4"]  # see `differential_correction`
    residuals: Float[Array, " members"]  # the largest of |y|, |v_x|, |v_z| after half a period


@eqx.filter_jit
def _members(
    scene: "AbstractReversible", start: Array, held_values: Array, index: int, tolerance: float
) -> Members:
    """Return the members at which the number with this `index` has the `held_values`, each
    predicted along the tangent of the family and corrected by Newton's method.
    """
    free = np.delete(np.arange(4), index)
    still = jax.tree.map(lambda n: lax.stop_gradient(n) if eqx.is_array(n) else n, scene)

    def next_member(previous: Array, value: Scalar) -> tuple[Array, Members]:
        # The starting point of Newton's method is not differentiated: the converged orbit does not
        # depend on this point.
        previous, aim = lax.stop_gradient(previous), lax.stop_gradient(value)
        guess = previous[free] + _family_tangent(still, previous, index) * (aim - previous[index])
        root, largest = correction.correct_orbit(index, tolerance, scene, guess, value)
        numbers = correction.insert_held(root, value, index)
        return numbers, Members(numbers, largest)

    # The guess is corrected first: the tangent of the family exists only at an exact member.
    held_now = lax.stop_gradient(start[index])
    root, _ = correction.correct_orbit(index, tolerance, still, start[free], held_now)
    _, out = lax.scan(next_member, correction.insert_held(root, start[index], index), held_values)
    return out


def family_slope(
    scene: "AbstractReversible", orbit: PeriodicOrbit, *, hold: str = "x"
) -> PeriodicOrbit:
    """Return the derivative of an orbit's start and period, along its family, with respect to the
    quantity `hold`.

    **Arguments:** `orbit` a member of the family; `hold` one of `"x"`, `"z"`, `"vy"` and
    `"period"`. **Returns** a `PeriodicOrbit` that holds derivatives: `.period` is d period/d hold,
    for example. The derivatives are exact (implicit function theorem). **Raises:** `ValueError` at
    a fold of the family in `hold`.

    >>> hill, start = rj.orbits.hill(), rj.Point([0.3, 0, 0], [0.0, 1.6, 0])
    >>> orbit = hill.periodic_orbit(rj.orbits.PeriodicOrbit(start, 1.2))
    >>> round(float(hill.family_slope(orbit).period), 3)
    12.076
    """
    change = _slope(scene, numbers_of(orbit), held_index(hold))
    turned = ~jnp.isfinite(change.period)
    words = f"family_slope: the family has a fold in {hold} here; take another of x, z, vy, period"
    return _checks.error_if(change, turned, words)


def _family_tangent(scene: "AbstractReversible", numbers: Array, index: int) -> Float[Array, "3"]:
    """Return the derivatives along a family of three numbers by that with this `index`."""
    _, matrix = correction.value_and_jacobian(
        lambda n: correction.half_period_residual(scene, n), numbers
    )
    return -jnp.linalg.solve(matrix[:, np.delete(np.arange(4), index)], matrix[:, index])


@eqx.filter_jit
def _slope(scene: "AbstractReversible", numbers: Array, index: int) -> PeriodicOrbit:
    """Return the derivative of the start and period of an orbit along its family with respect to
    `numbers[index]`; `numbers[3]` is half the period, but the derivative is then with respect to
    the whole period.
    """
    unknown = _family_tangent(scene, numbers, index)
    change = orbit_of(correction.insert_held(unknown, jnp.ones_like(unknown[0]), index))
    # The last of `numbers` is half the period, but `hold="period"` means the whole period.
    return jax.tree.map(lambda leaf: 0.5 * leaf, change) if index == 3 else change


def follow(
    scene: "AbstractReversible",
    orbit: PeriodicOrbit,
    step: ScalarLike,
    count: int,
    *,
    rising: str = "x",
) -> PeriodicOrbit:
    """Return the next `count` members of a family, at fixed steps of arclength, past its folds.

    The method is pseudo-arclength continuation in the four numbers x, z, v_y, T/2: position,
    velocity and half of the period T, where an orbit crosses y = 0 at a right angle. It goes a
    `step` along the tangent of the family, then corrects by Newton's method across the tangent
    (Keller 1977, in Applications of Bifurcation Theory).

    **Arguments:**

    - `orbit`: a member, which is not returned.
    - `step`: the arclength from each member to the next, negative for the opposite direction.
    - `count`: the number of members.
    - `rising`: `"x"`, `"z"`, `"vy"` or `"period"`, the quantity that grows in the first step if
      `step` is positive.

    **Returns** a `PeriodicOrbit` with a leading axis; to differentiate a member, give it to
    `periodic_orbit` first. **Raises:** `ValueError` (`EquinoxRuntimeError` under `jit`) with the
    number of members found before the family was lost.
    """
    start, index = numbers_of(orbit), held_index(rising)
    length = _checks.array_of_shape(step, (), "step").astype(start.dtype)
    bad = ~(jnp.isfinite(length) & (length != 0))
    length = _checks.error_if(length, bad, "step: wanted a number that is not 0")
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"count: wanted the number of members, an integer ≥ 1, got {count!r}")
    tolerance = correction.usual_tolerance(start)
    numbers, residuals = _followed_members(scene, start, length, count, index, tolerance)
    moved = jnp.diff(jnp.concatenate([start[None], numbers]), axis=0)
    far = jnp.sqrt(jnp.sum(moved * moved, axis=1)) > 2 * jnp.abs(length)
    lost = _is_lost(start, numbers, residuals) | far
    where = lambda i: f" after {i} of {count} members"  # noqa: E731
    return _unless_lost(numbers, lost, where, "follow: lost the family", "; take smaller steps")


@eqx.filter_jit
def _followed_members(
    scene: "AbstractReversible", start: Array, step: Array, count: int, index: int, tolerance: float
) -> Members:
    """Return the next members of a family at equal steps of arclength, by pseudo-arclength
    continuation; the number with this `index` grows in the first step if `step` is positive.
    """

    def residual(numbers: Array) -> Array:
        return correction.half_period_residual(scene, numbers)

    def next_member(
        carry: tuple[Array, Array], _member: None
    ) -> tuple[tuple[Array, Array], Members]:
        last, before = carry
        _, matrix = correction.value_and_jacobian(residual, last)
        # The tangent of the family is orthogonal to the rows of the Jacobian, and its scalar
        # product with the tangent at the member before is positive.
        rows = jnp.concatenate([matrix, before[None]])
        along = jnp.linalg.solve(rows, jnp.zeros(4, start.dtype).at[3].set(1))
        along = along / jnp.sqrt(jnp.sum(along * along))

        def across(numbers: Array) -> Array:
            return jnp.append(residual(numbers), jnp.sum(along * (numbers - last)) - step)

        root = correction.newton_root(across, last + step * along, tolerance)
        return (root, along), Members(root, jnp.max(jnp.abs(residual(root))))

    first = jnp.zeros(4, start.dtype).at[index].set(1)
    carry: Any = start, first
    _, out = lax.scan(next_member, carry, length=count)
    return out


def stability_indices(monodromy: Float[Array, "6 6"]) -> Complex[Array, "2"]:
    """Return the two stability indices ν = ½(λ + 1/λ) of the `monodromy` matrix M.

    M has the eigenvalues (multipliers) 1, 1 and two pairs λ, 1/λ; each pair gives one index. The
    indices are computed from tr M and tr M².
    """
    total = jnp.trace(monodromy) - 2
    squares = jnp.sum(monodromy * monodromy.T) + 2
    half = 0.5 * total
    gap = 0.5 * squares - half * half
    kind = jnp.complex128 if monodromy.dtype == jnp.float64 else jnp.complex64
    half, root = half.astype(kind), jnp.sqrt(gap.astype(kind))
    return 0.5 * jnp.stack([half + root, half - root])


def bifurcation(
    scene: "AbstractReversible",
    orbit: PeriodicOrbit,
    other: PeriodicOrbit,
    *,
    index: int = 1,
    value: float = 1.0,
    hold: str = "x",
) -> PeriodicOrbit:
    """Return the member between two members of a family at which a stability index equals `value`.

    At a member with an index of 1 a family of the same period branches off, or the family has a
    fold. At an index of −1 a family of twice the period branches off. At an index of cos(2πp/q),
    with whole numbers p and q, a family of q times the period branches off. For planar Lyapunov
    orbits `index` 1 belongs to motion out of the plane, and the halo orbits branch off where this
    index is 1.

    **Arguments:**

    - `orbit`, `other`: two members near each other, with `value` between their stability indices.
    - `index`: 0 or 1, an index into the result of `stability_indices`.
    - `value`: the wanted stability index.
    - `hold`: the quantity that the search varies along the family, `"x"`, `"z"`, `"vy"` or
      `"period"`.

    The search runs in Python, not under `jit`. Source: Howell 1984, doi:10.1007/BF01358403; Robin
    and Markellos 1980, doi:10.1007/BF01231183. **Raises:** `ValueError` if `value` does not lie
    between the two stability indices, or if the indices are complex.
    """
    from scipy.optimize import brentq

    place = held_index(hold)
    if isinstance(index, bool) or index not in (0, 1):
        raise ValueError(f"index: wanted 0 or 1, which of the two stability indices, got {index!r}")
    value = _checks.python_float(value, "value")
    if not np.isfinite(value):
        raise ValueError(f"value: wanted a finite number, got {value}")
    a, b = (float(numbers_of(one)[place]) for one in (orbit, other))
    left, right = (scene.periodic_orbit(one, hold=hold) for one in (orbit, other))
    orbits = {a: left, b: right}

    def excess(held_value: float) -> float:
        if held_value not in orbits:
            share = (held_value - a) / (b - a)
            guess = jax.tree.map(lambda x, y: (1 - share) * x + share * y, left, right)
            orbits[held_value] = scene.periodic_orbit(guess, hold=hold)
        stability = np.asarray(eqx.filter_jit(scene.stability_indices)(orbits[held_value]))[index]
        if abs(stability.imag) > 1e-9 * max(1.0, abs(stability)):
            words = "the stability indices are complex at a member between the orbits"
            raise ValueError(f"bifurcation: {words}; give orbits nearer to each other")
        away = float(stability.real) - value
        return away if abs(away) > 1e-12 * max(1.0, abs(value)) else 0.0

    low, high = excess(a), excess(b)
    if not low * high <= 0:
        ends = f"{low + value:.6g} at one orbit, {high + value:.6g} at the other"
        raise ValueError(
            f"bifurcation: the stability index is {ends}: {value:g} is not between these two; "
            "give orbits on both sides of the branch point"
        )
    root: Any = brentq(excess, a, b, xtol=1e-13 * max(1.0, abs(b - a)), maxiter=_MOST)
    return orbits[root]
