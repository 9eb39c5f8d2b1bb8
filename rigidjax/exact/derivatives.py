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
from jaxtyping import Array

from rigidjax._types import Scalar
from rigidjax.exact import sigma_form
from rigidjax.exact._xla import fence, opaque_one
from rigidjax.exact.closed_form import from_functions, momentum_and_turn, orbit, reduced
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
from rigidjax.exact.jacobian import Halfway, integrals, jacobian_and_integral
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
    (_, k, energy2), changes = jax.jvp(reciprocal, (moments, momentum), tangents[:2])
    one = opaque_one(t)
    changes = fence(changes, one)
    motion, rows, g = fence(first_order(moments, momentum, t), one)
    p1, p2, p3 = momentum
    h2 = p1 * p1 + p2 * p2 + p3 * p3
    small = jax.lax.stop_gradient(h2 * (k[0] * k[0]) * (t * t)) < _SMALL[t.dtype] ** 2
    # Away from small turns the series, which is not used there, gets zero: nothing overflows.
    series = _small_turn(k, momentum, jnp.where(small, t, 0.0))
    known = (motion, rows, g, series, k, energy2, t, h2, small)
    return motion, _along(known, (changes, *tangents[1:]))


# A gradient keeps `known`, and makes the hundred products of it again: fewer programs to compile.
@jax.checkpoint
def _along(known, tangents) -> tuple[Triple, Four]:
    """Tangents of `flow`, linear in the given ones."""
    (out, turn), rows, g, series, k, energy2, t, h2, small = known
    (d_body, d_k, d_energy2), d_momentum, d_t = tangents
    one = opaque_one(t)
    inputs = (d_body.d12, d_body.d23, d_body.k12, d_body.k13, d_body.k23, *d_momentum, d_t)
    d_out: Triple = tuple(
        sum((row[i] * d for i, d in enumerate(inputs)), jnp.zeros_like(t)) for row in rows
    )
    d_out = fence(d_out, one)

    along = 0.5 * t * d_energy2 + energy2 * d_t
    along = (
        along + 0.5 * sum(g[i] * d_k[i] for i in range(3)) + sum(g[i] * d_k[i] for i in range(3, 6))
    )
    back = turned_back(turn, d_momentum)
    across = cross(out, tuple(a - b for a, b in zip(back, d_out, strict=True)))
    r = 1.0 / jnp.where(small, 1.0, h2)
    along, across = fence((along, across), one)
    theta = tuple(r * (a + b * along) for a, b in zip(across, out, strict=True))
    lanes = (*d_k, *d_momentum)
    near = tuple(
        sum((row[i] * d for i, d in enumerate(lanes)), w * d_t)
        for row, w in zip(series, times(k, out), strict=True)
    )
    theta = tuple(jnp.where(small, a, b) for a, b in zip(near, theta, strict=True))
    return d_out, half_product(turn, fence(theta, one))


@jax.custom_jvp
def first_order(moments: Six, momentum: Triple, t: Scalar):
    """What `flow` returns; dΠ(t) by d12, d23, k12, k13, k23, Π(0), t as rows; G = ∫ Π Πᵀ dt.

    One loop of doublings gives them all.
    """
    o = orbit(moments[:3], momentum)
    u = reduced(0.5 * t, o.half.time, o.modulus)
    at = integrals(u.near, o.modulus, o.mu, o.turn)
    f = at.f._replace(
        C=jnp.where(o.swapped, at.f.D, at.f.C), D=jnp.where(o.swapped, at.f.C, at.f.D)
    )
    whole = jnp.where(u.halves == 0, 0.0, 2.0 * u.halves) * jnp.where(
        u.halves == 0, 0.0, o.half.time
    )
    halfway = Halfway(at._replace(f=f), u.halves, whole, o.half.mean)
    body, _, _ = reciprocal(moments, momentum)
    rows, g = jacobian_and_integral(body, momentum, t, halfway)
    return from_functions(o, at.f, u, t), rows, g


# The jvp of a closed first derivative is taken from the tensor form, which is smooth to any order.
@first_order.defjvp
def _first_order_jvp(primals, tangents):
    _, d_motion = jax.jvp(flow, primals, tangents)
    _, (d_rows, d_g) = jax.jvp(_first_order_of_tensor, primals, tangents)
    return first_order(*primals), (d_motion, d_rows, d_g)


def _first_order_of_tensor(moments, momentum, t):
    body, _, _ = reciprocal(moments, momentum)

    def of_inputs(x):
        d12, d23, k12, k13, k23, p1, p2, p3, time = x
        d13 = body.d13 + ((d12 - body.d12) + (d23 - body.d23))
        return sigma_form.momentum_and_integral(
            Differences(d12, d13, d23, k12, k13, k23), (p1, p2, p3), time
        )

    inputs = (body.d12, body.d23, body.k12, body.k13, body.k23, *momentum, t)
    _, g = of_inputs(inputs)
    rows = jax.jacfwd(lambda x: of_inputs(tuple(x))[0])(jnp.stack(inputs))
    return rows, g


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


def _small_turn(k: Six, momentum: Triple, t: Scalar) -> tuple[Array, ...]:
    """dθ/d(K, Π(0)) as three rows of nine, for a small turn, by Taylor series in time.

    `Π' = Π × KΠ`, `θ' = δΩ + θ × Ω`, `δΩ = δK Π + K δΠ`. All nine columns at once, so that nothing
    of it is transposed: that takes a third of the time to compile.
    """
    one = opaque_one(t)
    # Powers of t are kept inside the terms: each carries one.
    ps: list[Any] = [tuple(c * t for c in momentum)]
    ws: list[Any] = []
    for n in range(_ORDER):
        ws.append(fence(times(k, ps[n]), one))
        if n < _ORDER - 1:
            ps.append(fence(_total([cross(ps[j], ws[n - j]) for j in range(n + 1)], n + 1), one))

    def column(unit: Array) -> Triple:
        d_k, d_ps = tuple(unit[:6]), [tuple(c * t for c in unit[6:])]
        d_ws: list[Any] = []
        thetas: list[Any] = []
        for n in range(_ORDER):
            slope = zip(times(k, d_ps[n]), times(d_k, ps[n]), strict=True)
            d_ws.append(fence(tuple(a + b for a, b in slope), one))
            turns = [cross(thetas[j], ws[n - 1 - j]) for j in range(n)]
            thetas.append(_total([d_ws[n], *turns], n + 1))
            if n < _ORDER - 1:
                turns = [cross(d_ps[j], ws[n - j]) for j in range(n + 1)]
                turns += [cross(ps[j], d_ws[n - j]) for j in range(n + 1)]
                d_ps.append(fence(_total(turns, n + 1), one))
        return fence(_total(thetas[::-1], 1), one)

    return jax.vmap(column)(jnp.eye(9, dtype=t.dtype))


def _total(terms: list[Triple], count: int) -> Triple:
    """Their sum over `count`."""
    totals: Any = [sum(c[1:], c[0]) for c in zip(*terms, strict=True)]
    return tuple(total / count for total in totals)
