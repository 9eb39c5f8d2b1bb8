"""Compute the covariance of a fit, for white and for autocorrelated errors."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from rigidjax.identify.model.first_order import value_and_jacfwd
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.terms import (
    Blocks,
    Noise,
    joint_residuals,
    prior_weights,
    reading_weights,
    residual_jacobians,
    whiten,
)

# A direction of the parameters is undetermined if its singular value is below this fraction of
# the largest singular value.
BLIND = 1e-8
# Columns of the Jacobian are scaled to length one, except columns shorter than this fraction of the
# longest column, which may be round-off.
WEAKEST = 1e-6


class Linearisation(eqx.Module):
    """Hold the residuals of a model at one point, and their derivatives with respect to the n
    parameters.

    There are R recordings, T times, k components of a residual, and m parameters of a recording.
    The first six fields hold one array for each sensor.

    **Fields:**

    - `raw`: (R, T, k) reading minus prediction in the unit of the sensor.
    - `raw_slopes`: (R, T, k, m) the derivatives of `raw` with respect to the m parameters of each
      recording.
    - `errors`: (R, T, k) the residuals in standard deviations of the noise (`terms.whiten`).
    - `slopes`: (R, T, k, m) the derivatives of `errors`.
    - `weights`: (R, T) the weights of the robust loss.
    - `mask`: (R, T, k) true if a residual has a weight and its reading is below full scale.
    - `places`: (R, m) the indices of the parameters of each recording among all n.
    - `prior_residuals`: (n,) the parameters divided by the standard deviations of their priors.
    - `prior_weights`: (n,) one over the standard deviations of the priors, zero without a prior.
    - `extra`: (j,) all further residuals, such as those of a prior of the body.
    - `extra_slopes`: (j, n) the derivatives of `extra` with respect to the n parameters.

    >>> result = rj.identify.fit(rj.datasets.toutatis.model(), starts=1, max_steps=2)
    >>> [slopes.shape for slopes in result.linear.slopes]  # 17 times, 3 components, 8 parameters
    [(1, 17, 3, 8), (1, 17, 3, 8)]
    """

    raw: tuple[np.ndarray, ...]
    raw_slopes: tuple[np.ndarray, ...]
    errors: tuple[np.ndarray, ...]
    slopes: tuple[np.ndarray, ...]
    weights: tuple[np.ndarray, ...]
    mask: tuple[np.ndarray, ...]
    places: np.ndarray
    prior_residuals: np.ndarray
    prior_weights: np.ndarray
    extra: np.ndarray
    extra_slopes: np.ndarray

    @property
    def free_count(self) -> int:
        """Return the number n of parameters."""
        return int(self.extra_slopes.shape[-1])

    def first_times(self, count: int) -> "Linearisation":
        """Return the residuals and derivatives at the first `count` times, without or with more of
        the masked readings with which a fit pads recordings.
        """
        long = ("raw", "raw_slopes", "errors", "slopes", "weights", "mask")

        def first(a: np.ndarray) -> np.ndarray:
            more = max(count - a.shape[1], 0)
            return np.pad(a[:, :count], [(0, more if i == 1 else 0) for i in range(a.ndim)])

        parts = {name: tuple(map(first, getattr(self, name))) for name in long}
        return dataclasses.replace(self, **parts)

    @property
    def misfit_gradient(self) -> np.ndarray:
        """Return the gradient (n,) of the cost: half the sum of squared residuals, those of priors
        included. Under a robust loss, the loss takes the place of half the squares of readings.
        """
        places, parts = self.places.ravel(), self.misfit_gradients_by_recording.ravel()
        readings = np.bincount(places, parts, self.free_count + 1)[:-1]
        priors = self.prior_weights * self.prior_residuals
        return readings + priors + self.extra @ self.extra_slopes

    @property
    def weighted_jacobian(self) -> np.ndarray:
        """Return the derivatives (R, N, m) of the N residuals of each recording, times the square
        roots of their weights.
        """
        return np.concatenate(self.weighted_jacobians_by_sensor, axis=1)

    @property
    def weighted_jacobians_by_sensor(self) -> list[np.ndarray]:
        """Return the `weighted_jacobian` of each sensor by itself, (R, T k, m)."""
        return [
            (slope * np.sqrt(weight)[..., None, None]).reshape(len(slope), -1, slope.shape[-1])
            for slope, weight in zip(self.slopes, self.weights, strict=True)
        ]

    @property
    def weighted_residuals(self) -> np.ndarray:
        """Return the residuals (R, N) of each recording, times the square roots of their
        weights.
        """
        pairs = zip(self.errors, self.weights, strict=True)
        parts = [(error * np.sqrt(weight)[..., None]) for error, weight in pairs]
        return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)

    def squared_residual_change(self, step: np.ndarray) -> float:
        """Return the sum of the squared changes of all residuals, those of priors included, by a
        `step` (n,) along which they are taken as linear.
        """
        moved = np.append(step, 0.0)[self.places]
        readings = np.einsum("rim,rm->ri", self.weighted_jacobian, moved)
        rest = self.prior_weights * step, self.extra_slopes @ step
        return float(sum(np.sum(part**2) for part in (readings, *rest)))

    def covariance_by_recording(self, covariance: np.ndarray) -> np.ndarray:
        """Return the parts (R, m, m) of a `covariance` (n, n) for the parameters of each recording,
        or zero if it is not finite.
        """
        known = covariance if np.isfinite(covariance).all() else np.zeros_like(covariance)
        wide = np.pad(known, (0, 1))
        return wide[self.places[:, :, None], self.places[:, None, :]]

    @property
    def misfit_gradients_by_recording(self) -> np.ndarray:
        """Return the gradient (R, m) of the cost of each recording's own residuals."""
        total: Any = 0.0
        for error, slope, weight in zip(self.errors, self.slopes, self.weights, strict=True):
            pulls = (error * weight[..., None]).reshape(len(error), 1, -1)
            total = total + (pulls @ slope.reshape(len(slope), -1, slope.shape[-1]))[:, 0]
        return total


