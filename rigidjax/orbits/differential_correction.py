"""Find periodic orbits by Newton's method, differentiably.

An orbit of period T is given by the four numbers x, z, v_y, T/2: its position and velocity where it
crosses the plane y = 0 at a right angle, and half of its period. Its residual is y, v_x and v_z
after half a period. One of the four numbers is held, and Newton's method finds the other three.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks, _show
from rigidjax._types import Scalar, ScalarLike
from rigidjax.frames.base import AbstractScene
from rigidjax.frames.point import Point
from rigidjax.rotation.linalg3 import components

_NAMES = ("x", "z", "vy", "period")
# Newton's method takes at most this number of steps.
MAX_STEPS = 25


class PeriodicOrbit(eqx.Module):
    """Hold a periodic orbit: a state on it, and its period.

    **Arguments:** `state` a `Point`, a state on the orbit; `period` the period, in the scene's unit
    of time.

    >>> float(PeriodicOrbit(Point([0.9, 0, 0], [0.0, -0.5, 0]), 3.0).period)
    3.0
    """

    state: Point
    period: Float[Array, "*batch"]

    __repr__ = _show.fields_as_text

    def __init__(self, state: Point, period: ScalarLike):
        self.state = _checks.require_instance(state, Point, "state", requirement="a Point(x, v)")
        _checks.array_of_shape(state.x, (3,), "state.x", batched=True)
        period = _checks.array_of_shape(period, (), "period", batched=True)
        _checks.require_same_batch(state=(state.x, 1), period=(period, 0))
        self.period = period.astype(state.x.dtype)


def periodic_orbit(
    scene: AbstractScene, guess: PeriodicOrbit, *, hold: str = "x", tolerance: float | None = None
) -> PeriodicOrbit:
    """Return the periodic orbit near `guess`, by Newton's method (differential correction).

    The method finds orbits that are symmetric about the xz-plane: Lyapunov orbits, halo orbits,
    Arenstorf's orbits, and most other orbits in use. Such an orbit crosses the plane at a right
    angle (y = v_x = v_z = 0) twice a period T. Newton's method changes three of (x, z, v_y, T/2) at
    the first crossing until y, v_x, v_z vanish at T/2.

    **Arguments:**

    - `guess`: a `PeriodicOrbit(state, period)` whose state crosses the xz-plane at a right angle.
    - `hold`: the quantity that stays fixed, `"x"`, `"z"`, `"vy"` or `"period"`, and so selects one
      orbit of the family (use `"x"` for Lyapunov orbits, `"z"` for halo orbits).
    - `tolerance`: the largest accepted |y|, |v_x| and |v_z| after half a period; `None` for 1e-12
      (1e-4 in float32).

    **Returns** a `PeriodicOrbit`. It can be differentiated, in forward and reverse mode, with
    respect to the numbers of the scene (μ) and the held quantity: the derivatives come from the
    implicit function theorem. Source: Howell 1984, doi:10.1007/BF01358403. **Raises:** `ValueError`
    (`EquinoxRuntimeError` under `jit`) if Newton's method does not converge.

    >>> moon = rj.orbits.cr3bp(0.0121505856)
    >>> orbit = moon.periodic_orbit(moon.lyapunov_guess(1, 0.01))
    >>> round(float(orbit.period), 4)
    2.712
    """
    numbers, index = numbers_of(guess), held_index(hold)
    free = np.delete(np.arange(4), index)
    if tolerance is None:
        tolerance = usual_tolerance(numbers)
    given = index, float(tolerance), scene, numbers[free], numbers[index]
    unknown, left = eqx.filter_jit(correct_orbit)(*given)
    bad = ~(left <= tolerance)
    said = ""
    if _checks.is_known(left):
        said = f" (the largest of |y|, |vx|, |vz| is {float(left):.1e} at half period)"
    words = f"periodic_orbit: Newton's method found no orbit near the guess{said}; start nearer, "
    words += "hold another of x, z, vy, period, or loosen the tolerance"
    unknown = _checks.error_if(unknown, bad, words)
    corrected = insert_held(unknown, numbers[index], index)
    # A half period of zero solves the equations for every starting point: Newton's method must not
    # end there.
    ratio = corrected[3] / numbers[3]
    words = "periodic_orbit: Newton's method went from the guess to an orbit of less than half or "
    words += "more than twice its period; start nearer"
    corrected = _checks.error_if(corrected, ~((ratio > 0.5) & (ratio < 2)), words)
    return orbit_of(corrected)


def held_index(hold: str) -> int:
    """Return the place of the quantity `hold` among the four numbers of an orbit."""
    return _NAMES.index(_checks.require_option(hold, _NAMES, "hold"))


def numbers_of(guess: PeriodicOrbit) -> Float[Array, "4"]:
    """Return the four numbers of an orbit, after checks."""
    made = "lyapunov_guess and halo_guess make one"
    wanted = "a PeriodicOrbit(state, period)"
    _checks.require_instance(guess, PeriodicOrbit, "guess", requirement=wanted, hint=made)
    x, v = guess.state.x, guess.state.v
    if x.ndim != 1:
        raise ValueError(f"guess: wanted one orbit, x of shape (3,), got {x.shape}; use jax.vmap")
    slant = jnp.maximum(jnp.abs(x[1]), jnp.maximum(jnp.abs(v[0]), jnp.abs(v[2])))
    right = "guess: wanted a start that crosses y = 0 at a right angle: y = vx = vz = 0"
    x, period = _checks.error_if(x, slant > 1e-6, right), guess.period
    period = _checks.error_if(period, ~(period > 0), "guess: wanted a period that is positive")
    return _checks.require_finite(jnp.stack([x[0], x[2], v[1], 0.5 * period]), "guess")


def orbit_of(numbers: Float[Array, "4"]) -> PeriodicOrbit:
    """Return the orbit with these four numbers, the inverse of `numbers_of`."""
    x, z, vy, half = components(numbers)
    zero = jnp.zeros_like(x)
    return PeriodicOrbit(Point(jnp.stack([x, zero, z]), jnp.stack([zero, vy, zero])), 2 * half)


def insert_held(unknown: Float[Array, "3"], held_value: Scalar, index: int) -> Float[Array, "4"]:
    """Return the four numbers: three `unknown` ones, and `held_value` at the place `index`."""
    parts = list(unknown)
    parts.insert(index, held_value)
    return jnp.stack(parts)


def usual_tolerance(numbers: Array) -> float:
    """Return the default tolerance of a residual, by the dtype of the numbers."""
    return 1e-12 if numbers.dtype == jnp.float64 else 1e-4


def integrate(
    scene: AbstractScene, state: Point, t: Array, rtol: float, atol: float, **options: Any
) -> dfx.Solution:
    """Return the motion from `state` at time 0 to time `t`, with derivatives in forward mode;
    `options` are further arguments of `diffrax.diffeqsolve`.
    """
    motion = dfx.ODETerm(scene.field), dfx.Dopri8(), jnp.zeros_like(t), t, None, state
    options |= dict(adjoint=dfx.ForwardMode(), max_steps=100_000, throw=False)
    options["stepsize_controller"] = dfx.PIDController(rtol=rtol, atol=atol)
    return dfx.diffeqsolve(*motion, **options)


@eqx.filter_jit
def state_after(
    scene: AbstractScene, numbers: Float[Array, "6"], t: Array, *, rtol: float, atol: float
) -> Float[Array, "6"]:
    """Return position and velocity after the duration `t`; raise an error if the solve fails."""
    out = integrate(scene, Point(numbers[:3], numbers[3:]), t.astype(numbers.dtype), rtol, atol)
    end: Any = out.result.error_if(out.ys, out.result != dfx.RESULTS.successful)
    return jnp.concatenate([end.x[0], end.v[0]])


def transition_matrix(
    scene: AbstractScene, state: Point, t: ScalarLike, *, rtol: float = 1e-13, atol: float = 1e-14
) -> Float[Array, "6 6"]:
    """Return the state-transition matrix ∂(x, v)(t)/∂(x, v)(0) (6, 6) of the motion that starts at
    `state`.

    **Arguments:** `scene` the equations of motion; `state` a `Point` with the initial position x
    and velocity v; `t` the duration of the motion, in the scene's unit of time; `rtol`, `atol` the
    relative and absolute tolerance of a step.
    """
    _checks.require_instance(state, Point, "state", requirement="a Point(x, v)")
    t = _checks.require_finite(_checks.array_of_shape(t, (), "t"), "t")
    return _transition(scene, jnp.concatenate([state.x, state.v]), t, rtol, atol)


@eqx.filter_jit
def _transition(scene: AbstractScene, numbers: Array, t: Array, rtol: float, atol: float) -> Array:
    """Return the state-transition matrix, by a compiled program."""
    # Forward mode solves the six variational equations together with the motion.
    return jax.jacfwd(lambda n: state_after(scene, n, t, rtol=rtol, atol=atol))(numbers)


def half_period_residual(scene: AbstractScene, numbers: Float[Array, "4"]) -> Float[Array, "3"]:
    """Return the residual of an orbit, NaN if the solve fails."""
    orbit = orbit_of(numbers)
    tight = float(jnp.finfo(numbers.dtype).eps)
    out = integrate(scene, orbit.state, 0.5 * orbit.period, 200 * tight, 10 * tight)
    end: Any = out.ys
    left = jnp.stack([end.x[0, 1], end.v[0, 0], end.v[0, 2]])
    return jnp.where(out.result == dfx.RESULTS.successful, left, jnp.nan)


def value_and_jacobian(
    f: Callable[[Array], Array], x: Array
) -> tuple[Float[Array, " m"], Float[Array, "m n"]]:
    """Return f(x) and the Jacobian of f at x, from one pass in forward mode."""
    along = jax.vmap(lambda e: jax.jvp(f, (x,), (e,)), out_axes=(None, 1))
    return along(jnp.eye(x.shape[0], dtype=x.dtype))


def newton_root(f: Callable[[Array], Array], start: Array, tolerance: float) -> Array:
    """Return a zero of `f` near `start` by Newton's method.

    The method ends after the first step that began at a point where all values of |f| are at most a
    tenth of `tolerance`, or after `MAX_STEPS` steps.
    """

    def is_unfinished(carry: tuple[Array, Array, Array | int]) -> Array:
        _, left, count = carry
        return (left > 0.1 * tolerance) & (count < MAX_STEPS)

    def newton_step(carry: tuple[Array, Array, Array | int]) -> tuple[Array, Array, Array | int]:
        x, _, count = carry
        missed, slope = value_and_jacobian(f, x)
        moved = x - jnp.linalg.solve(slope, missed)
        # The loop ends by `missed`, the values of `f` before the last step, since the values after
        # this step would cost a further call of `f`. Newton's method converges quadratically, so
        # that the values after the step are smaller still.
        return jnp.where(jnp.isfinite(moved), moved, x), jnp.max(jnp.abs(missed)), count + 1

    carry = start, jnp.full_like(start[0], jnp.inf), 0
    return lax.while_loop(is_unfinished, newton_step, carry)[0]


class Corrected(NamedTuple):
    """Hold an orbit after Newton's method."""

    unknown: Float[Array, "3"]  # the numbers that are not held
    residual: Scalar  # the largest of |y|, |v_x| and |v_z| after half a period


