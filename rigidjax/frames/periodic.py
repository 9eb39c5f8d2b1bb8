"""Periodic orbits by Newton's method, with the derivatives of the family they belong to."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.frames.flow import flow
from rigidjax.frames.point import Point

_NAMES = ("x", "z", "vy", "period")
_MAX_STEPS = 25


class PeriodicOrbit(eqx.Module):
    """A start and the time after which it comes back.

    **Arguments:** `state` a `Point`; `period` its period, in the scene's unit of time.

    >>> float(PeriodicOrbit(Point([0.9, 0, 0], [0.0, -0.5, 0]), 3.0).period)
    3.0
    """

    state: Point
    period: Float[Array, "*batch"]

    def __init__(self, state: Point, period: ScalarLike):
        self.state = state
        period = _checks.floating(period, (), "period", batched=True)
        self.period = period.astype(state.x.dtype)


def correct(
    scene: Any, guess: PeriodicOrbit, hold: str, tolerance: float | None = None
) -> PeriodicOrbit:
    """The orbit near `guess` that crosses y = 0 at right angles twice: see `periodic_orbit`.

    **Raises:** `ValueError` (`EquinoxRuntimeError` under `jit`) if Newton does not converge.

    >>> from rigidjax.frames import scenes
    >>> hill = scenes.hill()
    >>> orbit = correct(hill, PeriodicOrbit(Point([0.3, 0, 0], [0.0, 1.6, 0]), 1.2), "x")
    >>> round(float(orbit.period), 3)
    1.404
    """
    if hold not in _NAMES:
        raise ValueError(f"hold: wanted one of {', '.join(_NAMES)}, got {hold!r}")
    if not isinstance(guess, PeriodicOrbit):
        raise TypeError(
            f"guess: wanted a PeriodicOrbit(state, period), got {type(guess).__name__}; "
            "lyapunov_guess and halo_guess make one"
        )
    x, v = guess.state.x, guess.state.v
    slant = jnp.maximum(jnp.abs(x[1]), jnp.maximum(jnp.abs(v[0]), jnp.abs(v[2])))
    x = _checks.refuse(
        x,
        slant > 1e-6,
        "guess: wanted a start that crosses y = 0 at a right angle: y = vx = vz = 0",
    )
    numbers = jnp.stack([x[0], x[2], v[1], 0.5 * guess.period])
    index = _NAMES.index(hold)
    free = np.array([i for i in range(4) if i != index])
    if tolerance is None:
        tolerance = 1e-12 if numbers.dtype == jnp.float64 else 1e-4
    unknown, left = _solve(scene, numbers[free], numbers[index], index, tolerance)
    bad = ~(left <= tolerance)
    said = f" ({float(left):.1e} left at half period)" if _checks.known(left) else ""
    unknown = _checks.refuse(
        unknown,
        bad,
        f"periodic_orbit: Newton's method found no orbit near the guess{said}; start nearer, "
        "hold another of x, z, vy, period, or loosen the tolerance",
    )
    x0, z0, vy, half = _together(unknown, numbers[index], index)
    # A half period of zero solves the equations of every start.
    ratio = half / numbers[3]
    half = _checks.refuse(
        half,
        ~((ratio > 0.5) & (ratio < 2)),
        "periodic_orbit: Newton's method slid from the guess to an orbit of less than half or more "
        "than twice its period; start nearer",
    )
    zero = jnp.zeros_like(x0)
    return PeriodicOrbit(Point(jnp.stack([x0, zero, z0]), jnp.stack([zero, vy, zero])), 2 * half)


def _together(unknown: Array, held: Array, index: int) -> list[Array]:
    parts = [unknown[0], unknown[1], unknown[2]]
    parts.insert(index, held)
    return parts


def _miss(scene: Any, unknown: Array, held: Array, index: int) -> Array:
    """y, vx and vz at the half period."""
    x0, z0, vy, half = _together(unknown, held, index)
    zero = jnp.zeros_like(x0)
    start = Point(jnp.stack([x0, zero, z0]), jnp.stack([zero, vy, zero]))
    tight = float(jnp.finfo(x0.dtype).eps)
    end = flow(scene, start, half, 200 * tight, 10 * tight)
    return jnp.stack([end.x[1], end.v[0], end.v[2]])


# Newton itself is not differentiated: the rule below is linear in the tangents, so that the same
# one serves jacfwd and grad although the solves within run in forward mode.
@eqx.filter_jit
def _solve(scene: Any, unknown: Array, held: Array, index: int, tolerance: float) -> Any:
    return _corrected(index, float(tolerance), scene, unknown, held)


@eqx.filter_custom_jvp
def _corrected(index: int, tolerance: float, scene: Any, unknown: Array, held: Array) -> Any:
    def keep_on(carry: Any) -> Any:
        _, left, count = carry
        return (left > 0.1 * tolerance) & (count < _MAX_STEPS)

    def step(carry: Any) -> Any:
        unknown, _, count = carry
        missed, slope = _value_and_jacobian(lambda u: _miss(scene, u, held, index), unknown)
        moved = unknown - jnp.linalg.solve(slope, missed)
        # The miss before the last move says how good the last start was; stop once it is small.
        return jnp.where(jnp.isfinite(moved), moved, unknown), jnp.max(jnp.abs(missed)), count + 1

    carry = unknown, jnp.full_like(held, jnp.inf), 0
    unknown, _, _ = lax.while_loop(keep_on, step, carry)
    return unknown, jnp.max(jnp.abs(_miss(scene, unknown, held, index)))


@_corrected.def_jvp
def _corrected_jvp(primals: Any, tangents: Any) -> Any:
    index, tolerance, scene, unknown, held = primals
    _, _, scene_dot, _, held_dot = tangents
    found, left = _corrected(index, tolerance, scene, unknown, held)
    # All derivatives of the miss as one matrix, so that the rule stays linear in the tangents and
    # can be transposed.
    numbers, rest = eqx.partition(scene, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(numbers)
    flat, unflatten = ravel_pytree((leaves, held, found))

    def miss(flat: Array) -> Array:
        leaves, held, unknown = unflatten(flat)
        return _miss(eqx.combine(jax.tree.unflatten(tree, leaves), rest), unknown, held, index)

    matrix = jax.jacfwd(miss)(flat)
    dots = [
        jnp.zeros_like(leaf) if dot is None else dot
        for leaf, dot in zip(leaves, _tangents(numbers, scene_dot), strict=True)
    ]
    held_dot = jnp.zeros_like(held) if held_dot is None else held_dot
    pushed, _ = ravel_pytree((dots, held_dot))
    moved = jnp.sum(matrix[:, :-3] * pushed[None], axis=1)
    total = -jnp.linalg.solve(matrix[:, -3:], moved)
    return (found, left), (total, jnp.zeros_like(left))


def _tangents(numbers: Any, dots: Any) -> list[Any]:
    """The tangents that belong to the leaves of `numbers`; `None` where there is none."""
    paths = {path: leaf for path, leaf in jax.tree.leaves_with_path(dots) if leaf is not None}
    return [paths.get(path) for path, _ in jax.tree.leaves_with_path(numbers)]


def _value_and_jacobian(f: Any, x: Array) -> tuple[Array, Array]:
    """f(x) and its Jacobian from one pass in forward mode."""
    value, columns = jax.vmap(lambda e: jax.jvp(f, (x,), (e,)), out_axes=(None, 1))(
        jnp.eye(x.shape[0], dtype=x.dtype)
    )
    return value, columns