@eqx.filter_jit
def _linearised_fields(model: Model, x: Array, noise: Noise, blocks: Blocks) -> dict[str, Any]:
    """Compute those fields of a `Linearisation`, by name, that take one compiled program."""
    errors, slopes = blocks
    out, slopes = residual_jacobians(lambda e: whiten(model, e, noise), errors, slopes)
    extra, extra_slopes = value_and_jacfwd(lambda x: joint_residuals(model, x), x)
    prior = prior_weights(model)
    return {
        "errors": out,
        "slopes": slopes,
        "weights": reading_weights(model, errors, noise),
        "places": model.index.places,
        "prior_residuals": prior * x,
        "prior_weights": prior,
        "extra": extra,
        "extra_slopes": extra_slopes,
    }


def linearise(
    model: Model,
    x: Array,
    noise: Noise,
    blocks: Blocks,
    thickened: tuple[Array, Blocks] | None = None,
) -> Linearisation:
    """Return the residuals of a model at the parameters x, with their derivatives and weights.

    The `blocks` are those of x. If a body is flat (I1 + I2 = I3) at x, `thickened` holds the
    parameters of a slightly thicker body and the blocks there: the derivatives are taken there.
    """
    parts = jax.tree.map(np.asarray, _linearised_fields(model, x, noise, blocks))
    raw, raw_slopes = (tuple(map(np.asarray, part)) for part in blocks)
    if thickened is not None:
        thick = linearise(model, thickened[0], noise, thickened[1])
        parts |= {"slopes": thick.slopes, "extra_slopes": thick.extra_slopes}
    pairs = zip(model.records.readings, parts["weights"], strict=True)
    mask = tuple(reading.usable & (weight > 0)[..., None] for reading, weight in pairs)
    return Linearisation(raw=raw, raw_slopes=raw_slopes, mask=mask, **parts)


def residuals_by_name(model: Model, linear: Linearisation) -> list[tuple[str, float]]:
    """Return the name and the residual, in standard deviations, of each number of each `Measured`
    of a `model`.
    """
    names = [
        f"{one.name} {place}" if one.value.ndim else one.name
        for one in model.measured
        for place in range(one.value.size)
    ]
    return list(zip(names, linear.extra[len(linear.extra) - len(names) :].tolist(), strict=True))


