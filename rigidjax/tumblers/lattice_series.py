"""Compute χ² of Fourier series in two frequencies for very many pairs of frequencies, from a table
of sums over the readings.

The normal equations of a series contain only sums over the readings, at frequencies j f₁ + k f₂
with whole numbers j and k, where f₁ and f₂ are the two frequencies. These sums are interpolated in
a table, so that χ² of a pair of frequencies needs no loop over the readings.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

# The highest multiple of the first frequency, that of precession, is two: the squared brightness is
# nearly a quadratic form of the direction half way between sun and observer, in the axes of the
# body, and precession turns these axes at the first frequency.
FIRST = 2
# The span is the time from the first to the last reading. The table has DENSE entries for each
# frequency interval of 1/span. Each interpolation uses the NEAR nearest entries, and its error is
# below 1e-8 of the sum of the weights.
DENSE, NEAR = 16, 8
# The number of entries of a table is a multiple of ROWS, and pairs are padded to FEW or a multiple
# of MANY, so that few programs are compiled. A program computes BATCH pairs in parallel.
ROWS, BATCH, FEW, MANY = 4096, 32, 256, 2048
# At most SIDES side peaks of the spectral window are used, of at least HIGH times the height of the
# main peak.
SIDES, HIGH = 2, 0.3


class Sums(NamedTuple):
    """Hold sums over the readings of a light curve, at the evenly spaced frequencies f = (k −
    4)/16, k = 0, 1, …, in 1/span (4 is half of `NEAR`, 16 is `DENSE`).

    Here x is the time of a reading divided by the span, minus ½; z is its value divided by its
    noise; and w is one over the noise.
    """

    window: Complex[Array, " f"]  # Σ w² exp 2πi f x
    data: Complex[Array, " f"]  # Σ w z exp 2πi f x
    total: Float[Array, ""]  # Σ z²


class Light(NamedTuple):
    """Hold a light curve as arrays that may be padded with readings of weight w = 0."""

    x: Float[Array, " times"]  # the times since the first, s, or divided by the span
    z: Float[Array, " times"]  # the values divided by their noise
    w: Float[Array, " times"]  # one over the noise


def sum_table(light: Light, highest: float) -> Sums:
    """Return the sums over the readings of a light curve, up to the frequency `highest`, 1/span."""
    size = math.ceil(highest * DENSE) + 2 * NEAR
    grid = (np.arange(-(-size // ROWS) * ROWS) - NEAR // 2) / DENSE
    window, data = _sums(jnp.asarray(grid, light.x.dtype), *light)
    return Sums(window, data, jnp.sum(light.z * light.z))


@jax.jit
def _sums(
    frequencies: Array, x: Array, z: Array, w: Array
) -> tuple[Complex[Array, " f"], Complex[Array, " f"]]:
    """Return the fields `window` and `data` of `Sums` at any frequencies, 1/span."""

    def sums_at(f: Array) -> tuple[Array, Array]:
        angle = 2.0 * math.pi * f * (x - 0.5)
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        squares, values = w * w, w * z
        return (
            jax.lax.complex(jnp.sum(squares * cos), jnp.sum(squares * sin)),
            jax.lax.complex(jnp.sum(values * cos), jnp.sum(values * sin)),
        )

    return jax.lax.map(sums_at, frequencies, batch_size=BATCH)


def _interpolated_sums(
    table: Complex[Array, " entries"], frequencies: Float[Array, "*shape"]
) -> Complex[Array, "*shape"]:
    """Return the sums at the wanted frequencies, 1/span, by the polynomial (Lagrange) through the 8
    nearest entries (`NEAR`) of a field of `Sums`.

    The sum at a negative frequency is the complex conjugate of the sum at the opposite frequency.
    """
    place = jnp.abs(frequencies) * DENSE
    first = jnp.floor(place)
    part = place - first
    index = first.astype(jnp.int32) + 1
    real = imaginary = jnp.zeros(frequencies.shape, part.dtype)
    nodes = np.arange(NEAR) - NEAR // 2 + 1
    for k in range(NEAR):
        others = np.delete(nodes, k)
        weight = jnp.full_like(part, 1 / np.prod(nodes[k] - others))
        for other in others:
            weight = weight * (part - float(other))
        entry = table[index + k]
        real, imaginary = real + weight * entry.real, imaginary + weight * entry.imag
    return jax.lax.complex(real, jnp.where(frequencies < 0, -imaginary, imaginary))


@functools.partial(jax.jit, static_argnums=2)
def chi2_of_padded(pairs: Array, table: Sums, order: int) -> Float[Array, " pairs"]:
    """Return χ² of the best Fourier series `Σ c_jk exp 2πi (j f₁ + k f₂) t` for each pair of
    frequencies (f₁, f₂), 1/span, with |j| ≤ 2 and |k| ≤ `order`; t is the time divided by the span.
    """
    js, ks = np.meshgrid(np.arange(-FIRST, FIRST + 1), np.arange(-order, order + 1), indexing="ij")
    js, ks = js.ravel(), ks.ravel()
    dj, dk = js[None, :] - js[:, None] + 2 * FIRST, ks[None, :] - ks[:, None] + 2 * order

    def multiples(sums: Array, pair: Array, first: int, second: int) -> Array:
        # Return the sums at the frequencies j f₁ + k f₂ for |j| ≤ `first` and |k| ≤ `second`. Only
        # half of them are interpolated, since sums at opposite frequencies are complex conjugates.
        m, n = np.arange(first + 1.0), np.arange(-second, second + 1.0)
        f = jnp.asarray(m[:, None]) * pair[0] + jnp.asarray(n[None, :]) * pair[1]
        half = _interpolated_sums(sums, f)
        return jnp.concatenate([jnp.conj(half[:0:-1, ::-1]), half])

    def chi2(pair: Array) -> Array:
        window = multiples(table.window, pair, 2 * FIRST, 2 * order)
        side = jnp.conj(multiples(table.data, pair, FIRST, order).ravel())
        gram = window[dj, dk]
        # The small diagonal keeps the matrix definite if two columns are equal at all times of the
        # readings.
        gram = gram + 1e-7 * window[2 * FIRST, 2 * order] * jnp.eye(js.size, dtype=gram.dtype)
        factor = jax.scipy.linalg.cho_factor(gram, lower=True)
        c = jax.scipy.linalg.cho_solve(factor, side)
        return table.total - jnp.real(jnp.conj(side) @ c)

    return jax.lax.map(chi2, pairs, batch_size=BATCH)


def remainder(
    rows: Float[Array, "k times"], z: Float[Array, " times"]
) -> tuple[Float[Array, ""], Float[Array, " k"]]:
    """Return the least `|z − cᵀ rows|²` over the coefficients c, and the best c."""
    gram, side = rows @ rows.T, rows @ z
    gram = gram + 1e-9 * jnp.trace(gram) * jnp.eye(side.size, dtype=z.dtype)
    c = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(gram), side)
    return jnp.sum(z * z) - side @ c, c


def pad_rows(rows: np.ndarray) -> np.ndarray:
    """Return rows padded with copies of the first, so that few programs are compiled."""
    size = FEW if len(rows) <= FEW else -(-len(rows) // MANY) * MANY
    return np.concatenate([rows, np.repeat(rows[:1], size - len(rows), axis=0)])


def chi2_of_pairs(
    table: Sums, pairs: Float[np.ndarray, "pairs 2"], order: int
) -> Float[np.ndarray, " pairs"]:
    """Return χ² of the best Fourier series in each of any number of frequency pairs, 1/span."""
    out = [np.zeros(0)]
    for first in range(0, len(pairs), MANY):
        chunk = pairs[first : first + MANY]
        chi2 = chi2_of_padded(jnp.asarray(pad_rows(chunk)), table, order)
        out.append(np.asarray(chi2)[: len(chunk)])
    return np.concatenate(out)


def highest_side_peaks(table: Sums, highest: float) -> np.ndarray:
    """Return the positions of the at most two highest side peaks of the spectral window (the field
    `window` of the `table`), 1/span, the highest first.

    A line whose frequency is shifted by such a position gives nearly the same readings.
    """
    size = math.ceil(highest * DENSE)
    window = np.abs(np.asarray(table.window))[NEAR // 2 : NEAR // 2 + size]
    # A side peak is at least 2/span away from the main peak, and is the highest entry within 1/span
    # on both sides.
    inner = range(2 * DENSE, size - DENSE)
    peaks = [k for k in inner if window[k] == window[k - DENSE : k + DENSE + 1].max()]
    peaks = sorted((k for k in peaks if window[k] > HIGH * window[0]), key=lambda k: -window[k])
    return np.array(peaks[:SIDES]) / DENSE