# Newton's method itself is not differentiated: `_correct_orbit_jvp` is its derivative. This rule is
# linear in the tangents, so that it serves both `jax.jacfwd` and `jax.grad`, although the motions
# inside the rule are differentiated in forward mode.
@eqx.filter_custom_jvp
def correct_orbit(
    index: int, tolerance: float, scene: AbstractScene, unknown: Array, held_value: Array
) -> Corrected:
    """Return the orbit near the three numbers `unknown` whose residual is zero, or at most
    `tolerance`, by Newton's method.
    """

    def residual(unknown: Array) -> Array:
        return half_period_residual(scene, insert_held(unknown, held_value, index))

    unknown = newton_root(residual, unknown, tolerance)
    return Corrected(unknown, jnp.max(jnp.abs(residual(unknown))))


@correct_orbit.def_jvp
def _correct_orbit_jvp(
    primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]
) -> tuple[Corrected, Corrected]:
    """Return the corrected orbit and its tangent, by the implicit function theorem.

    The result does not depend on the `unknown` numbers from which Newton's method starts; the
    tangent of the remaining residual is taken as zero.
    """
    index, tolerance, scene, unknown, held = primals
    _, _, scene_dot, _, held_dot = tangents
    root, left = correct_orbit(index, tolerance, scene, unknown, held)
    # All derivatives of the residual are computed as one matrix, which multiplies the tangents: the
    # rule stays linear in the tangents, and JAX can transpose it.
    numbers, rest = eqx.partition(scene, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(numbers)
    flat, unflatten = ravel_pytree((leaves, held, root))

    def residual(flat: Array) -> Array:
        leaves, held, unknown = unflatten(flat)
        whole = eqx.combine(jax.tree.unflatten(tree, leaves), rest)
        return half_period_residual(whole, insert_held(unknown, held, index))

    matrix = jax.jacfwd(residual)(flat)
    paths = {path: dot for path, dot in jax.tree.leaves_with_path(scene_dot) if dot is not None}
    # A leaf of the scene without a tangent counts as constant.
    named = jax.tree.leaves_with_path(numbers)
    dots = [paths.get(path, jnp.zeros_like(leaf)) for path, leaf in named]
    held_dot = jnp.zeros_like(held) if held_dot is None else held_dot
    pushed, _ = ravel_pytree((dots, held_dot))
    moved = jnp.sum(matrix[:, :-3] * pushed[None], axis=1)
    total = -jnp.linalg.solve(matrix[:, -3:], moved)
    return Corrected(root, left), Corrected(total, jnp.zeros_like(left))