class _Own(NamedTuple):
    """Hold the part of a `Root` for the own parameters of one recording."""

    places: Int[np.ndarray, " k"]  # among all n parameters
    root: Float[np.ndarray, "k j"]  # of the covariance for known shared parameters
    priors: Float[np.ndarray, "p k+s"]  # derivatives of residuals of priors: own, then shared


class Root(eqx.Module):
    """Hold a root of the covariance of n parameters for white errors, recording by recording.

    A root of a matrix A is a matrix B with B Bᵀ = A. An own parameter of a recording is one on
    which no other recording depends. All others, s in number, are called shared.
    """

    # Parameters are multiplied by their `size` here, so that derivatives are of order one.
    size: Float[np.ndarray, " n"]
    # How all parameters change with the shared ones, if own parameters take the least cost.
    lift: Float[np.ndarray, "n s"]
    core: Float[np.ndarray, "s r"]  # a root of the covariance of the shared parameters
    shared: Int[np.ndarray, " s"]  # the places of the shared parameters among all
    # For each recording the derivatives with respect to the shared parameters that are left after
    # the elimination of its own parameters; the last column holds the residuals.
    left: tuple[Float[np.ndarray, "_ s+1"], ...]
    own: tuple[_Own, ...]
    # Of the residuals of priors of shared parameters, as in `left`.
    ties: Float[np.ndarray, "q s+1"]
    null: Float[np.ndarray, "i n"]  # orthonormal directions that the data do not determine

    def sandwich_covariance(
        self,
        rows: Float[np.ndarray, "records q m"],
        places: Int[np.ndarray, "records m"],
        middle: Float[np.ndarray, "records q q"],
    ) -> Float[np.ndarray, "n n"]:
        """Return the sandwich covariance `H⁻¹ M H⁻¹`, where H⁻¹ is the covariance for white errors,
        and M the information of the priors plus the sum, over recordings, of `rowsᵀ middle rows`.
        """
        wide, lift = (np.concatenate([x, 0 * x[:1]]) for x in (1.0 / self.size, self.lift))
        rows, inverse = rows * wide[places][:, None, :], self.core @ self.core.T
        held = self.ties[:, :-1] @ inverse
        total = held.T @ held
        cross, blocks = np.zeros_like(self.lift), []
        for (mine, root, ties), columns, one, m in zip(self.own, places, rows, middle, strict=True):
            count, alone, order = mine.size, root @ root.T, np.argsort(columns)
            found = order[np.searchsorted(columns[order], mine)]
            read = alone @ one[:, found].T, inverse @ (one @ lift[columns]).T
            tied = ties[:, count:] + ties[:, :count] @ lift[mine]
            held = alone @ ties[:, :count].T, inverse @ tied.T
            total = total + read[1] @ m @ read[1].T + held[1] @ held[1].T
            cross[mine] = read[0] @ m @ read[1].T + held[0] @ held[1].T
            blocks.append(read[0] @ m @ read[0].T + held[0] @ held[0].T)
        both = cross @ self.lift.T
        out = self.lift @ total @ self.lift.T + both + both.T
        for (mine, *_), block in zip(self.own, blocks, strict=True):
            out[np.ix_(mine, mine)] += block
        return self._unscaled(out)

    @property
    def covariance(self) -> np.ndarray:
        """Return the covariance (n, n) for white errors within the determined directions."""
        half = self.lift @ self.core
        out = half @ half.T
        for mine, root, _ in self.own:
            out[np.ix_(mine, mine)] += root @ root.T
        return self._unscaled(out)

    def _unscaled(self, covariance: np.ndarray) -> np.ndarray:
        """Return a scaled `covariance` in the parameters' own units, without null directions."""
        if len(self.null):
            covariance = covariance - self.null.T @ (self.null @ covariance)
            covariance = covariance - (covariance @ self.null.T) @ self.null
        return covariance / np.outer(self.size, self.size)


class Covariance(eqx.Module):
    """Hold a covariance of the n parameters, and the directions that the data do not determine."""

    # An infinite variance stands for a parameter that the data do not determine.
    covariance: Float[np.ndarray, "n n"]
    determined: Float[np.ndarray, "n n"]  # within the directions that the data determine
    kind: str  # the method, in words
    null_directions: Float[np.ndarray, "k n"]
    # The covariance for white errors; `None` if the motion is not finite, with NaN covariances.
    root: Root | None


