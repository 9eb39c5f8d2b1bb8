"""Errors of a prediction by horizon: how far off, so many steps after the start."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rigidjax._types import HasAttitude
from rigidjax.motion import Rigid
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import components


class Horizons(NamedTuple):
    """Open-loop errors by horizon, of each kind (`x` m, `v` m/s, `q` rad, `omega` rad/s).

    **Fields:** `steps` (L,) how many steps ahead; `mean_absolute` of a component, and `rms` of the
    vector, each by kind (L,).

    >>> import rigidjax as rj
    >>> t = np.arange(6.0)
    >>> spin = rj.Spin(np.stack([t, 0 * t, 0 * t], 1))
    >>> rj.identify.windows(t, spin, length=2).held().rms["omega"].tolist()  # it grows by 1 a step
    [1.0, 2.0]
    """

    steps: Any
    mean_absolute: dict[str, Any]
    rms: dict[str, Any]


def by_horizon(found: dict[str, Array]) -> Horizons:
    """The means over windows of errors by kind (N, L, 3)."""
    absolute = {k: np.asarray(jnp.mean(jnp.abs(v), (0, 2))) for k, v in found.items()}
    rms = {k: np.asarray(jnp.sqrt(jnp.mean(jnp.sum(v * v, 2), 0))) for k, v in found.items()}
    return Horizons(np.arange(1, found["omega"].shape[1] + 1), absolute, rms)


def between(states: Any, wanted: Any) -> dict[str, Array]:
    found = {}
    for kind in kinds_of(states):
        a, b = getattr(states, kind), getattr(wanted, kind)
        found[kind] = a - b
        if kind == "q":
            found[kind] = jax.vmap(_turn)(a.reshape(-1, 4), b.reshape(-1, 4)).reshape(
                (*a.shape[:-1], 3)
            )
    return found


def _turn(a: Array, b: Array) -> Array:
    """The rotation from `b` to `a` in body axes, rad, for errors that are small."""
    w, x, y, z = components(quaternion.multiply(quaternion.conjugate(b), a))
    twice = jnp.where(w < 0, -2.0, 2.0).astype(w.dtype)
    return jnp.stack([twice * x, twice * y, twice * z])


def kinds_of(states: Any) -> tuple[str, ...]:
    if isinstance(states, Rigid):
        return ("x", "v", "q", "omega")
    return ("q", "omega") if isinstance(states, HasAttitude) else ("omega",)
