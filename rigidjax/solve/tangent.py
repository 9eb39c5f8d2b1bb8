"""Small changes of a state: three numbers for an attitude, not four."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax._types import HasAttitude
from rigidjax.motion.coupled import motion_of
from rigidjax.rotation import quaternion
from rigidjax.solve.components import flat, unflat


def dimension(state: Any) -> int:
    """How many numbers a small change of `state` has: one less than its own for a quaternion.

    >>> import rigidjax as rj
    >>> dimension(rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 0]))
    6
    """
    size = sum(math.prod(jnp.shape(leaf)) for leaf in jax.tree.leaves(state))
    return size - isinstance(motion_of(state), HasAttitude)


def _turning(state: Any, turn: Any) -> Any:
    """What is changed: the state, a small turn in the place of its quaternion."""
    return eqx.tree_at(lambda s: motion_of(s).q, state, turn)


def moved(state: Any, change: Float[Array, " n"]) -> Any:
    """`state` changed by little: q ⊗ exp(½δθ), δθ in body axes, and sums.

    Right to first order in derivatives, and of any size; exactly `state` at 0.

    >>> import rigidjax as rj
    >>> moved(rj.Spin([1.0, 0, 0]), jnp.array([0.0, 0.5, 0.0])).omega.tolist()
    [1.0, 0.5, 0.0]
    """
    motion = motion_of(state)
    if not isinstance(motion, HasAttitude):
        return jax.tree.map(jnp.add, state, unflat(change, state))
    still = _turning(state, jnp.zeros_like(motion.omega))
    parts = unflat(change, still)
    turn = quaternion.exp(motion_of(parts).q)
    return _turning(jax.tree.map(jnp.add, still, parts), quaternion.multiply(motion.q, turn))


def between(reference: Any, state: Any) -> Float[Array, " n"]:
    """The small change from `reference` to a `state` near it, to first order: see `moved`.

    >>> import rigidjax as rj
    >>> between(rj.Spin([1.0, 0, 0]), rj.Spin([1.0, 0.5, 0.0])).tolist()
    [0.0, 0.5, 0.0]
    """
    gap = jax.tree.map(jnp.subtract, state, reference)
    motion = motion_of(state)
    if isinstance(motion, HasAttitude):
        turn = quaternion.multiply(quaternion.conjugate(motion_of(reference).q), motion.q)
        gap = _turning(gap, 2 * turn[1:])
    return flat(gap)