def white_covariance(linear: Linearisation) -> Covariance:
    """Return the covariance for white errors, `(JᵀWJ)⁻¹`.

    The parameters of one recording alone are eliminated first, recording by recording (Schur
    complement), and ranks are decided block by block: a direction is not determined if its singular
    value is below 1e-8 of the largest one of its block. The elimination is by QR, since JᵀWJ, which
    a search eliminates by Cholesky (`model.normal`), squares the condition.
    """
    n, dense = linear.free_count, linear.weighted_jacobian
    if not (np.isfinite(dense).all() and np.isfinite(linear.extra_slopes).all()):
        lost, kind = np.full((n, n), np.nan), "none: the motion is not finite"
        return Covariance(lost, lost, kind, np.zeros((0, n)), None)
    # The residuals are a last column, number n + 1, so that each elimination applies to them, too.
    # Column n is that of places that stand for no parameter.
    owner = owners(linear)
    triangles = np.linalg.qr(np.dstack([dense, linear.weighted_residuals]), mode="r")
    places = np.pad(linear.places, ((0, 0), (0, 1)), constant_values=n + 1)
    shared = np.flatnonzero(owner < 0)
    late = np.append(shared, n + 1)
    # Divide the columns of the Jacobian by their lengths (`size`), so that a bias in rad/s does not
    # look undetermined next to a moment of inertia. The lower bound of `size` keeps columns of mere
    # round-off from being scaled up.
    squares = np.bincount(places.ravel(), np.sum(triangles**2, axis=1).ravel(), n + 2)[:n]
    size = np.sqrt(squares + linear.prior_weights**2 + np.sum(linear.extra_slopes**2, axis=0))
    size = np.maximum(size, max(WEAKEST * size.max(), 1e-150))
    unit = np.append(size, [1.0, 1.0])
    extra = np.zeros((len(linear.extra), n + 2))
    extra[:, :n], extra[:, -1] = linear.extra_slopes / size, linear.extra

    def prior_rows(places: np.ndarray) -> np.ndarray:
        rows = np.zeros((places.size, n + 2))
        rows[np.arange(places.size), places] = (linear.prior_weights / size)[places]
        rows[:, -1] = linear.prior_residuals[places]
        return rows

    of = np.where(extra[:, :n] != 0, owner, -1).max(axis=1, initial=-1)
    lift = np.zeros((n, shared.size))
    lift[shared, np.arange(shared.size)] = 1.0
    ties = np.concatenate([prior_rows(shared), extra[of < 0]])[:, late]
    # Take all recordings without own parameters together, such as windows with known starts: they
    # have nothing to eliminate, and a loop over a thousand such recordings took most of the time.
    all_shared = ~np.isin(np.arange(len(triangles)), owner)
    no_own = _Own(np.zeros(0, int), np.zeros((0, 0)), np.zeros((0, shared.size)))
    wide = np.zeros((int(all_shared.sum()), triangles.shape[1], n + 2))
    columns = np.broadcast_to(places[all_shared][:, None, :], triangles[all_shared].shape)
    np.put_along_axis(wide, columns, triangles[all_shared], axis=2)
    of_all = iter(wide[..., late] / unit[late])
    left, own, null = [], [], []
    for record, (triangle, columns) in enumerate(zip(triangles, places, strict=True)):
        if all_shared[record]:
            left.append(next(of_all))
            own.append(no_own)
            continue
        mine = np.flatnonzero(owner == record)
        wide = np.zeros((len(triangle), n + 2))
        wide[:, columns] = triangle
        priors = np.concatenate([extra[of == record], prior_rows(mine)])
        rows = np.concatenate([wide / unit, priors])
        range_, root, blind = _range_and_null(rows[:, mine])
        taken = range_.T @ rows[:, late]
        lift[mine] = -root @ taken[:, :-1]
        left.append(np.linalg.qr(rows[:, late] - range_ @ taken, mode="r"))
        own.append(_Own(mine, root, np.concatenate([priors[:, mine], priors[:, shared]], axis=1)))
        null.append(np.zeros((len(blind), n)))
        null[-1][:, mine] = blind
    rows = np.concatenate([ties, *left])[:, :-1]
    _, core, blind = _range_and_null(np.linalg.qr(rows, mode="r"))
    null.append(blind @ lift.T)
    null = np.linalg.qr(np.concatenate(null).T)[0].T
    root = Root(size, lift, core, shared, tuple(left), tuple(own), ties, null)
    directions = root.null / size
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    covariance = root.covariance
    return Covariance(
        with_infinite_variance(directions, covariance),
        covariance,
        "Gauss–Newton",
        directions,
        root,
    )


