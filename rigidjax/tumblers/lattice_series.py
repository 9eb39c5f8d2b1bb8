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
    """Hold sums over the readings of a light curve, at F evenly spaced frequencies f, in 1/span.

    The span is the time from the first to the last reading. The frequencies are −4/16, −3/16, −2/16
    and so on (16 is `DENSE` and 4 is half of `NEAR`).

    **Fields:** `window` (F,) the sums Σ w² exp 2πi f x; `data` (F,) the sums Σ w z exp 2πi f x;
    `total` the sum Σ z². Here x is the time of a reading divided by the span, minus ½; z is its
    value divided by its noise; and w is one over the noise.
    """

    window: Complex[Array, " f"]
    data: Complex[Array, " f"]
    total: Float[Array, ""]


def fourier_sum_table(light: tuple[Array, ...], highest: float) -> Sums:
    """Return the table of sums over the readings of a light curve, up to the frequency `highest`.

    `fourier_chi2_of_padded_pairs` computes χ² of Fourier series from this table.

    - `light`: the light curve as three arrays (T,): the times of the readings divided by the span
      (the time from the first to the last reading); the values divided by their noise; and one over
      the noise.
    - `highest`: the highest frequency of the table, 1/span.
    """
    size = math.ceil(highest * DENSE) + 2 * NEAR
    grid = (np.arange(-(-size // ROWS) * ROWS) - NEAR // 2) / DENSE
    x, z, w = light
    window, data = _fourier_sums_at_frequencies(jnp.asarray(grid, x.dtype), x, z, w)
    return Sums(window, data, jnp.sum(z * z))


@jax.jit
def _fourier_sums_at_frequencies(
    frequencies: Array, x: Array, z: Array, w: Array
) -> tuple[Complex[Array, " f"], Complex[Array, " f"]]:
    """Return two arrays (F,) of complex sums over the T readings of a light curve, one entry for
    each of the F `frequencies` f: `Σ w² exp 2πi f (x − ½)`; and `Σ w z exp 2πi f (x − ½)`.

    - `frequencies`: (F,) in 1/span, where the span is the time from the first to the last
      reading.
    - `x`: (T,) the times of the readings divided by the span.
    - `z`: (T,) the values divided by their noise.
    - `w`: (T,) one over the noise.
    """

    def sums_at(f: Array) -> tuple[Array, Array]:
        angle = 2.0 * math.pi * f * (x - 0.5)
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        squares, values = w * w, w * z
        return (
            jax.lax.complex(jnp.sum(squares * cos), jnp.sum(squares * sin)),
            jax.lax.complex(jnp.sum(values * cos), jnp.sum(values * sin)),
        )

    return jax.lax.map(sums_at, frequencies, batch_size=BATCH)


def _interpolate_sums(
    table: Complex[Array, " entries"], frequencies: Float[Array, "*shape"]
) -> Complex[Array, "*shape"]:
    """Return complex sums over the readings of a light curve at the wanted `frequencies`,
    interpolated in a `table` of sums at other frequencies.

    The interpolation is the polynomial (Lagrange) through the 8 nearest entries (`NEAR`).

    - `table`: (F,) the complex sums at the frequencies (k − 4)/16, in 1/span, for k = 0, 1, …,
      F − 1 (16 is `DENSE`, the number of entries for each 1/span, and 4 is half of `NEAR`). The
      span is the time from the first to the last reading.
    - `frequencies`: in 1/span, an array of any shape, which is also the shape of the result. The
      sum at a negative frequency is the complex conjugate of the sum at the opposite frequency.
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
def fourier_chi2_of_padded_pairs(pairs: Array, table: Sums, order: int) -> Float[Array, " pairs"]:
    """Return χ² of the best Fourier series `Σ c_jk exp 2πi (j f₁ + k f₂) t` for each pair of
    frequencies (f₁, f₂).

    The series has the multiples |j| ≤ 2 and |k| ≤ `order`; t is the time divided by the span, and
    the coefficients c_jk are those of the least-squares fit to the readings.

    - `pairs`: (P, 2) the frequencies f₁ and f₂, 1/span, where the span is the time from the first
      to the last reading.
    - `table`: the sums over the readings, as `fourier_sum_table` returns them.
    - `order`: the largest multiple of f₂.
    """
    js, ks = np.meshgrid(np.arange(-FIRST, FIRST + 1), np.arange(-order, order + 1), indexing="ij")
    js, ks = js.ravel(), ks.ravel()
    dj, dk = js[None, :] - js[:, None] + 2 * FIRST, ks[None, :] - ks[:, None] + 2 * order

    def sums_at_multiples(
        sums: Complex[Array, " entries"],
        pair: Float[Array, "2"],
        first_order: int,
        second_order: int,
    ) -> Complex[Array, "rows columns"]:
        """Return the sums (2 m + 1, 2 n + 1) over the readings at the frequencies j f₁ + k f₂, for
        whole numbers |j| ≤ m and |k| ≤ n.

        - `sums`: (F,) the table of these sums, complex, at F evenly spaced frequencies: the field
          `window` or `data` of `Sums`.
        - `pair`: (2,) the frequencies f₁ and f₂, 1/span, where the span is the time from the first
          to the last reading.
        - `first_order`: m, the largest multiple of f₁.
        - `second_order`: n, the largest multiple of f₂.
        """
        # Only half of the sums are interpolated, since sums at opposite frequencies are complex
        # conjugates.
        m, n = np.arange(first_order + 1.0), np.arange(-second_order, second_order + 1.0)
        f = jnp.asarray(m[:, None]) * pair[0] + jnp.asarray(n[None, :]) * pair[1]
        half = _interpolate_sums(sums, f)
        return jnp.concatenate([jnp.conj(half[:0:-1, ::-1]), half])

    def misfit_of_pair(pair: Array) -> Array:
        window = sums_at_multiples(table.window, pair, 2 * FIRST, 2 * order)
        side = jnp.conj(sums_at_multiples(table.data, pair, FIRST, order).ravel())
        gram = window[dj, dk]
        # The small diagonal keeps the matrix definite if two columns are equal at all times of the
        # readings.
        gram = gram + 1e-7 * window[2 * FIRST, 2 * order] * jnp.eye(js.size, dtype=gram.dtype)
        factor = jax.scipy.linalg.cho_factor(gram, lower=True)
        c = jax.scipy.linalg.cho_solve(factor, side)
        return table.total - jnp.real(jnp.conj(side) @ c)

    return jax.lax.map(misfit_of_pair, pairs, batch_size=BATCH)


def least_squares_remainder(rows: Array, z: Array) -> tuple[Float[Array, ""], Float[Array, " k"]]:
    """Fit z by a linear combination of rows. Return two things: the smallest value of `|z − cᵀ
    rows|²` over the coefficients c; and the coefficients c (k,) there.

    - `rows`: (k, T) the values of k functions at T times.
    - `z`: (T,) the values to which a linear combination of the k functions is fitted.
    """
    gram, side = rows @ rows.T, rows @ z
    gram = gram + 1e-9 * jnp.trace(gram) * jnp.eye(side.size, dtype=z.dtype)
    c = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(gram), side)
    return jnp.sum(z * z) - side @ c, c


def pad_rows(rows: np.ndarray) -> np.ndarray:
    """Return the array `rows` (n, …) padded with copies of its first row, so that few different
    lengths occur and few programs are compiled.

    The new length is 256 (`FEW`) for at most 256 rows, else the next multiple of 2048 (`MANY`).
    """
    size = FEW if len(rows) <= FEW else -(-len(rows) // MANY) * MANY
    return np.concatenate([rows, np.repeat(rows[:1], size - len(rows), axis=0)])


def fourier_chi2_of_pairs(table: Sums, pairs: np.ndarray, order: int) -> np.ndarray:
    """Return χ² (P,) of the best Fourier series in two frequencies for any number P of pairs, as a
    NumPy array.

    The pairs are given to `fourier_chi2_of_padded_pairs` in chunks, so that few programs are
    compiled.

    - `table`: the sums over the readings, as `fourier_sum_table` returns them.
    - `pairs`: (P, 2) the two frequencies of each series, 1/span.
    - `order`: the largest multiple of the second frequency.
    """
    out = [np.zeros(0)]
    for first in range(0, len(pairs), MANY):
        chunk = pairs[first : first + MANY]
        misfits = fourier_chi2_of_padded_pairs(jnp.asarray(pad_rows(chunk)), table, order)
        out.append(np.asarray(misfits)[: len(chunk)])
    return np.concatenate(out)


def side_peaks_of_window(table: Sums, highest: float) -> np.ndarray:
    """Return the positions (n,), n ≤ 2, of the highest side peaks of the spectral window, in
    1/span, the highest first.

    The spectral window is the spectrum of the times of the readings alone, which is the field
    `window` of the `table`. If the frequency of a line (a sinusoid) is shifted by such a position,
    the line gives nearly the same readings. Peaks are sought up to the frequency `highest`, 1/span.
    """
    size = math.ceil(highest * DENSE)
    window = np.abs(np.asarray(table.window))[NEAR // 2 : NEAR // 2 + size]
    # A side peak is at least 2/span away from the main peak, and is the highest entry within 1/span
    # on both sides.
    inner = range(2 * DENSE, size - DENSE)
    peaks = [k for k in inner if window[k] == window[k - DENSE : k + DENSE + 1].max()]
    peaks = sorted((k for k in peaks if window[k] > HIGH * window[0]), key=lambda k: -window[k])
    return np.array(peaks[:SIDES]) / DENSE
