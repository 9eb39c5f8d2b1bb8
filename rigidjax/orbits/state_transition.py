"""The flow of a scene and its derivative, for the correction of periodic orbits."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.frames.base import AbstractScene
from rigidjax.frames.point import Point


@eqx.filter_jit
def flow(scene: AbstractScene, state: Point, t: ScalarLike, rtol: float, atol: float) -> Point:
    """The state of `scene` a time `t` after `state`; derivatives in forward mode.

    >>> flow(rj.scenes.turntable(0.0), Point([0.0, 0, 0], [1.0, 0, 0]), 2.0, 1e-9, 1e-9).x.tolist()
    [2.0, 0.0, 0.0]
    """
    end, result = _end(scene, state, t, rtol, atol)
    return result.error_if(end, result != dfx.RESULTS.successful)


@eqx.filter_jit
def attempt(scene: AbstractScene, state: Point, t: ScalarLike, rtol: float, atol: float) -> Point:
    """As `flow`, but NaN if the solve fails: for starts that Newton's method only tries."""
    end, result = _end(scene, state, t, rtol, atol)
    good = result == dfx.RESULTS.successful
    return jax.tree.map(lambda leaf: jnp.where(good, leaf, jnp.full_like(leaf, jnp.nan)), end)


def _end(
    scene: AbstractScene, state: Point, t: ScalarLike, rtol: float, atol: float
) -> tuple[Point, dfx.RESULTS]:
    t = _checks.floating(t, (), "t").astype(state.x.dtype)
    out = solved(scene, state, t, rtol, atol)
    return jax.tree.map(lambda leaf: leaf[0], out.ys), out.result


def solved(
    scene: AbstractScene, state: Point, t: Array, rtol: float, atol: float, **how: Any
) -> dfx.Solution:
    """The motion from 0 to `t`, with derivatives in forward mode; `how` as for `diffeqsolve`."""
    return dfx.diffeqsolve(
        dfx.ODETerm(scene.field),
        dfx.Dopri8(),
        jnp.zeros_like(t),
        t,
        None,
        state,
        stepsize_controller=dfx.PIDController(rtol=rtol, atol=atol),
        adjoint=dfx.ForwardMode(),
        max_steps=100_000,
        throw=False,
        **how,
    )


@eqx.filter_jit
def transition(
    scene: AbstractScene, numbers: Float[Array, "6"], t: Any, rtol: float, atol: float
) -> Float[Array, "6 6"]:
    """∂(x, v)(t)/∂(x, v)(0): the tangents are solved along with the motion."""

    def end(numbers: Array) -> Array:
        out = flow(scene, Point(numbers[:3], numbers[3:]), t, rtol, atol)
        return jnp.concatenate([out.x, out.v])

    return jax.jacfwd(end)(numbers)


def smallest_distance(dtype: Any) -> float:
    """The distance, in the scene's unit, below which an attraction has lost its digits: eps^0.4.

    x − x₁ is then known to eps/r = eps^0.6 only (4e-10 in float64); adaptive steps become tiny.

    >>> smallest_distance(jnp.float64) < 1e-6
    True
    """
    return float(jnp.finfo(dtype).eps) ** 0.4