def owners(linear: Linearisation) -> Int[np.ndarray, " n"]:
    """Return for each parameter the only recording that depends on it, −1 for none or several."""
    records, n = len(linear.places), linear.free_count
    owner, used = np.full(n + 1, -1), np.zeros((records, n + 1), bool)
    used[np.arange(records)[:, None], linear.places] = True
    alone = used.sum(axis=0) == 1
    owner[alone] = used.argmax(axis=0)[alone]
    return owner[:-1]


class _RangeAndNull(NamedTuple):
    range: Float[np.ndarray, "q r"]  # an orthonormal basis
    root: Float[np.ndarray, "k r"]  # of the inverse of `rowsᵀ rows`, within determined directions
    null: Float[np.ndarray, "j k"]


def _range_and_null(rows: Float[np.ndarray, "q k"]) -> _RangeAndNull:
    """Return range and null space of a matrix whose columns are of order one."""
    u, singular, directions = np.linalg.svd(rows, full_matrices=False)
    determined = singular > BLIND * singular.max(initial=1.0)
    root = directions[determined].T / singular[determined]
    return _RangeAndNull(u[:, determined], root, directions[~determined])


def robust_covariance(
    linear: Linearisation, times: "CorrelationTimes", white: Covariance | None = None
) -> Covariance:
    """Return the covariance `white` for white errors, or the sandwich `H⁻¹ M H⁻¹` if the errors are
    autocorrelated.

    The matrix M is `Jᵀ C J` plus the information of the priors, where C is the covariance of the
    errors in time. In each channel the second differences of the errors give the variance of a
    white part. The rest of the variance belongs to a part whose autocorrelation decays
    exponentially; its decay time cannot be found well from the errors of a fit, so that each
    parameter gets the largest variance over decay times from two samples to half a record. The
    errors of a fit are smaller than the true ones: `Jᵀ C J` is multiplied by n/(n − p) for n
    independent errors and p parameters. If there are many recordings, the scatter between them
    gives a second estimate, and the larger one is used. Source: White 1980, doi:10.2307/1912934;
    Liang and Zeger 1986, doi:10.1093/biomet/73.1.13.
    """
    white = white_covariance(linear) if white is None else white
    if times.longest_span <= 1.5 or not np.isfinite(white.determined).all():
        return white
    covariance = _sandwich(linear, white, times)
    kind = f"sandwich: the errors are autocorrelated over {times.longest_span:.0f} samples"
    shown = with_infinite_variance(white.null_directions, covariance)
    return dataclasses.replace(white, covariance=shown, determined=covariance, kind=kind)


