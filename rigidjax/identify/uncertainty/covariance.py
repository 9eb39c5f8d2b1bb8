"""The uncertainty of a fit: covariance, for white and other errors, undetermined directions."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from rigidjax.identify.model.model import Model
from rigidjax.identify.model.terms import (
    Noise,
    extra_residuals,
    prior_weights,
    weights_of,
    whitened,
    with_jacobian,
    with_rows,
)

# A direction is undetermined if its singular value is below this share of the largest.
BLIND = 1e-8
# Columns of the Jacobian are scaled to length one, unless shorter than this share of the longest.
WEAKEST = 1e-6


class Linearised(eqx.Module):
    """The errors of a model at one point, and their derivatives by its free numbers.

    **Fields:** for each sensor `raw` errors (R, T, k) in its unit, whitened `errors`, and
    `raw_slopes` and `slopes` (R, T, k, m), the derivatives of both by the m numbers of a recording;
    `weights` (R, T) of the loss; `kept` (R, T, k) true if an error has weight and its reading is
    below full scale. `places` (R, m) of a recording's numbers among all n; `pulls` (n,) of these to
    zero by priors, `firm` (n,) one over the deviations of the priors; `extra` (j,) and
    `extra_slopes` (j, n) the residuals beside those of readings, and their derivatives.

    >>> found = rj.identify.fit(rj.datasets.toutatis.model(), starts=1, max_steps=2)
    >>> [slopes.shape for slopes in found.linear.slopes]  # 17 times, 3 components, 8 free numbers
    [(1, 17, 3, 8), (1, 17, 3, 8)]
    """

    raw: tuple[np.ndarray, ...]
    raw_slopes: tuple[np.ndarray, ...]
    errors: tuple[np.ndarray, ...]
    slopes: tuple[np.ndarray, ...]
    weights: tuple[np.ndarray, ...]
    kept: tuple[np.ndarray, ...]
    places: np.ndarray
    pulls: np.ndarray
    firm: np.ndarray
    extra: np.ndarray
    extra_slopes: np.ndarray

    @property
    def size(self) -> int:
        """The number of free numbers."""
        return int(self.extra_slopes.shape[-1])

    def first_times(self, count: int) -> "Linearised":
        """Return the same of the first `count` times, without those that a fit appends."""
        long = ("raw", "raw_slopes", "errors", "slopes", "weights", "kept")
        parts = {name: tuple(a[:, :count] for a in getattr(self, name)) for name in long}
        return dataclasses.replace(self, **parts)

    @property
    def slope(self) -> np.ndarray:
        """The gradient (n,) of the misfit."""
        readings = self.spread(self.scores).sum(axis=0)
        return readings + self.firm * self.pulls + self.extra @ self.extra_slopes

    @property
    def dense(self) -> np.ndarray:
        """All slopes (R, N, m) of each recording, each row weighted."""
        return np.concatenate(self.rows, axis=1)

    @property
    def rows(self) -> list[np.ndarray]:
        """The slopes (R, T k, m) of each sensor, each row weighted."""
        return [
            (slope * np.sqrt(weight)[..., None, None]).reshape(len(slope), -1, slope.shape[-1])
            for slope, weight in zip(self.slopes, self.weights, strict=True)
        ]

    @property
    def information(self) -> tuple[np.ndarray, ...]:
        """The information (R, m, m) in the readings of each sensor on each recording's numbers."""
        return tuple(rows.swapaxes(1, 2) @ rows for rows in self.rows)

    def along(self, step: np.ndarray) -> float:
        """The square of the change of all residuals with a step (n,) of the numbers."""
        moved = np.append(step, 0.0)[self.places]
        readings = np.einsum("rim,rm->ri", self.dense, moved)
        rest = self.firm * step, self.extra_slopes @ step
        return float(sum(np.sum(part**2) for part in (readings, *rest)))

    def spread(self, blocks: np.ndarray) -> np.ndarray:
        """Columns (R, m) of the recordings as columns of all numbers (R, n)."""
        wide = np.zeros((len(blocks), self.size + 1))
        np.add.at(wide, (np.arange(len(blocks))[:, None], self.places), blocks)
        return wide[:, :-1]

    def blocks(self, covariance: np.ndarray) -> np.ndarray:
        """The covariance (R, m, m) of each recording's numbers; zero if it is not finite."""
        known = covariance if np.isfinite(covariance).all() else np.zeros_like(covariance)
        wide = np.pad(known, (0, 1))
        return wide[self.places[:, :, None], self.places[:, None, :]]

    @property
    def scores(self) -> np.ndarray:
        """The part of each recording in the gradient of the misfit, (R, m)."""
        total: Any = sum(
            np.einsum("rtk,rtkm,rt->rm", error, slope, weight)
            for error, slope, weight in zip(self.errors, self.slopes, self.weights, strict=True)
        )
        return total


