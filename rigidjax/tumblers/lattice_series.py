"""Compute χ² of Fourier series in two frequencies for very many pairs of frequencies, from a table
of sums over the readings.

The normal equations of a series contain only sums over the times, at sums of multiples of the two
frequencies. These sums are interpolated in a table, so that χ² of a pair of frequencies needs no
loop over the readings.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

# The highest multiple of the first frequency is two, since a squared brightness is of second order
# in directions.
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
    """Hold the table of sums over times at the frequencies f = −4/DENSE, −3/DENSE, … in 1/span.

    **Fields:** `window` Σ w² exp 2πi f x; `data` Σ w z exp 2πi f x; `total` Σ z². Here x is the
    time of a reading divided by the span, minus ½; z is its value divided by its noise; and w is
    one over the noise.
    """

    window: Complex[Array, " f"]
    data: Complex[Array, " f"]
    total: Float[Array, ""]


def sum_table(light: tuple[Array, ...], highest: float) -> Sums:
    """Return the table of sums up to the frequency `highest`, 1/span.

    `light` holds three arrays (T,): the times divided by the span; the values divided by their
    noise; and one over the noise.
    """
    size = math.ceil(highest * DENSE) + 2 * NEAR
    grid = (np.arange(-(-size // ROWS) * ROWS) - NEAR // 2) / DENSE
    x, z, w = light
    window, data = _table(jnp.asarray(grid, x.dtype), x, z, w)
    return Sums(window, data, jnp.sum(z * z))


@jax.jit
def _table(grid: Array, x: Array, z: Array, w: Array) -> tuple[Array, Array]:
    """Return the sums `window` and `data` of `Sums` at the frequencies `grid`."""

    def sums_at(f: Array) -> tuple[Array, Array]:
        angle = 2.0 * math.pi * f * (x - 0.5)
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        squares, values = w * w, w * z
        return (
            jax.lax.complex(jnp.sum(squares * cos), jnp.sum(squares * sin)),
            jax.lax.complex(jnp.sum(values * cos), jnp.sum(values * sin)),
        )

    return jax.lax.map(sums_at, grid, batch_size=BATCH)


def _interpolate(table: Array, f: Array) -> Array:
    """Return the sums at the frequencies f, 1/span, from the polynomial (Lagrange) through the
    nearest entries of the `table`.
    """
    place = jnp.abs(f) * DENSE
    first = jnp.floor(place)
    part = place - first
    index = first.astype(jnp.int32) + 1
    real = imaginary = jnp.zeros(f.shape, part.dtype)
    nodes = np.arange(NEAR) - NEAR // 2 + 1
    for k in range(NEAR):
        others = np.delete(nodes, k)
        weight = jnp.full_like(part, 1 / np.prod(nodes[k] - others))
        for other in others:
            weight = weight * (part - float(other))
        entry = table[index + k]
        real, imaginary = real + weight * entry.real, imaginary + weight * entry.imag
    return jax.lax.complex(real, jnp.where(f < 0, -imaginary, imaginary))


@functools.partial(jax.jit, static_argnums=2)
def lattice_misfits(pairs: Array, table: Sums, order: int) -> Float[Array, " pairs"]:
    """Return χ² of the best series `Σ c_jk exp 2πi (j f₁ + k f₂) t` for each pair (f₁, f₂).

    The `pairs` (P, 2) are in 1/span. The sum has |j| ≤ 2 and |k| ≤ `order`.
    """
    js, ks = np.meshgrid(np.arange(-FIRST, FIRST + 1), np.arange(-order, order + 1), indexing="ij")
    js, ks = js.ravel(), ks.ravel()
    dj, dk = js[None, :] - js[:, None] + 2 * FIRST, ks[None, :] - ks[:, None] + 2 * order

    def rows(values: Array, pair: Array, first: int, second: int) -> Array:
        """Return the sums (2 first + 1, 2 second + 1) at all multiples of both frequencies of a
        pair.
        """
        # Only half of the sums are interpolated, since sums at opposite frequencies are complex
        # conjugates.
        m, n = np.arange(first + 1.0), np.arange(-second, second + 1.0)
        f = jnp.asarray(m[:, None]) * pair[0] + jnp.asarray(n[None, :]) * pair[1]
        half = _interpolate(values, f)
        return jnp.concatenate([jnp.conj(half[:0:-1, ::-1]), half])

    def misfit_of_pair(pair: Array) -> Array:
        window = rows(table.window, pair, 2 * FIRST, 2 * order)
        side = jnp.conj(rows(table.data, pair, FIRST, order).ravel())
        gram = window[dj, dk]
        # The small diagonal keeps the matrix definite if two columns are equal at all times of the
        # readings.
        gram = gram + 1e-7 * window[2 * FIRST, 2 * order] * jnp.eye(js.size, dtype=gram.dtype)
        factor = jax.scipy.linalg.cho_factor(gram, lower=True)
        c = jax.scipy.linalg.cho_solve(factor, side)
        return table.total - jnp.real(jnp.conj(side) @ c)

    return jax.lax.map(misfit_of_pair, pairs, batch_size=BATCH)


def least_squares_remainder(rows: Array, z: Array) -> tuple[Float[Array, ""], Float[Array, " k"]]:
    """Return two things: the smallest value of `|z − cᵀ rows|²` over c, for `rows` (k, T) and z
    (T,); and the coefficients c (k,) there.
    """
    gram, side = rows @ rows.T, rows @ z
    gram = gram + 1e-9 * jnp.trace(gram) * jnp.eye(side.size, dtype=z.dtype)
    c = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(gram), side)
    return jnp.sum(z * z) - side @ c, c


def pad_rows(rows: np.ndarray) -> np.ndarray:
    """Return `rows` padded with copies of its first row to the length `FEW` or a multiple of
    `MANY`, so that few programs are compiled.
    """
    size = FEW if len(rows) <= FEW else -(-len(rows) // MANY) * MANY
    return np.concatenate([rows, np.repeat(rows[:1], size - len(rows), axis=0)])


def lattice_chi2(table: Sums, pairs: np.ndarray, order: int) -> np.ndarray:
    """Return `lattice_misfits` for any number of pairs (P, 2), as a NumPy array."""
    out = [np.zeros(0)]
    for first in range(0, len(pairs), MANY):
        chunk = pairs[first : first + MANY]
        misfits = lattice_misfits(jnp.asarray(pad_rows(chunk)), table, order)
        out.append(np.asarray(misfits)[: len(chunk)])
    return np.concatenate(out)


def side_peaks(table: Sums, highest: float) -> np.ndarray:
    """Return the positions of the highest side peaks of the spectral window, in 1/span.

    A spectral line whose frequency is shifted by such a position gives nearly the same readings.
    """
    size = math.ceil(highest * DENSE)
    window = np.abs(np.asarray(table.window))[NEAR // 2 : NEAR // 2 + size]
    # A side peak is at least 2/span away from the main peak, and is the highest entry within 1/span
    # on both sides.
    inner = range(2 * DENSE, size - DENSE)
    peaks = [k for k in inner if window[k] == window[k - DENSE : k + DENSE + 1].max()]
    peaks = sorted((k for k in peaks if window[k] > HIGH * window[0]), key=lambda k: -window[k])
    return np.array(peaks[:SIDES]) / DENSE
