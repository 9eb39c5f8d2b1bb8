"""Draw random bodies, all of which are possible."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from rigidjax import _checks
from rigidjax._types import ScalarLike, Vector
from rigidjax.body.inertia import Body, Inertia, MassProperties, tensor_of
from rigidjax.body.principal_axes import eigensystem, principal
from rigidjax.body.symmetric3 import product, to_inertia

# Logarithms of a wider spread leave the range of float32.
_WIDEST = 10.0


class Draw(eqx.Module):
    """Hold a drawn body in the numbers that simulators take; many draws have a leading axis.

    **Fields:**

    - `body`: a `MassProperties` or an `Inertia`, of the kind that was drawn from.
    - `moments`: (3,) the principal moments about the centre of mass, ascending, kg m².
    - `q`: (4,) the rotation principal axes → body axes, a unit quaternion (w, x, y, z).

    In MuJoCo and MJX `body.mass`, `body.com`, `moments` and `q` are `body_mass`, `body_ipos`,
    `body_inertia` and `body_iquat`.

    >>> draw = sample(rj.shapes.box(2.0, [0.1, 0.2, 0.3]), jax.random.key(0), 0.05)
    >>> draw.body.mass.shape, draw.moments.shape, draw.q.shape
    ((), (3,), (4,))
    """

    body: MassProperties | Inertia
    moments: Float[Array, "*draws 3"]
    q: Float[Array, "*draws 4"]


def as_draw(body: Body) -> Draw:
    """Return a `body` with its principal moments and axes."""
    (low, middle, high), q = principal(tensor_of(body))
    low = jnp.maximum(low, 0.0)  # round-off makes no other body of a rod or a plate
    return Draw(body, jnp.stack([low, middle, jnp.minimum(high, low + middle)]), q)


def sample(body: Body, key: PRNGKeyArray, spread: ScalarLike | Vector) -> Draw:
    """Draw a body at random about another, with a mass, a centre and an inertia that some
    distribution of mass has, however large the spread.

    The mass is multiplied by eᶻ, and the centre of mass is moved by a normal step. The mass itself
    is stretched and sheared about the centre, `r → exp(W/2) r`, by a symmetric matrix W of normal
    numbers: the second moment 𝔖 = ∫ r rᵀ dm becomes `exp(W/2) 𝔖 exp(W/2)`, and a plate remains a
    plate. The distribution of W is the same in all axes. To first order 𝔖/mass along any principal
    axis has the relative deviation `spread`.

    **Arguments:**

    - `body`: the body about which is drawn, `MassProperties` or `Inertia`.
    - `key`: a key of `jax.random`; `jax.vmap` over `jax.random.split(key, n)` gives n draws.
    - `spread`: the standard deviations (3,) of the logarithm of the mass, of each component of the
      centre of mass, m, and of the logarithms of 𝔖/mass along principal axes. One number s is
      (s, s r, s), with `r = √(tr 𝔖 / mass)`. Of an `Inertia` only the last of the three counts.

    **Raises:** `ValueError` (`equinox` error under `jit`) for a spread that is negative or
    above 10.

    >>> keys = jax.random.split(jax.random.key(0), 1000)
    >>> box = rj.shapes.box(2.0, [0.1, 0.2, 0.3])
    >>> draws = jax.vmap(sample, (None, 0, None))(box, keys, 0.05)
    >>> bool((draws.moments[:, :2].sum(1) > draws.moments[:, 2]).all())
    True
    """
    _checks.require_unbatched_instance(body, (MassProperties, Inertia), "body")
    key, second = _checks.random_key(key), body.second_moment
    wide = _checks.numeric_array(spread, "spread").astype(second.dtype)
    if wide.ndim > 0:
        wide = _checks.array_of_shape(wide, (3,), "spread", hint="or one number")
    words = f"spread: wanted numbers from 0 to {_WIDEST:g}; that of the centre of mass any, finite"
    wide = _checks.error_if(wide, ~((wide >= 0) & (wide < jnp.inf)), words)
    if wide.ndim == 0:
        radius = 1.0
        if isinstance(body, MassProperties):
            radius = jnp.sqrt(jnp.trace(second) / body.mass)
        wide = jnp.stack([wide, wide * radius, wide])
    wide = _checks.error_if(wide, (wide > _WIDEST) & np.array([True, False, True]), words)
    z = jax.random.normal(key, (4, 3)).astype(second.dtype)
    more = jax.random.normal(jax.random.fold_in(key, 1)).astype(second.dtype)
    # The eigenvalues of a matrix of random numbers differ, also if the spread is zero.
    values, axes = eigensystem(0.5 * (z[:3] + z[:3].T))
    stretch = product(axes * jnp.exp(0.5 * wide[2] * values)[None], axes.T)
    second = product(stretch, product(second, stretch))
    second = 0.5 * (second + second.T)
    if isinstance(body, Inertia):
        return as_draw(Inertia(to_inertia(second), body.scale))
    factor = jnp.exp(wide[0] * more)
    com = body.com + wide[1] * z[3]
    return as_draw(MassProperties(factor * body.mass, com, factor * second))