@eqx.filter_jit
def _linearised(model: Model, x: Array, noise: Noise, blocks: Any) -> Any:
    errors, slopes = blocks
    out, slopes = with_rows(lambda e: whitened(model, e, noise), errors, slopes)
    extra_slopes, extra = with_jacobian(lambda x: extra_residuals(model, x), x)
    weights, prior = weights_of(model, errors, noise), prior_weights(model)
    return (out, slopes, weights), model.index.places, (prior * x, prior, extra, extra_slopes)


def linearise(
    model: Model,
    x: Array,
    noise: Noise,
    blocks: Any,
    thickened: tuple[Array, Any] | None = None,
) -> Linearised:
    """Return errors, derivatives and weights at x as NumPy arrays.

    `blocks` are the errors and derivatives there, as `terms.blocks` gives them. If x is at a flat
    body, derivatives are taken at a point beside it: `thickened` is that point, and its blocks.
    """
    (errors, slopes, weights), where, beside = jax.tree.map(
        np.asarray, _linearised(model, x, noise, blocks)
    )
    raw, raw_slopes = (tuple(map(np.asarray, part)) for part in blocks)
    if thickened is not None:
        thick = linearise(model, thickened[0], noise, thickened[1])
        slopes, beside = thick.slopes, (*beside[:-1], thick.extra_slopes)
    pairs = zip(model.records.readings, weights, strict=True)
    kept = tuple(reading.kept & (weight > 0)[..., None] for reading, weight in pairs)
    return Linearised(raw, raw_slopes, errors, slopes, weights, kept, where, *beside)


class Root(eqx.Module):
    """A root of the covariance of n numbers for white errors, in units of `size` (n,).

    `lift` (n, s): how all numbers follow those that recordings share, of root `core` (s, r); `own`
    the places (k,) and roots (k, j) of the numbers of one recording alone, and the rows (p, k + s)
    of priors of these and of shared ones; `ties` (q, s) those of shared ones; `null` (i, n)
    orthonormal directions that are not determined.
    """

    size: np.ndarray
    lift: np.ndarray
    core: np.ndarray
    own: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]
    ties: np.ndarray
    null: np.ndarray

    def sandwich(self, rows: np.ndarray, where: np.ndarray, middle: np.ndarray) -> np.ndarray:
        """`H⁻¹ M H⁻¹` (n, n), M the sum over recordings of `rowsᵀ middle rows` at `where` (R, m),
        and of the information of priors. `rows` (R, q, m), `middle` (R, q, q).
        """
        wide, lift = (np.concatenate([x, 0 * x[:1]]) for x in (1.0 / self.size, self.lift))
        rows, inverse = rows * wide[where][:, None, :], self.core @ self.core.T
        total = inverse @ self.ties.T @ self.ties @ inverse
        cross, blocks = np.zeros_like(self.lift), []
        for (mine, root, ties), columns, one, m in zip(self.own, where, rows, middle, strict=True):
            count, alone = mine.size, root @ root.T
            read = alone @ one[:, _found(mine, columns)].T, inverse @ (one @ lift[columns]).T
            tied = ties[:, count:] + ties[:, :count] @ lift[mine]
            held = alone @ ties[:, :count].T, inverse @ tied.T
            total = total + read[1] @ m @ read[1].T + held[1] @ held[1].T
            cross[mine] = read[0] @ m @ read[1].T + held[0] @ held[1].T
            blocks.append(read[0] @ m @ read[0].T + held[0] @ held[0].T)
        both = cross @ self.lift.T
        out = self.lift @ total @ self.lift.T + both + both.T
        for (mine, *_), block in zip(self.own, blocks, strict=True):
            out[np.ix_(mine, mine)] += block
        return self._whole(out)

    @property
    def covariance(self) -> np.ndarray:
        """`H⁻¹` (n, n) within the directions that are determined."""
        half = self.lift @ self.core
        out = half @ half.T
        for mine, root, _ in self.own:
            out[np.ix_(mine, mine)] += root @ root.T
        return self._whole(out)

    def _whole(self, inner: np.ndarray) -> np.ndarray:
        """Without the directions that are not determined, in the numbers' own units."""
        if len(self.null):
            inner = inner - self.null.T @ (self.null @ inner)
            inner = inner - (inner @ self.null.T) @ self.null
        return inner / np.outer(self.size, self.size)


