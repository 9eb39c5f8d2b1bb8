"""Errors of a prediction by horizon, the number of steps after the start."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax.motion.manifold import minus_small, parts


class Horizons(NamedTuple):
    """Open-loop errors by horizon, of each kind (`x` m, `v` m/s, `q` rad, `omega` rad/s).

    **Fields:** `steps` (L,) how many steps ahead; by kind, each (L,): `mean_absolute` of a
    component, `mean_norm` the mean length of the vector, `rms` the root of its mean square.

    >>> import rigidjax as rj
    >>> t = np.arange(6.0)
    >>> spin = rj.Spin(np.stack([t, 0 * t, 0 * t], 1))
    >>> rj.identify.windows(t, spin, length=2).held().rms["omega"].tolist()  # it grows by 1 a step
    [1.0, 2.0]
    """

    steps: Any
    mean_absolute: dict[str, Any]
    mean_norm: dict[str, Any]
    rms: dict[str, Any]


def by_horizon(starts: Any, found: Float[Array, "windows steps n"]) -> Horizons:
    """The means over windows of errors, as changes from the measured states."""
    by_kind = parts(jax.tree.map(lambda leaf: leaf[0], starts), found)
    absolute = {k: np.asarray(jnp.mean(jnp.abs(v), (0, 2))) for k, v in by_kind.items()}
    squares = {k: jnp.sum(v * v, 2) for k, v in by_kind.items()}
    norm = {k: np.asarray(jnp.mean(jnp.sqrt(v), 0)) for k, v in squares.items()}
    rms = {k: np.asarray(jnp.sqrt(jnp.mean(v, 0))) for k, v in squares.items()}
    return Horizons(np.arange(1, found.shape[1] + 1), absolute, norm, rms)


@jax.jit
def held_errors(starts: Any, wanted: Any) -> Float[Array, "windows steps n"]:
    """The errors of a prediction that holds the state at the start."""
    return jax.vmap(jax.vmap(minus_small, (None, 0)))(starts, wanted)
