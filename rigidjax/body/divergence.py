"""Measure the divergence of two bodies, a prior for fits that does not depend on the frame."""

from functools import partial

import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.body.inertia import MassProperties
from rigidjax.rotation.linalg3 import dot


def divergence(body: MassProperties, reference: MassProperties) -> Scalar:
    """Return the entropic (Bregman, log-determinant) divergence of two bodies, without units: a
    measure of how different their masses, centres of mass and second moments are.

    `D = Tr(J₀⁻¹ J) − log det(J₀⁻¹ J) − 4`, where J is the 4×4 pseudo-inertia of `body`, and J₀ that
    of `reference`: `J = [[𝔖 + m c cᵀ, m c], [m cᵀ, m]]`, with the mass m, the centre of mass c and
    the second moment 𝔖 about it. The divergence is zero only if the bodies are equal, convex in J,
    and infinite for a `body` that is a plate or a rod. It does not change if both bodies are
    expressed in another frame or in other units. It is twice the Kullback–Leibler divergence of two
    Gaussian distributions in four dimensions, with mean zero and the covariances J and J₀. Its
    error is the round-off of Tr(J₀⁻¹ J). Add `weight * divergence(body, guess)` to a loss:
    quantities that the data do not determine then stay near those of `guess`.

    **Arguments:** `body`; `reference`, a body with a positive definite 𝔖, in the frame and units of
    `body`. Source: Lee, Wensing and Park 2020, "Geometric robot dynamic identification: a convex
    programming approach", IEEE T-RO 36:348, doi:10.1109/TRO.2019.2926491.

    >>> body = rj.shapes.box(1.0, [1.0, 2.0, 3.0])
    >>> abs(float(divergence(body, body))) < 1e-14
    True
    """
    _checks.require_unbatched_instance(body, MassProperties, "body")
    _checks.require_unbatched_instance(reference, MassProperties, "reference")
    ratio = body.mass / reference.mass
    # The inverse of the second moment of `reference` is applied by its Cholesky factor: an inverse
    # from cofactors would lose twice as many digits for a long, thin body.
    root = jnp.linalg.cholesky(reference.second_moment / reference.mass)
    whiten = partial(solve_triangular, root, lower=True)
    overlap = whiten(whiten(body.second_moment / body.mass).T)
    d = whiten(body.com - reference.com)
    distance = ratio * (jnp.trace(overlap) + dot(d, d) + 1.0) - jnp.linalg.slogdet(overlap)[1]
    return distance - 4.0 * jnp.log(ratio) - 4.0
