"""The free flow in principal axes, with its derivatives: (inertia, Π, t) → (Π(t), turn).

The turn's derivative needs no elliptic integral of the third kind. Let `δR = R hat(θ)`. Momentum is
constant in space, `R Π(t) = Π(0)` (R since t = 0), which gives θ across Π(t):

    Π(t) × (Rᵀ δΠ(0) − δΠ(t)) = h² θ − Π (Π·θ)

and along it `d(Π·θ)/dt = Π·δΩ = ½ δE₂ + ½ Π·δK Π`, E₂ = Π·KΠ constant, so

    Π(t)·θ = ½ t δE₂ + ½ δK : ∫₀ᵗ Π Πᵀ dt + E₂ δt.

That divides by h²: for a small turn, rest included, the derivative is that of the Taylor series.
"""

from typing import Any

import jax
import jax.numpy as jnp

from rigidjax._types import Scalar
from rigidjax.exact import sigma_form
from rigidjax.exact._xla import fence, opaque_one
from rigidjax.exact.closed_form import momentum_and_turn, orbit
from rigidjax.exact.components3 import (
    Four,
    Six,
    Triple,
    adjugate,
    cross,
    determinant,
    half_product,
    times,
    turned_back,
)
from rigidjax.exact.jacobian import jacobian_and_integral
from rigidjax.exact.sigma_form import Differences

# Below this turn (rad) the Taylor series, of this order, is right to round-off; above, what the
# quotient by h² loses is round-off/turn in a first and round-off/turn² in a second derivative.
_SMALL, _ORDER = {jnp.dtype("float32"): 0.1, jnp.dtype("float64"): 3e-3}, 5


@jax.custom_jvp
def flow(moments: Six, momentum: Triple, t: Scalar) -> tuple[Triple, Four]:
    """Π(t) and the quaternion of the turn since 0.

    `moments`: I11 ≤ I22 ≤ I33, I12, I13, I23, the last three zero in value; `momentum` Π(0).
    """
    return momentum_and_turn(orbit(moments[:3], momentum), t)


@flow.defjvp
def _flow_jvp(primals, tangents):
    moments, momentum, t = primals
    _, d_momentum, d_t = tangents
    (body, k, energy2), (d_body, d_k, d_energy2) = jax.jvp(
        reciprocal, (moments, momentum), tangents[:2]
    )
    one = opaque_one(t)
    d_body, d_k, d_energy2 = fence((d_body, d_k, d_energy2), one)
    rows, g = fence(first_order(body, momentum, t), one)
    inputs = (d_body.d12, d_body.d23, d_body.k12, d_body.k13, d_body.k23, *d_momentum, d_t)
    d_out: Triple = tuple(
        sum((row[i] * d for i, d in enumerate(inputs)), jnp.zeros_like(t)) for row in rows
    )
    d_out = fence(d_out, one)

    out, turn = fence(flow(moments, momentum, t), one)
    p1, p2, p3 = momentum
    h2 = p1 * p1 + p2 * p2 + p3 * p3
    small = jax.lax.stop_gradient(h2 * (k[0] * k[0]) * (t * t)) < _SMALL[t.dtype] ** 2
    along = 0.5 * t * d_energy2 + energy2 * d_t
    along = (
        along + 0.5 * sum(g[i] * d_k[i] for i in range(3)) + sum(g[i] * d_k[i] for i in range(3, 6))
    )
    back = turned_back(turn, d_momentum)
    across = cross(out, tuple(a - b for a, b in zip(back, d_out, strict=True)))
    r = 1.0 / jnp.where(small, 1.0, h2)
    along, across = fence((along, across), one)
    theta = tuple(r * (a + b * along) for a, b in zip(across, out, strict=True))

    # Away from small turns the series, which is not used there, gets zero: nothing overflows.
    safe = jnp.where(small, t, 0.0)
    _, d_series = jax.jvp(_series, (k, momentum, safe), (d_k, d_momentum, d_t))
    d_turn = tuple(
        jnp.where(small, a, b) for a, b in zip(d_series, half_product(turn, theta), strict=True)
    )
    return (out, turn), (d_out, fence(d_turn, one))


# The jvp of a closed first derivative is taken from the tensor form, which is smooth to any order.
@jax.custom_jvp
def first_order(body, momentum, t):
    return jacobian_and_integral(body, momentum, t)


@first_order.defjvp
def _first_order_jvp(primals, tangents):
    return jax.jvp(_first_order_of_tensor, primals, tangents)


def _first_order_of_tensor(body, momentum, t):
    def of_inputs(x):
        d12, d23, k12, k13, k23, p1, p2, p3, time = x
        d13 = body.d13 + ((d12 - body.d12) + (d23 - body.d23))
        return sigma_form.momentum_and_integral(
            Differences(d12, d13, d23, k12, k13, k23), (p1, p2, p3), time
        )

    inputs = (body.d12, body.d23, body.k12, body.k13, body.k23, *momentum, t)
    _, g = of_inputs(inputs)
    return jax.jacfwd(lambda x: of_inputs(tuple(x))[0])(jnp.stack(inputs)), g


def reciprocal(moments: Six, momentum: Triple):
    """Differences of K = I⁻¹, K itself and E₂ = Π·KΠ."""
    i1, i2, i3, i12, i13, i23 = moments
    r = 1.0 / determinant(moments)
    k = tuple(c * r for c in adjugate(moments))
    body = Differences(
        ((i2 - i1) * i3 + (i13 * i13 - i23 * i23)) * r,
        ((i3 - i1) * i2 + (i12 * i12 - i23 * i23)) * r,
        ((i3 - i2) * i1 + (i12 * i12 - i13 * i13)) * r,
        *k[3:],
    )
    p1, p2, p3 = momentum
    energy2 = (
        k[0] * p1 * p1
        + k[1] * p2 * p2
        + k[2] * p3 * p3
        + 2.0 * (k[3] * p1 * p2 + k[4] * p1 * p3 + k[5] * p2 * p3)
    )
    return body, k, energy2


def _series(k: Six, momentum: Triple, t: Scalar) -> Four:
    """The turn by its Taylor series: Π' = Π × KΠ, x' = ½ x ⊗ (0, KΠ)."""
    one, zero = jnp.ones_like(t), jnp.zeros_like(t)
    ps: list[Any] = [tuple(c * t for c in momentum)]
    ws: list[Any] = []
    xs: list[Any] = [(one, zero, zero, zero)]
    # Powers of t are kept inside the terms: each P and W carries one.
    fresh = opaque_one(t)
    for n in range(_ORDER):
        ws.append(fence(times(k, ps[n]), fresh))
        flows = [half_product(xs[j], ws[n - j]) for j in range(n + 1)]
        xs.append(fence(tuple(sum(c) / (n + 1) for c in zip(*flows, strict=True)), fresh))
        if n < _ORDER - 1:
            turns = [cross(ps[j], ws[n - j]) for j in range(n + 1)]
            ps.append(fence(tuple(sum(c) / (n + 1) for c in zip(*turns, strict=True)), fresh))
    return tuple(sum(c[::-1], zero) for c in zip(*xs, strict=True))