def with_infinite_variance(null: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the `covariance` with an infinite variance for each parameter that changes along a
    direction of `null` (k, n).
    """
    shown = covariance.copy()
    blind = np.abs(null).max(axis=0, initial=0.0) > 1e-6
    shown[blind, blind] = np.inf
    return shown


class InverseRoot(NamedTuple):
    root: Float[np.ndarray, "n m"]  # B, where B Bᵀ is the inverse within all other directions
    null: Float[np.ndarray, "k n"]  # the directions that the information does not determine


def covariance_root(rows: Float[np.ndarray, "q n"]) -> InverseRoot:
    """Return a root of the inverse of the information matrix `rowsᵀ rows`; q is at least n."""
    size = np.linalg.norm(rows, axis=0)
    size = np.maximum(size, max(WEAKEST * size.max(initial=0.0), 1e-150))
    found = _range_and_null(rows / size)
    null = found.null / size
    return InverseRoot(
        found.root / size[:, None], null / np.linalg.norm(null, axis=1, keepdims=True)
    )


def distance_to_minimum(
    linear: Linearisation, white: Covariance, directions: Sequence[np.ndarray] = ()
) -> float:
    """Return the distance from a point to the minimum of the cost in standard deviations,
    `√(gᵀ(JᵀWJ)⁻¹g)` with the gradient g.

    MINUIT ends a search by it (James and Roos 1975, doi:10.1016/0010-4655(75)90039-9). Each entry
    of `directions` is the derivative (n,) of a function that keeps its value on the way, such as
    the flatness of a body.
    """
    covariance = white.determined
    for row in directions:
        across = covariance @ row
        covariance = covariance - np.outer(across, across) / max(row @ across, 1e-300)
    return float(np.sqrt(max(linear.misfit_gradient @ covariance @ linear.misfit_gradient, 0.0)))


def _sandwich(
    linear: Linearisation, white: Covariance, times: "CorrelationTimes"
) -> Float[np.ndarray, "n n"]:
    """Return the sandwich covariance of `robust_covariance`: the largest of several estimates.

    The derivatives are written in orthonormal columns (QR) first, since round-off in products of
    the derivatives themselves could make variances negative.
    """
    columns, triangles = np.linalg.qr(linear.weighted_jacobian)
    longest = max(int(np.median((linear.weights[0] > 0).sum(axis=1))) // 2, 2)
    spans = 2.0 ** np.arange(1, np.log2(longest) + 1)
    n, records = linear.free_count, len(linear.places)
    grown = times.independent / max(times.independent - n, 0.1 * times.independent)
    (spectra, shares), root, estimates = _spectra(linear, columns), white.root, []
    assert root is not None
    size = 2 * spectra.shape[3] - 2
    lags, flat = np.arange(size), (*spectra.shape[:2], -1, spectra.shape[-1])
    for span in spans:
        # `Jᵀ C J`, where the smooth part of the variance decays over `span` samples.
        decay = np.exp(-np.minimum(lags, size - lags) / span)
        power = shares * np.fft.rfft(decay).real[:, None] + (1.0 - shares)
        weighed = (spectra * power[:, None]).reshape(flat).swapaxes(2, 3)
        meat = grown * np.sum(weighed @ spectra.reshape(flat), axis=1)
        estimates.append(root.sandwich_covariance(triangles, linear.places, meat))
    if records > n // 2 and records > 5:
        # The scatter of the gradients of the cost between many recordings gives the variance
        # without a model of how the errors are correlated. The factor R/(R − 1), for R recordings,
        # is the usual one for a variance estimated from R samples.
        between = np.full((records, 1, 1), records / (records - 1))
        estimates.append(
            root.sandwich_covariance(
                linear.misfit_gradients_by_recording[:, None], linear.places, between
            )
        )
    # Take the estimate whose variances are largest on average, relative to those for white errors.
    # Scale it up for each parameter that has a larger variance in another estimate; the covariance
    # for white errors counts as an estimate, too.
    all_ = np.stack([np.diag(white.determined), *(np.diag(c) for c in estimates)])
    least = np.maximum(all_[0], 1e-300)
    out = estimates[int(np.argmax((all_[1:] / least).mean(axis=1)))]
    own = np.maximum(np.diag(out), 1e-300)
    factor = np.sqrt(np.maximum(all_.max(axis=0) / own, 1.0))
    return out * np.outer(factor, factor)


class _Spectra(NamedTuple):
    # Fourier transforms in time, times the deviation of the channel: real and imaginary parts.
    parts: Float[np.ndarray, "records channels 2 T+1 m"]
    shares: Float[np.ndarray, "channels 1 1"]  # of the variance of a channel that is not white


def _spectra(linear: Linearisation, columns: Float[np.ndarray, "records rows m"]) -> _Spectra:
    """Return the spectra of orthonormal `columns` that span the derivatives of the residuals.

    A channel is one component of one sensor.
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
            rows = [x[kept] for x, kept in zip(e, weight > 0, strict=True)]
            total = sum(float(row @ row) for row in rows) / max(sum(row.size for row in rows), 1)
            white = white_noise_variance(rows) / total if total > 0 else 0.0
            shares.append(float(np.clip(1.0 - white, 0.0, 1.0)))
    # The columns are padded with zeros to twice the length, since a convolution by FFT would
    # otherwise wrap around.
    size = 2 * slopes[0].shape[1]
    spectra = np.fft.rfft(np.stack(slopes, axis=1), size, axis=2)
    each = np.full(size // 2 + 1, 2.0 / size)
    each[[0, -1]] = 1.0 / size
    parts = np.stack([spectra.real, spectra.imag], axis=2) * np.sqrt(each)[:, None]
    return _Spectra(parts, np.array(shares)[:, None, None])


def white_noise_variance(samples: list[np.ndarray]) -> float:
    """Return the variance of the white noise in arrays of successive `samples`, from their second
    differences, which a smooth signal hardly changes; 0 if no array has three samples.
    """
    bends = np.concatenate([row[2:] - 2.0 * row[1:-1] + row[:-2] for row in samples])
    # The second difference of white noise has six times the variance of the noise.
    return float(np.mean(bends**2)) / 6.0 if bends.size else 0.0


class CorrelationTimes(eqx.Module):
    """Hold the autocorrelation of the errors of a fit, for each channel of each sensor."""

    spans: tuple[tuple[float, ...], ...]  # in samples; 1 for white errors
    closeness: float  # the correlation of neighbours in the channel with the largest span, or 0
    independent: float  # the number of independent errors of all channels together

    @property
    def longest_span(self) -> float:
        return max(span for sensor in self.spans for span in sensor)


def correlation_times(linear: Linearisation) -> CorrelationTimes:
    """Return the number of samples over which the errors of each channel are correlated.

    Readings at full scale are left out.
    """
    spans, longest, closest, independent = [], 1.0, 0.0, 0.0
    for error, weight, kept in zip(linear.errors, linear.weights, linear.mask, strict=True):
        weighted, of_sensor = error * np.sqrt(weight)[..., None], []
        for channel in range(error.shape[-1]):
            mask = kept[..., channel]
            span, first = _autocorrelation(weighted[..., channel], mask)
            if span > longest:
                longest, closest = span, first
            of_sensor.append(span)
            independent += float(np.sum(mask)) / span
        spans.append(tuple(of_sensor))
    return CorrelationTimes(tuple(spans), closest, independent)


class _Autocorrelation(NamedTuple):
    span: float  # in samples; 1 for white errors
    first: float  # the correlation of neighbours; 0 if there are fewer than ten pairs


def _autocorrelation(
    errors: Float[np.ndarray, "records times"], mask: Bool[np.ndarray, "records times"]
) -> _Autocorrelation:
    """Return the autocorrelation time `1 + 2 Σ ρ_l` of one channel, with the correlation ρ_l of
    errors that are l samples apart.

    The sum ends before the first ρ_l that is below twice its standard deviation for white errors,
    or for which there are fewer than ten pairs.
    """
    counts = mask.sum(axis=1, keepdims=True)
    mean = np.where(mask, errors, 0.0).sum(axis=1, keepdims=True) / np.maximum(counts, 1)
    centred = np.where(mask, errors - mean, 0.0)
    variance = np.sum(centred**2)
    if not variance > 0:
        return _Autocorrelation(1.0, 0.0)
    lags = np.arange(1, max(2, int(np.max(np.nonzero(mask)[1], initial=0) + 1) // 3))
    # The sum at each lag is divided by its number of pairs, which is smaller than at lag zero.
    pairs, products = np.round(_lagged_sums(mask)[lags]), _lagged_sums(centred)[lags]
    rho = products / variance * (counts.sum() / np.maximum(pairs, 1))
    ends = (pairs < 10) | (rho < 2.0 / np.sqrt(max(counts.sum(), 1)))
    last = int(np.argmax(ends)) if ends.any() else lags.size
    first = rho[0] if lags.size and pairs[0] >= 10 else 0.0
    return _Autocorrelation(1.0 + 2.0 * float(rho[:last].sum()), float(first))


def _lagged_sums(rows: Shaped[np.ndarray, "records T"]) -> Float[np.ndarray, " T"]:
    """Return the sums of `x[r, i] x[r, i + l]` over r and i for each lag l, by FFT."""
    size = rows.shape[1]
    return np.fft.irfft(np.sum(np.abs(np.fft.rfft(rows, 2 * size)) ** 2, axis=0), 2 * size)[:size]
