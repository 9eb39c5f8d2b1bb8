"""Compute Carlson's symmetric elliptic integrals R_F, R_D, R_J and R_C.

R_F and R_D are computed by duplication (Carlson 1995, doi 10.1007/BF02198293; DLMF 19.36(i)). Each
step replaces every argument a by (a + λ)/4. The first steps halve the logarithm of the ratio of the
arguments, and later steps divide the differences of the arguments by four. After the last step, a
Taylor series about the mean of the arguments is exact to round-off. R_J is computed from its
definition as an integral. The derivatives are integrals of the same kind (DLMF 19.18).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from rigidjax.elliptic.arguments import Real, RealOrArray, Tangent, common_arrays
from rigidjax.elliptic.carlson_r import (
    largest_or_one,
    nan_where_negative,
    r_integral,
    r_tangent,
)

# The number of duplication steps. Each step brings the three arguments of a Carlson integral closer
# together; after this number the Taylor series about equal arguments is exact to round-off, for any
# ratio of the arguments in the range of the dtype.
_STEPS = {np.dtype("float64"): 13, np.dtype("float32"): 8}


def rf(x: Real, y: Real, z: Real) -> RealOrArray:
    """Return Carlson's integral of the first kind, R_F(x, y, z) = ½ ∫₀^∞ dt / √((t+x)(t+y)(t+z)).

    **Arguments:** `x`, `y`, `z` ≥ 0, at most one of them 0, all in one unit. Two zeros give
    infinity, a negative argument gives NaN.

    **Returns** R_F (DLMF 19.16.1), symmetric in all three arguments, in the unit of the arguments
    to the power −½. Its derivative ∂R_F/∂z = −R_D(x, y, z)/6 (DLMF 19.18.1) is −∞ at z = 0.

    >>> float(rf(4.0, 4.0, 4.0))
    0.5
    """
    return _rf(common_arrays(x=x, y=y, z=z))


def rd(x: Real, y: Real, z: Real) -> RealOrArray:
    """Return Carlson's R_D(x, y, z) = (3/2) ∫₀^∞ dt / ((t+z) √((t+x)(t+y)(t+z))), of the second
    kind.

    **Arguments:** `x`, `y` ≥ 0, at most one of them 0, and `z` > 0, all in one unit. The result is
    infinite for z = 0 or x = y = 0, and NaN for negative arguments.

    **Returns** R_D (DLMF 19.16.5), symmetric in x and y.

    >>> float(rd(4.0, 4.0, 4.0))
    0.125
    """
    return _rd(common_arrays(x=x, y=y, z=z))


def rj_(x: Real, y: Real, z: Real, p: Real) -> RealOrArray:
    """Return Carlson's R_J(x, y, z, p) = (3/2) ∫₀^∞ dt / ((t+p) √((t+x)(t+y)(t+z))), of the third
    kind.

    The underscore distinguishes the name from `import rigidjax as rj`.

    **Arguments:** `x`, `y`, `z` ≥ 0, at most one of them 0, and `p` > 0, all in one unit. p = 0
    gives infinity, p < 0 gives NaN (not the principal value).

    **Returns** R_J (DLMF 19.16.2) by the trapezoidal rule in ln t, exact to round-off.

    >>> round(float(rj_(4.0, 4.0, 4.0, 4.0)), 14)
    0.125
    """
    return 1.5 * r_integral((0.5, 0.5, 0.5, 1.0), common_arrays(x=x, y=y, z=z, p=p))


def rc(x: Real, y: Real) -> RealOrArray:
    """Return Carlson's R_C(x, y) = R_F(x, y, y) = ½ ∫₀^∞ dt / ((t+y) √(t+x)), which is an
    elementary function (an arctangent or a logarithm).

    **Arguments:** `x` ≥ 0 and `y` ≠ 0 in one unit. y = 0 gives infinity, x < 0 gives NaN.
    **Returns:** R_C (DLMF 19.2.17); for y < 0 the Cauchy principal value (DLMF 19.2.20).

    >>> float(rc(4.0, 4.0))
    0.5
    """
    x, y = common_arrays(x=x, y=y)
    below = y < 0
    length = jnp.where(below, x - y, 1)
    # For y > 0 the factor is 1. Take the root of 1, not of x, in this case: for x = 0 the infinite
    # derivative of √x would make the gradient NaN, although `where` discards the root.
    factor = jnp.sqrt(jnp.where(below, x / length, 1))
    positive = jnp.where(below, -y, y)
    return factor * _rf((jnp.where(below, x - y, x), positive, positive))


@jax.custom_jvp
def _rf(arguments: tuple[Array, ...]) -> Array:
    """Return R_F of three arrays of one shape and dtype by duplication (DLMF 19.36.1)."""
    scale = largest_or_one(arguments)
    x, y, z = (a / scale for a in arguments)
    for _ in range(_STEPS[np.dtype(x.dtype)]):
        step = _duplication_shift(x, y, z)
        x, y, z = 0.25 * (x + step), 0.25 * (y + step), 0.25 * (z + step)
    mean = (x + y + z) / 3
    X, Y = 1 - x / mean, 1 - y / mean
    Z = -X - Y
    e2, e3 = X * Y - Z * Z, X * Y * Z
    # Once the three arguments are nearly equal, R_F is a Taylor series in their relative
    # differences X, Y, Z from the mean, by the symmetric functions e2 and e3 (DLMF 19.36.1).
    series = 1 - e2 / 10 + e3 / 14 + e2**2 / 24 - 3 * e2 * e3 / 44
    series = series - 5 * e2**3 / 208 + 3 * e3**2 / 104 + e2**2 * e3 / 16
    return _in_domain(series / jnp.sqrt(mean * scale), arguments)


@partial(_rf.defjvp, symbolic_zeros=True)
def _rf_jvp(
    primals: tuple[tuple[Array, ...]], tangents: tuple[tuple[Tangent, ...]]
) -> tuple[Array, Array]:
    """Return R_F and its tangent, by ∂R_F/∂z = −R_D(x, y, z)/6 (DLMF 19.18.1)."""
    (a,), (directions,) = primals, tangents
    tangent = jnp.zeros_like(a[0])
    for i, direction in enumerate(directions):
        if not isinstance(direction, SymbolicZero):
            tangent = tangent - _rd((*a[:i], *a[i + 1 :], a[i])) * direction / 6
    return _rf(a), tangent


@jax.custom_jvp
def _rd(arguments: tuple[Array, ...]) -> Array:
    """Return R_D of three arrays of one shape and dtype by duplication (DLMF 19.36.2)."""
    scale = largest_or_one(arguments)
    x, y, z = (a / scale for a in arguments)
    total, weight = jnp.zeros_like(x), 3.0
    for _ in range(_STEPS[np.dtype(x.dtype)]):
        step = _duplication_shift(x, y, z)
        total = total + weight / (jnp.sqrt(z) * (z + step))
        x, y, z = 0.25 * (x + step), 0.25 * (y + step), 0.25 * (z + step)
        weight = 0.25 * weight
    mean = (x + y + 3 * z) / 5
    X, Y = 1 - x / mean, 1 - y / mean
    Z = -(X + Y) / 3
    # Once the three arguments are nearly equal, R_D is a Taylor series in their relative
    # differences X, Y, Z from a weighted mean, by the symmetric functions e2 to e5 (DLMF 19.36.2).
    e2 = X * Y - 6 * Z**2
    e3 = (3 * X * Y - 8 * Z**2) * Z
    e4 = 3 * (X * Y - Z**2) * Z**2
    e5 = X * Y * Z**3
    series = 1 - 3 * e2 / 14 + e3 / 6 + 9 * e2**2 / 88 - 3 * e4 / 22 - 9 * e2 * e3 / 52
    series = series + 3 * e5 / 26 - e2**3 / 16 + 3 * e3**2 / 40 + 3 * e2 * e4 / 20
    series = series + 45 * e2**2 * e3 / 272 - 9 * (e3 * e4 + e2 * e5) / 68
    value = total + weight / 3 * series / (mean * jnp.sqrt(mean))
    value = jnp.where(arguments[2] == 0, jnp.inf, value)
    return _in_domain(value / scale / jnp.sqrt(scale), arguments)


@partial(_rd.defjvp, symbolic_zeros=True)
def _rd_jvp(
    primals: tuple[tuple[Array, ...]], tangents: tuple[tuple[Tangent, ...]]
) -> tuple[Array, Array]:
    """Return R_D and its tangent."""
    # With R_D = (3/2) ∫₀^∞ (t + x)^{−1/2} (t + y)^{−1/2} (t + z)^{−3/2} dt, the tangent is a sum of
    # integrals of this kind, in each of which the power of one factor is lower by 1.
    (arguments,), (directions,) = primals, tangents
    tangent = r_tangent((0.5, 0.5, 1.5), arguments, directions)
    return _rd(arguments), 1.5 * tangent


def _duplication_shift(x: Array, y: Array, z: Array) -> Array:
    """Return √x√y + √x√z + √y√z, by which duplication shifts arguments (DLMF 19.26.18)."""
    a, b, c = jnp.sqrt(x), jnp.sqrt(y), jnp.sqrt(z)
    return a * b + b * c + c * a


def _in_domain(value: Array, arguments: tuple[Array, ...]) -> Array:
    """Return the value of a Carlson integral, infinite where two or three arguments are 0, and NaN
    where one is negative or NaN.
    """
    x, y, z = (a == 0 for a in arguments)
    return nan_where_negative(jnp.where((x & y) | (y & z) | (z & x), jnp.inf, value), arguments)