def _found(wanted: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The index of each wanted number in a row of columns."""
    order = np.argsort(columns)
    return order[np.searchsorted(columns[order], wanted)]


class Spread(eqx.Module):
    """Covariance of the free numbers, infinite along undetermined directions, `seen` within the
    determined ones, and its method; `singular_values` of the weighted Jacobian with columns of
    length one; `null_directions` (k, n); `root` of the covariance of white errors.
    """

    covariance: np.ndarray
    seen: np.ndarray
    kind: str
    singular_values: np.ndarray
    null_directions: np.ndarray
    root: Root | None


def of_white(linear: Linearised) -> Spread:
    """`(JᵀWJ)⁻¹`; infinite for singular values below 1e-8 of the largest.

    Numbers of one recording alone are eliminated first, each recording's by itself (Schur
    complement); the singular values are those of their blocks and of what is left.
    """
    n, dense = linear.size, linear.dense
    if not (np.isfinite(dense).all() and np.isfinite(linear.extra_slopes).all()):
        lost, kind = np.full((n, n), np.nan), "none: the motion is not finite"
        return Spread(lost, lost, kind, np.full(n, np.nan), np.zeros((0, n)), None)
    triangles, owner = np.linalg.qr(dense, mode="r"), _owners(linear)
    shared = np.flatnonzero(owner < 0)
    # Columns of order one: a bias in rad/s must not look undetermined beside a moment, nor
    # round-off be scaled up.
    squares = np.bincount(linear.places.ravel(), np.sum(triangles**2, axis=1).ravel(), n + 1)[:n]
    size = np.sqrt(squares + linear.firm**2 + np.sum(linear.extra_slopes**2, axis=0))
    size = np.maximum(size, max(WEAKEST * size.max(), 1e-150))
    firm, extra = linear.firm / size, linear.extra_slopes / size
    of = np.where(extra != 0, owner, -1).max(axis=1, initial=-1)
    lift = np.zeros((n, shared.size))
    lift[shared, np.arange(shared.size)] = 1.0
    ties = np.concatenate([np.diag(firm[shared]), extra[of < 0][:, shared]])
    # A recording without numbers of its own, as a window of a long run, has nothing to eliminate.
    bare = ~np.isin(np.arange(len(triangles)), owner)
    none = np.zeros(0, int), np.zeros((0, 0)), np.zeros((0, shared.size))
    rest, own, values, null = (
        [ties, _rows_of_shared(linear, triangles, size, bare, shared)],
        [],
        [],
        [],
    )
    for record, (triangle, columns) in enumerate(zip(triangles, linear.places, strict=True)):
        if bare[record]:
            own.append(none)
            continue
        mine = np.flatnonzero(owner == record)
        wide, held = np.zeros((len(triangle), n + 1)), np.zeros((mine.size, n))
        wide[:, columns], held[np.arange(mine.size), mine] = triangle, firm[mine]
        priors = np.concatenate([extra[of == record], held])
        rows = np.concatenate([wide[:, :-1] / size, priors])
        range_, root, blind, singular = _parts(rows[:, mine])
        taken = range_.T @ rows[:, shared]
        lift[mine] = -root @ taken
        rest.append(np.linalg.qr(rows[:, shared] - range_ @ taken, mode="r"))
        own.append((mine, root, np.concatenate([priors[:, mine], priors[:, shared]], axis=1)))
        values.append(singular)
        null.append(np.zeros((len(blind), n)))
        null[-1][:, mine] = blind
    _, core, blind, singular = _parts(np.concatenate(rest))
    null.append(blind @ lift.T)
    root = Root(size, lift, core, tuple(own), ties, np.linalg.qr(np.concatenate(null).T)[0].T)
    directions = root.null / size
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    covariance = root.covariance
    return Spread(
        blinded(covariance, directions),
        covariance,
        "Gauss–Newton",
        np.concatenate([singular, *values]),
        directions,
        root,
    )


def _rows_of_shared(
    linear: Linearised,
    triangles: np.ndarray,
    size: np.ndarray,
    some: np.ndarray,
    shared: np.ndarray,
) -> np.ndarray:
    """Return the triangular factor (q, s) of the rows of several recordings.

    The recordings, `some` (R,), change with the s numbers `shared` alone. `triangles` (R, q, m) are
    the factors of their weighted derivatives; columns are in units of `size` (n,).
    """
    wide = np.zeros((int(some.sum()), triangles.shape[1], linear.size + 1))
    columns = np.broadcast_to(linear.places[some][:, None, :], triangles[some].shape)
    np.put_along_axis(wide, columns, triangles[some], axis=2)
    rows = (wide[..., :-1] / size).reshape(-1, linear.size)
    return np.linalg.qr(rows[:, shared], mode="r")


def _owners(linear: Linearised) -> np.ndarray:
    """The recording (n,) that alone changes with a number, −1 if several do or a row ties them."""
    records, n = len(linear.places), linear.size
    owner, seen = np.full(n + 1, -1), np.zeros((records, n + 1), bool)
    seen[np.arange(records)[:, None], linear.places] = True
    alone = seen.sum(axis=0) == 1
    owner[alone] = seen.argmax(axis=0)[alone]
    for row in linear.extra_slopes != 0:
        tied = np.flatnonzero(row)
        if np.unique(owner[tied][owner[tied] >= 0]).size > 1:
            owner[tied] = -1
    return owner[:-1]


def _parts(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of rows (q, k) in columns of order one: their range, a root (k, r) of the inverse of their
    Gram matrix, the directions (j, k) that they do not show, their singular values.
    """
    u, singular, directions = np.linalg.svd(rows, full_matrices=False)
    seen = singular > BLIND * singular.max(initial=1.0)
    return u[:, seen], directions[seen].T / singular[seen], directions[~seen], singular


