"""Find pairs of frequencies whose Fourier series fit a light curve best."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.tumblers.lattice_series import (
    BATCH,
    FIRST,
    Light,
    Sums,
    chi2_of_pairs,
    highest_side_peaks,
    pad_rows,
    remainder,
    sum_table,
)

# A line is a peak of the spectrum. One of the LINES strongest lines must be a combination of the
# two frequencies of a pair. The first frequency is on a grid with the step STEP, 1/span, where the
# span is the time from the first to the last reading.
LINES, STEP = 3, 0.1
# The largest second frequency of the search is SECOND times the highest frequency of the LINES
# strongest lines.
SECOND = 1.5
# For each pair that is returned, TRIED pairs are refined.
TRIED = 2
# Squares of numbers above LARGEST may overflow. If more than MOST of the shortest periods fit into
# the span, a search takes hours.
LARGEST, MOST = 1e100, 1e5
# The arrays of a light curve are padded to a length that is a multiple of BLOCK, so that few
# programs are compiled.
BLOCK = 256
# Two pairs count as the same if both frequencies differ by less than this, in 1/span.
NEAR = 0.25
# The aliases of the SEEDS best pairs are tried, in at most ROUNDS rounds.
SEEDS, ROUNDS = 16, 3
# These are the offsets, in steps, of a pair (0, 0) and of its eight neighbours on a square grid.
AROUND = np.array([(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)], float)


class TwoFrequencies(eqx.Module):
    """Hold the result of `two_frequencies`: pairs of frequencies, in the order of their χ².

    **Fields:**

    - `frequencies`: (n, 2) the pairs, 1/s.
    - `misfits`: (n,) χ² of the best Fourier series of each pair. If the noise is not known, it is
      chosen such that the smallest χ² equals `dof`.
    - `dof`: the degrees of freedom of each χ².
    - `scatter`: the standard deviation of the residuals of the best pair, in the values' unit.
    - `lines`: (m,) the strongest lines of the spectrum, 1/s.

    >>> t = np.linspace(0.0, 60.0, 300)
    >>> y = 1 + np.cos(2 * np.pi * 0.4 * t) + 0.5 * np.cos(2 * np.pi * 0.7 * t + 1.0)
    >>> pairs = two_frequencies(t, y, 0.1)
    >>> sorted(pairs.lines[:2].round(2).tolist())
    [0.4, 0.7]
    """

    frequencies: Float[np.ndarray, "n 2"]
    misfits: Float[np.ndarray, " n"]
    dof: int
    scatter: float
    lines: Float[np.ndarray, " m"]


def two_frequencies(
    t: Float[ArrayLike, " times"],
    values: Float[ArrayLike, " values"],
    noise: float | Float[ArrayLike, " noises"] | None = None,
    *,
    order: int = 1,
    shortest: float | None = None,
    count: int = 12,
) -> TwoFrequencies:
    """Find the pairs (f₁, f₂) whose Fourier series `Σ c_jk exp 2πi (j f₁ + k f₂) t` fit best.

    The multiples j go from −2 to 2, k from −`order` to `order`. One of the three strongest lines of
    the spectrum must be j f₁ + k f₂: all pairs with this property are tried on a grid, and the best
    ones are refined. Then the aliases of the best pairs are tried. An alias of a pair differs from
    the pair in one of three ways. In the first, one frequency or both are shifted by the position
    of a side peak of the spectral window, or by half of this position (readings at night have side
    peaks at one and two cycles a day). In the second, one frequency is halved or doubled. In the
    third, f₁ is added to f₂ or subtracted from f₂. Several pairs give the same set of lines. All
    pairs that fit are returned, since only a fit of the motion can decide between the pairs.

    **Arguments:**

    - `t`: (T,) increasing times, s; gaps are allowed.
    - `values`: (T,) fluxes or their squares.
    - `noise`: the standard deviation of `values`, one number or (T,); `None` if it is not known.
    - `order`: the largest multiple k of f₂.
    - `shortest`: the shortest period of a line, s; `None` for four times the median interval
      between the times.
    - `count`: the largest number of pairs.

    **Returns** `frequencies`, `misfits`, `dof`, `scatter` and `lines` (`TwoFrequencies`).

    Source: Pravec et al. 2005, Icarus 173:108, doi:10.1016/j.icarus.2004.07.021 (there with the
    same largest |j| and |k|); the linear fit is that of Lomb 1976, doi:10.1007/BF00648343, for many
    lines. **Raises:** `ValueError` for times that do not increase, NaN, too few values.

    >>> t = np.linspace(0.0, 60.0, 300)
    >>> y = 1 + np.cos(2 * np.pi * 0.4 * t) + 0.5 * np.cos(2 * np.pi * 0.7 * t + 1.0)
    >>> pairs = two_frequencies(t, y, 0.1)
    >>> bool(pairs.misfits[0] < 0.1)
    True
    """
    t, y = _checks.host_array(t, "t"), _checks.host_array(values, "values")
    order, count = _checks.integer(order, "order", 1), _checks.integer(count, "count", 1)
    unknowns = (2 * FIRST + 1) * (2 * order + 1) + 2
    if t.ndim != 1 or y.shape != t.shape:
        raise ValueError(f"values: wanted (T,) as t has, got shapes {t.shape} and {y.shape}")
    if t.size <= unknowns:
        raise ValueError(f"t: wanted more times than the {unknowns} unknowns, got {t.size}")
    if not (np.isfinite(t).all() and np.isfinite(y).all()):
        raise ValueError("two_frequencies: t or values contain NaN or infinity; leave gaps out")
    if not (np.diff(t) > 0).all():
        raise ValueError(
            "t: wanted increasing times, got some that are equal or decrease; sort the readings by "
            "their times, and keep one for each time"
        )
    sigma = np.ones(t.shape)
    if noise is not None:
        sigma = _checks.host_array(noise, "noise")
        if sigma.shape not in ((), t.shape):
            raise ValueError(f"noise: wanted one number or (T,) as t has, got shape {sigma.shape}")
        if not (np.isfinite(sigma) & (sigma > 0)).all():
            raise ValueError(
                "noise: wanted positive standard deviations, got one that is zero, negative or not "
                "finite"
            )
        sigma = np.broadcast_to(sigma, t.shape)
    with np.errstate(over="ignore"):
        worst = max(np.abs(y).max() / sigma.min(), 1 / sigma.min(), sigma.max())
    if worst > LARGEST:
        raise ValueError(
            f"values: wanted numbers, noise and their ratios up to {LARGEST:.0e}, since their "
            f"squares are added, got {worst:.3g}; give both in another unit"
        )
    span, typical = float(t[-1] - t[0]), float(np.median(np.diff(t)))
    least = 4.0 * typical if shortest is None else _checks.positive_float(shortest, "shortest")
    if span / least > MOST:
        raise ValueError(
            f"shortest: a light curve of {span:.3g} s has {span / least:.3g} periods of "
            f"{least:.3g} s, wanted at most {MOST:.0e} periods in it; give a longer period"
        )
    light = pad_light_curve((t - t[0]) / span, y / sigma, 1.0 / sigma)
    lines = strongest_lines(light, span / least, 2 * LINES)
    highest = SECOND * float(lines[:LINES].max())
    # The table covers all combinations of multiples of the two frequencies of a pair, also after
    # the refinement has moved a pair beyond the highest frequency.
    table = sum_table(light, 2 * (FIRST + order) * (highest + 1.0))
    # Try all pairs on a grid of which a strong line is a sum or difference of small multiples.
    grid = np.arange(0.5, 0.8 * float(lines[:LINES].max()) + 0.5, STEP)
    whole = np.arange(0.5, highest, STEP)
    rows = []
    for line in lines[:LINES]:
        rows.append(np.stack([grid, np.full(grid.shape, line)], axis=1))
        for j in (1, 2):
            rows.append(np.stack([np.full(whole.shape, line / j), whole], axis=1))
            for second in (line - j * grid, j * grid - line, line + j * grid):
                rows.append(np.stack([grid, second], axis=1))
    pairs = np.concatenate(rows)
    pairs = pairs[(pairs[:, 1] > 0.5) & (pairs[:, 1] < highest)]
    misfits = chi2_of_pairs(table, pairs, order)
    pairs, misfits = lower_chi2(table, pairs[distinct_pairs(pairs, misfits, count * TRIED)], order)
    pairs, misfits = with_aliases(table, pairs, misfits, highest, order)
    keep = distinct_pairs(pairs, misfits, count)
    dof = t.size - unknowns
    best = max(float(misfits[keep[0]]), 1e-300)
    scatter = float(np.sqrt(best / dof / np.mean(1.0 / sigma**2)))
    scale = 1.0 if noise is not None else dof / best
    return TwoFrequencies(pairs[keep] / span, misfits[keep] * scale, dof, scatter, lines / span)


def pad_light_curve(x: np.ndarray, z: np.ndarray, w: np.ndarray) -> Light:
    """Return arrays padded with zeros to a multiple of `BLOCK`: few programs are compiled."""
    more = -x.size % BLOCK
    return Light(*(jnp.asarray(np.pad(v, (0, more))) for v in (x, z, w)))


def strongest_lines(light: Light, highest: float, count: int) -> np.ndarray:
    """Return the strongest lines of the spectrum up to `highest`, 1/span, strongest first.

    A line is a sinusoid plus a constant. Each is subtracted before the next one is sought.
    """
    grid = np.arange(0.5, max(highest, 2.0), 0.2)
    x, z, w = (np.asarray(v) for v in light)
    lines = []
    for _ in range(count):
        line, curve = (np.asarray(v) for v in _best_sinusoid(jnp.asarray(pad_rows(grid)), x, z, w))
        lines.append(float(line))
        z = z - w * curve
    return np.array(lines)


@jax.jit
def _best_sinusoid(
    grid: Array, x: ArrayLike, z: ArrayLike, w: ArrayLike
) -> tuple[Scalar, Float[Array, " times"]]:
    """Return the frequency of `grid`, 1/span, whose sinusoid plus a constant fits the readings
    best, and that curve at the times of the readings.
    """
    x, z, w = jnp.asarray(x), jnp.asarray(z), jnp.asarray(w)

    def sinusoid_rows(f: Array) -> Array:
        angle = 2.0 * math.pi * f * x
        return jnp.stack([jnp.ones_like(x), jnp.cos(angle), jnp.sin(angle)])

    left, c = jax.lax.map(
        lambda f: remainder(sinusoid_rows(f) * w[None], z), grid, batch_size=BATCH
    )
    best = jnp.argmin(left)
    return grid[best], c[best] @ sinusoid_rows(grid[best])


def aliases_of(
    pairs: Float[np.ndarray, "pairs 2"], peaks: Float[np.ndarray, " peaks"]
) -> Float[np.ndarray, "aliases 2"]:
    """Return the aliases of the pairs of frequencies (see `two_frequencies`), for given positions
    of side `peaks`, all in 1/span.
    """
    moves = np.unique(np.concatenate([[0.0], *((p, -p, p / 2, -p / 2) for p in peaks)]))
    first, second = pairs.T[:, :, None]
    moved = [
        np.stack([first + a, second + b], axis=-1) for a in moves for b in moves if a != 0 or b != 0
    ]
    related = ((first / 2, second), (2 * first, second), (first, second / 2), (first, 2 * second))
    related += ((first, second + first), (first, second - first))
    rows = [*moved, *(np.stack(one, axis=-1) for one in related)]
    # A sum or difference above may be a negative frequency. Its sign is dropped, since the pair
    # (f₁, −f₂) has the same lines j f₁ + k f₂ as the pair (f₁, f₂).
    return np.abs(np.concatenate(rows).reshape(-1, 2))


class Pairs(NamedTuple):
    """Hold pairs of frequencies, 1/span, and χ² of each."""

    frequencies: np.ndarray  # (n, 2)
    chi2: np.ndarray  # (n,)


def with_aliases(
    table: Sums, pairs: np.ndarray, misfits: np.ndarray, highest: float, order: int
) -> Pairs:
    """Add the aliases of the best `pairs` up to the frequency `highest`, 1/span, in rounds that end
    when no alias is better than the best pair.
    """
    peaks = highest_side_peaks(table, highest)
    for _ in range(ROUNDS):
        seeds = pairs[distinct_pairs(pairs, misfits, SEEDS)]
        more = (aliases_of(seeds, peaks)[:, None] + 0.2 * AROUND).reshape(-1, 2)
        more = more[((more > 0.5) & (more < highest)).all(axis=1)]
        if not len(more):
            break
        best = distinct_pairs(more, chi2_of_pairs(table, more, order), 2 * SEEDS)
        more, new = lower_chi2(table, more[best], order)
        before = misfits.min()
        pairs, misfits = np.concatenate([pairs, more]), np.concatenate([misfits, new])
        if not new.min() < before * (1 - 1e-3):
            break
    return Pairs(pairs, misfits)


def distinct_pairs(pairs: np.ndarray, misfits: np.ndarray, count: int) -> list[int]:
    """Return the indices of the best pairs whose first or second frequencies differ by more than
    `NEAR`, in the order of their χ².
    """
    chosen: list[int] = []
    for index in np.argsort(misfits)[:20_000]:
        if not chosen or np.abs(pairs[chosen] - pairs[index]).max(axis=1).min() > NEAR:
            chosen.append(int(index))
        if len(chosen) == count:
            break
    return chosen


def lower_chi2(table: Sums, pairs: np.ndarray, order: int) -> Pairs:
    """Return each pair, moved nine times to the best of its neighbours on a square grid.

    Where no neighbour has a lower χ², the pair stays and its grid becomes finer.
    """
    size = np.full(len(pairs), 0.08)
    least = np.full(len(pairs), np.inf)
    for _ in range(9):
        neighbours = pairs[:, None] + size[:, None, None] * AROUND
        misfits = chi2_of_pairs(table, neighbours.reshape(-1, 2), order)
        misfits = misfits.reshape(len(pairs), -1)
        best, least = misfits.argmin(axis=1), misfits.min(axis=1)
        pairs = pairs + size[:, None] * AROUND[best]
        size = np.where(best == 4, 0.4 * size, size)
    return Pairs(pairs, least)
