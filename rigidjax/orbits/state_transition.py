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
def flow(
    scene: AbstractScene, state: Point, t: ScalarLike, rtol: float, atol: float, throw: bool = True
) -> Point:
    """The state a time `t` after `state`, in forward mode; if the solve fails, an error or NaN."""
    out = solved(scene, state, _checks.floating(t, (), "t").astype(state.x.dtype), rtol, atol)
    end = jax.tree.map(lambda leaf: leaf[0], out.ys)
    good = out.result == dfx.RESULTS.successful
    if throw:
        return out.result.error_if(end, ~good)
    return jax.tree.map(lambda leaf: jnp.where(good, leaf, jnp.nan), end)


def solved(
    scene: AbstractScene, state: Point, t: Array, rtol: float, atol: float, **how: Any
) -> dfx.Solution:
    """The motion from 0 to `t`, with derivatives in forward mode; `how` as for `diffeqsolve`."""
    motion = dfx.ODETerm(scene.field), dfx.Dopri8(), jnp.zeros_like(t), t, None, state
    how |= dict(adjoint=dfx.ForwardMode(), max_steps=100_000, throw=False)
    how["stepsize_controller"] = dfx.PIDController(rtol=rtol, atol=atol)
    return dfx.diffeqsolve(*motion, **how)


def after(scene: AbstractScene, numbers: Float[Array, "6"], t: Any, **how: Any) -> Array:
    """`flow` on (x, v) as one vector."""
    out = flow(scene, Point(numbers[:3], numbers[3:]), t, **how)
    return jnp.concatenate([out.x, out.v])


@eqx.filter_jit
def transition(
    scene: AbstractScene, numbers: Float[Array, "6"], t: Any, **how: Any
) -> Float[Array, "6 6"]:
    """∂(x, v)(t)/∂(x, v)(0): the tangents are solved along with the motion."""
    return jax.jacfwd(lambda numbers: after(scene, numbers, t, **how))(numbers)


def smallest_distance(dtype: Any) -> float:
    """The distance at which an attraction is known only to eps/r = eps^0.6: eps^0.4."""
    return float(jnp.finfo(dtype).eps) ** 0.4