def spread(linear: Linearised, times: "Times", white: Spread | None = None) -> Spread:
    """`(JᵀWJ)⁻¹` for white errors, else the sandwich `H⁻¹ M H⁻¹`.

    `M = Jᵀ C J` and the information of priors, C the errors' covariance in time: of each channel
    what second differences show is white, the rest decays. Fitted errors do not show the decay time
    well, so that each number gets the largest variance over all times from two samples to half a
    record; they are too small, so that `Jᵀ C J` is multiplied by n/(n − p) for n independent
    errors. The variance between many recordings counts if it is larger. Source: White 1980,
    doi:10.2307/1912934; Liang and Zeger 1986, doi:10.1093/biomet/73.1.13.
    """
    white = of_white(linear) if white is None else white
    if times.longest <= 1.5 or not np.isfinite(white.seen).all():
        return white
    covariance = _sandwich(linear, white, times)
    kind = f"sandwich: the errors are autocorrelated over {times.longest:.0f} samples"
    shown = blinded(covariance, white.null_directions)
    return dataclasses.replace(white, covariance=shown, seen=covariance, kind=kind)


def blinded(covariance: np.ndarray, null: np.ndarray) -> np.ndarray:
    """The covariance, infinite for a number that depends on an undetermined direction."""
    shown = covariance.copy()
    blind = np.abs(null).max(axis=0, initial=0.0) > 1e-6
    shown[blind, blind] = np.inf
    return shown


