"""χ² of a Fourier series in two frequencies, for very many pairs, from a table of sums."""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

# Multiples of the first frequency: a brightness squared is of second order in directions.
FIRST = 2
# Entries of the table in 1/span, and their number in an interpolation: times are in an interval of
# length one, so the error is below 1e-8 of the sum of the weights.
DENSE, NEAR = 16, 8
# Programs are compiled for tables in multiples of so many, and for so many pairs at a time.
ROWS, BATCH, FEW, MANY = 4096, 32, 256, 2048
# Side peaks of the spectral window: how many, and how high against its main peak.
SIDES, HIGH = 2, 0.3


class Sums(NamedTuple):
    """Sums over times at f = −4/DENSE, −3/DENSE …; x is the time over the span, less ½.

    `window` is Σ w² exp 2πi f x; `data` Σ w z exp 2πi f x; `total` Σ z².
    """

    window: Complex[Array, " f"]
    data: Complex[Array, " f"]
    total: Float[Array, ""]


def sums(light: tuple[Array, ...], highest: float) -> Sums:
    """The table up to a frequency, 1/span; `light` is times over the span, values and weights."""
    size = math.ceil(highest * DENSE) + 2 * NEAR
    grid = (np.arange(-(-size // ROWS) * ROWS) - NEAR // 2) / DENSE
    x, z, w = light
    window, data = _table(jnp.asarray(grid, x.dtype), x, z, w)
    return Sums(window, data, jnp.sum(z * z))


@jax.jit
def _table(grid: Array, x: Array, z: Array, w: Array) -> tuple[Array, Array]:
    def one(f: Array) -> tuple[Array, Array]:
        angle = 2.0 * math.pi * f * (x - 0.5)
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        squares, values = w * w, w * z
        return (
            jax.lax.complex(jnp.sum(squares * cos), jnp.sum(squares * sin)),
            jax.lax.complex(jnp.sum(values * cos), jnp.sum(values * sin)),
        )

    return jax.lax.map(one, grid, batch_size=BATCH)


def _at(table: Array, f: Array) -> Array:
    """The sum at any frequencies: Lagrange's polynomial through the nearest entries."""
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
    """χ² of the series of each pair (P, 2), in 1/span: `Σ c_jk exp 2πi (j f₁ + k f₂) t`."""
    js, ks = np.meshgrid(np.arange(-FIRST, FIRST + 1), np.arange(-order, order + 1), indexing="ij")
    js, ks = js.ravel(), ks.ravel()
    dj, dk = js[None, :] - js[:, None] + 2 * FIRST, ks[None, :] - ks[:, None] + 2 * order

    def rows(values: Array, pair: Array, first: int, second: int) -> Array:
        """Sums (2 first + 1, 2 second + 1) of all multiples; half of them are conjugates."""
        m, n = np.arange(first + 1.0), np.arange(-second, second + 1.0)
        f = jnp.asarray(m[:, None]) * pair[0] + jnp.asarray(n[None, :]) * pair[1]
        half = _at(values, f)
        return jnp.concatenate([jnp.conj(half[:0:-1, ::-1]), half])

    def one(pair: Array) -> Array:
        window = rows(table.window, pair, 2 * FIRST, 2 * order)
        side = jnp.conj(rows(table.data, pair, FIRST, order).ravel())
        gram = window[dj, dk]
        # Columns that the times do not distinguish.
        gram = gram + 1e-7 * window[2 * FIRST, 2 * order] * jnp.eye(js.size, dtype=gram.dtype)
        factor = jax.scipy.linalg.cho_factor(gram, lower=True)
        c = jax.scipy.linalg.cho_solve(factor, side)
        return table.total - jnp.real(jnp.conj(side) @ c)

    return jax.lax.map(one, pairs, batch_size=BATCH)


def remainder(rows: Array, z: Array) -> tuple[Float[Array, ""], Float[Array, " k"]]:
    """The least |z − cᵀ rows|² of rows (k, T), and c."""
    gram, side = rows @ rows.T, rows @ z
    gram = gram + 1e-9 * jnp.trace(gram) * jnp.eye(side.size, dtype=z.dtype)
    c = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(gram), side)
    return jnp.sum(z * z) - side @ c, c


def filled(rows: np.ndarray) -> np.ndarray:
    """Rows repeated up to one of few lengths: fewer programs to compile."""
    size = FEW if len(rows) <= FEW else -(-len(rows) // MANY) * MANY
    return np.concatenate([rows, np.repeat(rows[:1], size - len(rows), axis=0)])


def misfits_of(table: Sums, pairs: np.ndarray, order: int) -> np.ndarray:
    """`lattice_misfits` of any number of pairs, on the host."""
    out = [np.zeros(0)]
    for first in range(0, len(pairs), MANY):
        some = pairs[first : first + MANY]
        found = lattice_misfits(jnp.asarray(filled(some)), table, order)
        out.append(np.asarray(found)[: len(some)])
    return np.concatenate(out)


def side_peaks(table: Sums, highest: float) -> np.ndarray:
    """The highest side peaks of the spectral window, in 1/span: a line moved by one looks alike."""
    size = math.ceil(highest * DENSE)
    window = np.abs(np.asarray(table.window))[NEAR // 2 : NEAR // 2 + size]
    # Away from the main peak, and the highest within 1/span.
    inner = range(2 * DENSE, size - DENSE)
    peaks = [k for k in inner if window[k] == window[k - DENSE : k + DENSE + 1].max()]
    peaks = sorted((k for k in peaks if window[k] > HIGH * window[0]), key=lambda k: -window[k])
    return np.array(peaks[:SIDES]) / DENSE