def inverted(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A root (n, m) of the covariance in determined directions; the others are `null` (k, n)."""
    size = np.sqrt(np.diag(information))
    size = np.maximum(size, max(WEAKEST * size.max(), 1e-150))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    seen = values > 1e-14 * values.max()
    half = vectors[:, seen] / np.sqrt(values[seen]) / size[:, None]
    null = vectors[:, ~seen].T / size
    return half, null / np.linalg.norm(null, axis=1, keepdims=True)


def distance(linear: Linearised, white: Spread, held: Sequence[np.ndarray] = ()) -> float:
    """The distance to the least misfit in standard deviations, √(gᵀ(JᵀWJ)⁻¹g), as MINUIT's (James
    and Roos 1975, doi:10.1016/0010-4655(75)90039-9); derivatives `held` (n,) stay fixed.
    """
    covariance = white.seen
    for row in held:
        across = covariance @ row
        covariance = covariance - np.outer(across, across) / max(row @ across, 1e-300)
    return float(np.sqrt(max(linear.slope @ covariance @ linear.slope, 0.0)))


def _sandwich(linear: Linearised, white: Spread, times: "Times") -> np.ndarray:
    """White's covariance of errors that are not independent.

    Products of derivatives are taken in orthonormal columns: otherwise round-off could make
    variances negative.
    """
    columns, triangles = np.linalg.qr(linear.dense)
    longest = max(int(np.median((linear.weights[0] > 0).sum(axis=1))) // 2, 2)
    spans = 2.0 ** np.arange(1, np.log2(longest) + 1)
    n, records = linear.size, len(linear.places)
    grown = times.independent / max(times.independent - n, 0.1 * times.independent)
    channels, root = _spectra(linear, columns), white.root
    assert root is not None
    meats = [grown * _meat(*channels, span) for span in spans]
    found = [root.sandwich(triangles, linear.places, meat) for meat in meats]
    if records > n // 2 and records > 5:
        # Many recordings: the variance between them needs no model of their errors.
        between = np.full((records, 1, 1), records / (records - 1))
        found.append(root.sandwich(linear.scores[:, None], linear.places, between))
    # Never narrower than for white errors.
    all_ = np.stack([np.diag(white.seen), *(np.diag(c) for c in found)])
    least = np.maximum(all_[0], 1e-300)
    out = found[int(np.argmax((all_[1:] / least).mean(axis=1)))]
    own = np.maximum(np.diag(out), 1e-300)
    factor = np.sqrt(np.maximum(all_.max(axis=0) / own, 1.0))
    return out * np.outer(factor, factor)


def _spectra(linear: Linearised, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the `columns` of the k channels of all sensors, times the deviation of their errors, real
    and imaginary parts (R, k, 2, T + 1, m) by frequency; the smooth share (k, 1, 1) of the errors.
    """
    first, slopes, shares = 0, [], []
    for error, weight in zip(linear.errors, linear.weights, strict=True):
        root, last = np.sqrt(weight), first + error[0].size
        slope = columns[:, first:last].reshape(*error.shape, -1)
        first = last
        for channel in range(error.shape[-1]):
            e = error[..., channel] * root
            variance = np.sum(e**2) / max(np.sum(weight > 0), 1)
            slopes.append(np.sqrt(variance) * slope[..., channel, :])
            shares.append(smooth_share(e, weight > 0))
    # Twice as long: then products in frequency are those of covariances in time.
    size = 2 * slopes[0].shape[1]
    found = np.fft.rfft(np.stack(slopes, axis=1), size, axis=2)
    each = np.full(size // 2 + 1, 2.0 / size)
    each[[0, -1]] = 1.0 / size
    parts = np.stack([found.real, found.imag], axis=2) * np.sqrt(each)[:, None]
    return parts, np.array(shares)[:, None, None]


def _meat(spectra: np.ndarray, share: np.ndarray, time: float) -> np.ndarray:
    """`Jᵀ C J` with C the scatter of each channel and a part that decays over `time` samples."""
    size = 2 * spectra.shape[3] - 2
    lags = np.arange(size)
    decay = np.exp(-np.minimum(lags, size - lags) / time)
    power = share * np.fft.rfft(decay).real[:, None] + (1.0 - share)
    weighed = spectra * power[:, None]
    flat = (*spectra.shape[:2], -1, spectra.shape[-1])
    return np.sum(weighed.reshape(flat).swapaxes(2, 3) @ spectra.reshape(flat), axis=1)


def smooth_share(e: np.ndarray, seen: np.ndarray) -> float:
    """The share of the variance of errors (R, T) that second differences do not show."""
    rows = [x[kept] for x, kept in zip(e, seen, strict=True)]
    total = sum(float(row @ row) for row in rows) / max(sum(row.size for row in rows), 1)
    return float(np.clip(1.0 - scatter(rows) / total, 0.0, 1.0)) if total > 0 else 1.0


def scatter(rows: list[np.ndarray]) -> float:
    """The variance of rows by their second differences, as if they were white."""
    bends = np.concatenate([row[2:] - 2.0 * row[1:-1] + row[:-2] for row in rows])
    # The second difference of white noise has six times the variance of the noise.
    return float(np.mean(bends**2)) / 6.0 if bends.size else 0.0


class Times(eqx.Module):
    """The samples over which errors are autocorrelated (1: white), a tuple for each sensor;
    `closeness` the correlation of neighbours in the worst channel; `independent` errors in all.
    """

    spans: tuple[tuple[float, ...], ...]
    closeness: float
    independent: float

    @property
    def longest(self) -> float:
        """The longest of all channels."""
        return max(span for sensor in self.spans for span in sensor)


def correlation_times(linear: Linearised) -> Times:
    """The autocorrelation time `1 + 2 Σ ρ_l` of each channel, up to the first ρ below twice its
    scatter; readings at full scale take no part.
    """
    spans, longest, closest, independent = [], 1.0, 0.0, 0.0
    for error, weight, kept in zip(linear.errors, linear.weights, linear.kept, strict=True):
        weighted, found = error * np.sqrt(weight)[..., None], []
        for channel in range(error.shape[-1]):
            seen = kept[..., channel]
            span, first = _channel_time(weighted[..., channel], seen)
            if span > longest:
                longest, closest = span, first
            found.append(span)
            independent += float(np.sum(seen)) / span
        spans.append(tuple(found))
    return Times(tuple(spans), closest, independent)


def _channel_time(e: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    counts = seen.sum(axis=1, keepdims=True)
    mean = e.sum(axis=1, keepdims=True) / np.maximum(counts, 1)
    centred = np.where(seen, e - mean, 0.0)
    variance = np.sum(centred**2)
    if not variance > 0:
        return 1.0, 0.0
    lags = np.arange(1, max(2, int(np.max(np.nonzero(seen)[1], initial=0) + 1) // 3))
    # Each lag has fewer pairs than lag zero.
    pairs, products = np.round(_lagged(seen)[lags]), _lagged(centred)[lags]
    rho = products / variance * (counts.sum() / np.maximum(pairs, 1))
    ends = (pairs < 10) | (rho < 2.0 / np.sqrt(max(counts.sum(), 1)))
    last = int(np.argmax(ends)) if ends.any() else lags.size
    first = rho[0] if lags.size and pairs[0] >= 10 else 0.0
    return 1.0 + 2.0 * float(rho[:last].sum()), float(first)


def _lagged(x: np.ndarray) -> np.ndarray:
    """The sums of products of rows (R, T) with themselves `lag` samples later, by FFT."""
    size = x.shape[1]
    return np.fft.irfft(np.sum(np.abs(np.fft.rfft(x, 2 * size)) ** 2, axis=0), 2 * size)[:size]
