"""Compute the covariance of a fit, for white and for autocorrelated errors."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, PyTree

from rigidjax.identify.model.model import Model
from rigidjax.identify.model.terms import (
    Blocks,
    Noise,
    joint_residuals,
    prior_weights,
    reading_weights,
    residual_jacobians,
    value_and_jacfwd,
    whiten,
)

# A direction of the free numbers is undetermined if its singular value is below this fraction of
# the largest singular value.
BLIND = 1e-8
# Columns of the Jacobian are scaled to length one, except columns shorter than this fraction of the
# longest column, which may be round-off.
WEAKEST = 1e-6


class Linearisation(eqx.Module):
    """Hold the errors of a model at one point, and the derivatives of the errors with respect to
    the n free numbers.

    Here R is the number of recordings, T the number of samples in time, k the number of components
    of an error, and m the number of free numbers on which one recording depends. The first six
    fields hold one array for each sensor.

    **Fields:**

    - `raw`: (R, T, k) the errors in the unit of the sensor.
    - `raw_slopes`: (R, T, k, m) the derivatives of `raw` with respect to the m numbers of each
      recording.
    - `errors`: (R, T, k) the errors in standard deviations of the noise, as `terms.whiten` returns
      them.
    - `slopes`: (R, T, k, m) the derivatives of `errors` with respect to the m numbers of each
      recording.
    - `weights`: (R, T) the weights of the robust loss.
    - `mask`: (R, T, k) true if an error has a weight and its reading is below full scale.
    - `places`: (R, m) the indices of the numbers of each recording among all n numbers.
    - `prior_residuals`: (n,) the free numbers divided by the standard deviations of their priors.
    - `prior_weights`: (n,) one over the standard deviations of the priors, zero for a number
      without a prior.
    - `extra`: (j,) all further residuals, such as those of a prior of the body.
    - `extra_slopes`: (j, n) the derivatives of `extra` with respect to the n free numbers.

    >>> result = rj.identify.fit(rj.datasets.toutatis.model(), starts=1, max_steps=2)
    >>> [slopes.shape for slopes in result.linear.slopes]  # 17 times, 3 components, 8 free numbers
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
        """Return the number n of free numbers of the linearised model."""
        return int(self.extra_slopes.shape[-1])

    def first_times(self, count: int) -> "Linearisation":
        """Return the errors and derivatives at the first `count` times.

        A fit pads recordings with masked readings at later times, which are left out in this way.
        """
        long = ("raw", "raw_slopes", "errors", "slopes", "weights", "mask")
        parts = {name: tuple(a[:, :count] for a in getattr(self, name)) for name in long}
        return dataclasses.replace(self, **parts)

    @property
    def misfit_gradient(self) -> np.ndarray:
        """Return the gradient (n,) of the misfit with respect to the free numbers.

        The misfit is half the sum of squared residuals, with the residuals of the priors. Under a
        robust loss, the loss of the errors takes the place of half the sum of their squares.
        """
        readings = self.rows_for_all_numbers(self.misfit_gradients_by_recording).sum(axis=0)
        priors = self.prior_weights * self.prior_residuals
        return readings + priors + self.extra @ self.extra_slopes

    @property
    def weighted_jacobian(self) -> np.ndarray:
        """Return the weighted derivatives (R, N, m) of the N errors of all sensors, for each of R
        recordings.

        The derivatives are with respect to the m numbers of each recording. They are multiplied by
        the square roots of the weights of the errors.
        """
        return np.concatenate(self.weighted_jacobians_by_sensor, axis=1)

    @property
    def weighted_jacobians_by_sensor(self) -> list[np.ndarray]:
        """Return for each sensor the weighted derivatives (R, T k, m) of its errors, one row for
        each error.

        There are R recordings, T times, k components of an error, and m numbers of each recording.
        The derivatives are multiplied by the square roots of the weights of the errors.
        """
        return [
            _slopes_as_matrices(slope * np.sqrt(weight)[..., None, None])
            for slope, weight in zip(self.slopes, self.weights, strict=True)
        ]

    @property
    def information_by_sensor(self) -> tuple[np.ndarray, ...]:
        """Return for each sensor the information matrices JᵀWJ (R, m, m), one for each of R
        recordings.

        J holds the derivatives of the errors of the sensor with respect to the m numbers of the
        recording, and W the weights of the errors.
        """
        return tuple(rows.swapaxes(1, 2) @ rows for rows in self.weighted_jacobians_by_sensor)

    def squared_residual_change(self, step: np.ndarray) -> float:
        """Return the sum of the squared changes of all residuals if the n free numbers change by
        `step` (n,).

        The residuals are taken as linear in the step. They include the residuals of the priors.
        """
        moved = np.append(step, 0.0)[self.places]
        readings = np.einsum("rim,rm->ri", self.weighted_jacobian, moved)
        rest = self.prior_weights * step, self.extra_slopes @ step
        return float(sum(np.sum(part**2) for part in (readings, *rest)))

    def rows_for_all_numbers(self, rows: np.ndarray) -> np.ndarray:
        """Return rows (R, n) for all n free numbers of a fit, from rows for the numbers of each
        recording.

        The argument `rows` (R, m) holds, for each of R recordings, one entry for each of the m
        numbers on which this recording depends. All other entries of the result are zero.
        """
        wide = np.zeros((len(rows), self.free_count + 1))
        np.add.at(wide, (np.arange(len(rows))[:, None], self.places), rows)
        return wide[:, :-1]

    def covariance_by_recording(self, covariance: np.ndarray) -> np.ndarray:
        """Return the parts (R, m, m) of a `covariance` (n, n) that belong to the numbers of each
        recording.

        Each of R recordings depends on m of the n free numbers. The result is zero if the
        `covariance` is not finite in all entries.
        """
        known = covariance if np.isfinite(covariance).all() else np.zeros_like(covariance)
        wide = np.pad(known, (0, 1))
        return wide[self.places[:, :, None], self.places[:, None, :]]

    @property
    def misfit_gradients_by_recording(self) -> np.ndarray:
        """Return the gradient (R, m) of the misfit of each of R recordings with respect to its m
        numbers.

        The misfit of a recording is half the sum of its squared errors, or a robust loss of its
        errors.
        """
        total: Any = sum(
            ((error * weight[..., None]).reshape(len(error), 1, -1) @ _slopes_as_matrices(slope))[
                :, 0
            ]
            for error, slope, weight in zip(self.errors, self.slopes, self.weights, strict=True)
        )
        return total


def _slopes_as_matrices(slopes: np.ndarray) -> np.ndarray:
    """Return the derivatives of errors as one matrix for each recording, with one row for each
    error.

    The argument `slopes` (R, T, k, m) holds the derivatives for R recordings, T times and k
    components, with respect to m numbers; the result has the shape (R, T k, m).
    """
    return slopes.reshape(len(slopes), -1, slopes.shape[-1])


@eqx.filter_jit
def _weighted_errors_and_derivatives(
    model: Model, x: Array, noise: Noise, blocks: Blocks
) -> PyTree[Array]:
    """Return the weighted errors of a model, with their derivatives, in one compiled program.

    **Arguments:**

    - `model`: the model, with R recordings.
    - `x`: (n,) the free numbers.
    - `noise`: the standard deviations of the noise of the sensors.
    - `blocks`: for each sensor the errors (R, T, k) at x, at T times and in k components, and their
      derivatives (R, T, k, m) with respect to the m numbers of each recording; errors and
      derivatives are in the unit of the sensor.

    **Returns** three things, from which a `Linearisation` is made:

    - a tuple of three things for the readings: their errors, in standard deviations of the noise;
      the derivatives of these errors; and the weights of the robust loss;
    - the indices (R, m) of the numbers of each recording among all n free numbers;
    - a tuple of four things for the priors: the residual (n,) of the prior of each free number; the
      derivative (n,) of this residual with respect to the number; the residuals (j,) of all other
      priors; and the derivatives (j, n) of these residuals.
    """
    errors, slopes = blocks
    out, slopes = residual_jacobians(lambda e: whiten(model, e, noise), errors, slopes)
    extra, extra_slopes = value_and_jacfwd(lambda x: joint_residuals(model, x), x)
    weights, prior = reading_weights(model, errors, noise), prior_weights(model)
    return (out, slopes, weights), model.index.places, (prior * x, prior, extra, extra_slopes)


def linearise(
    model: Model,
    x: Array,
    noise: Noise,
    blocks: Blocks,
    thickened: tuple[Array, Blocks] | None = None,
) -> Linearisation:
    """Return the errors of a model at the free numbers x, with their derivatives and weights.

    **Arguments:**

    - `model`, `noise`: the model, and the standard deviations of the noise of its sensors.
    - `x`: (n,) the free numbers.
    - `blocks`: for each sensor the errors and the derivatives of the errors at x, as
      `terms.error_jacobians` returns them.
    - `thickened`: `None` if no body is flat (I1 + I2 = I3) at x. Otherwise two things: the free
      numbers of a slightly thicker body, at which the derivatives are computed; and the `blocks` at
      these numbers.
    """
    (errors, slopes, weights), places, others = jax.tree.map(
        np.asarray, _weighted_errors_and_derivatives(model, x, noise, blocks)
    )
    raw, raw_slopes = (tuple(map(np.asarray, part)) for part in blocks)
    if thickened is not None:
        thick = linearise(model, thickened[0], noise, thickened[1])
        slopes, others = thick.slopes, (*others[:-1], thick.extra_slopes)
    pairs = zip(model.records.readings, weights, strict=True)
    mask = tuple(reading.usable & (weight > 0)[..., None] for reading, weight in pairs)
    return Linearisation(raw, raw_slopes, errors, slopes, weights, mask, places, *others)


class Root(eqx.Module):
    """Hold a root of the covariance of n free numbers for white errors, recording by recording.

    A root of a matrix A is a matrix B with B Bᵀ = A. An own number of a recording is a free number
    on which no other recording depends, and which no prior ties to another recording. All other
    free numbers are called shared; their number is s.

    **Fields:**

    - `size`: (n,) the factor by which each number is multiplied, so that the derivatives with
      respect to it are of order one. All other fields are for the multiplied numbers.
    - `lift`: (n, s) how all n numbers change with the s shared numbers, if the own numbers of each
      recording take the values with the least misfit.
    - `core`: (s, r) a root of the covariance of the shared numbers, of which the data determine r
      combinations.
    - `own`: for each recording three things:
        - the indices (k,) of its own numbers among all n numbers;
        - a root (k, j) of the covariance of the own numbers for known shared numbers, of which the
          data determine j combinations;
        - the derivatives (p, k + s), with respect to the own and the shared numbers, of the p
          residuals of priors that depend on own numbers.
    - `ties`: (q, s) the derivatives of the residuals of priors that depend on shared numbers only.
    - `null`: (i, n) the i directions, orthonormal, that the data do not determine.
    """

    size: np.ndarray
    lift: np.ndarray
    core: np.ndarray
    own: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]
    ties: np.ndarray
    null: np.ndarray

    def sandwich_covariance(
        self, rows: np.ndarray, places: np.ndarray, middle: np.ndarray
    ) -> np.ndarray:
        """Return the sandwich covariance `H⁻¹ M H⁻¹` (n, n).

        Here H⁻¹ is the covariance for white errors. The matrix M is the information of the priors
        plus the sum, over recordings, of `rowsᵀ middle rows`.

        **Arguments:**

        - `rows`: (R, q, m) for each recording q rows with an entry for each of its m numbers, such
          as the gradient of its misfit (q = 1).
        - `places`: (R, m) the indices of these numbers among all n numbers.
        - `middle`: (R, q, q) the matrix between the rows of each recording.
        """
        wide, lift = (np.concatenate([x, 0 * x[:1]]) for x in (1.0 / self.size, self.lift))
        rows, inverse = rows * wide[places][:, None, :], self.core @ self.core.T
        total = inverse @ self.ties.T @ self.ties @ inverse
        cross, blocks = np.zeros_like(self.lift), []
        for (mine, root, ties), columns, one, m in zip(self.own, places, rows, middle, strict=True):
            count, alone = mine.size, root @ root.T
            mine_in_row = _indices_in(columns, mine)
            read = alone @ one[:, mine_in_row].T, inverse @ (one @ lift[columns]).T
            tied = ties[:, count:] + ties[:, :count] @ lift[mine]
            held = alone @ ties[:, :count].T, inverse @ tied.T
            total = total + read[1] @ m @ read[1].T + held[1] @ held[1].T
            cross[mine] = read[0] @ m @ read[1].T + held[0] @ held[1].T
            blocks.append(read[0] @ m @ read[0].T + held[0] @ held[0].T)
        both = cross @ self.lift.T
        out = self.lift @ total @ self.lift.T + both + both.T
        for (mine, *_), block in zip(self.own, blocks, strict=True):
            out[np.ix_(mine, mine)] += block
        return self._covariance_in_own_units(out)

    @property
    def covariance(self) -> np.ndarray:
        """Return the covariance (n, n) of the free numbers for white errors, computed from this
        root, within the directions that the data determine.
        """
        half = self.lift @ self.core
        out = half @ half.T
        for mine, root, _ in self.own:
            out[np.ix_(mine, mine)] += root @ root.T
        return self._covariance_in_own_units(out)

    def _covariance_in_own_units(self, scaled_covariance: np.ndarray) -> np.ndarray:
        """Return the covariance (n, n) of the free numbers in their own units.

        The argument `scaled_covariance` (n, n) is the covariance of the numbers multiplied by the
        field `size`, which makes them of order one. The directions in the field `null`, which the
        data do not determine, are projected out.
        """
        covariance = scaled_covariance
        if len(self.null):
            covariance = covariance - self.null.T @ (self.null @ covariance)
            covariance = covariance - (covariance @ self.null.T) @ self.null
        return covariance / np.outer(self.size, self.size)


def _indices_in(columns: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return the indices (k,) at which the entries of `numbers` (k,) are found in `columns` (m,).

    Each entry of `numbers` must occur in `columns`; both hold indices of free numbers.
    """
    order = np.argsort(columns)
    return order[np.searchsorted(columns[order], numbers)]


class Covariance(eqx.Module):
    """Hold a covariance of the n free numbers, and the directions that the data do not determine.

    **Fields:**

    - `covariance`: (n, n) the covariance, with an infinite variance for each number that the data
      do not determine.
    - `determined`: (n, n) the covariance within the directions that the data determine.
    - `kind`: the method of the covariance, in words.
    - `singular_values`: (n,) the singular values of the weighted Jacobian with columns of length
      one.
    - `null_directions`: (k, n) the directions that the data do not determine.
    - `root`: the covariance for white errors as a product B Bᵀ; the `Root` holds B, recording by
      recording. It is `None` if the motion is not finite; both covariances are NaN then.
    """

    covariance: np.ndarray
    determined: np.ndarray
    kind: str
    singular_values: np.ndarray
    null_directions: np.ndarray
    root: Root | None


def white_covariance(linear: Linearisation) -> Covariance:
    """Return the covariance for white errors, `(JᵀWJ)⁻¹`.

    Here J holds the derivatives of all residuals, and W holds their weights. A direction is not
    determined if its singular value is below 1e-8 of the largest one. The numbers on which one
    recording alone depends are eliminated first, recording by recording (Schur complement). The
    singular values of each eliminated block, and of the matrix that remains for the shared numbers,
    are computed separately.
    """
    n, dense = linear.free_count, linear.weighted_jacobian
    if not (np.isfinite(dense).all() and np.isfinite(linear.extra_slopes).all()):
        lost, kind = np.full((n, n), np.nan), "none: the motion is not finite"
        return Covariance(lost, lost, kind, np.full(n, np.nan), np.zeros((0, n)), None)
    triangles, owner = np.linalg.qr(dense, mode="r"), _only_dependent_recordings(linear)
    shared = np.flatnonzero(owner < 0)
    # Divide the columns of the Jacobian by their lengths (`size`), so that a bias in rad/s does not
    # look undetermined next to a moment of inertia. The lower bound of `size` keeps columns of mere
    # round-off from being scaled up.
    squares = np.bincount(linear.places.ravel(), np.sum(triangles**2, axis=1).ravel(), n + 1)[:n]
    size = np.sqrt(squares + linear.prior_weights**2 + np.sum(linear.extra_slopes**2, axis=0))
    size = np.maximum(size, max(WEAKEST * size.max(), 1e-150))
    prior, extra = linear.prior_weights / size, linear.extra_slopes / size
    of = np.where(extra != 0, owner, -1).max(axis=1, initial=-1)
    lift = np.zeros((n, shared.size))
    lift[shared, np.arange(shared.size)] = 1.0
    ties = np.concatenate([np.diag(prior[shared]), extra[of < 0][:, shared]])
    # Take all recordings without own numbers together, such as windows with known starts: they have
    # nothing to eliminate, and a loop over a thousand such recordings took most of the time.
    all_shared = ~np.isin(np.arange(len(triangles)), owner)
    no_own = np.zeros(0, int), np.zeros((0, 0)), np.zeros((0, shared.size))
    rest, own, values, null = (
        [ties, _factor_of_shared_numbers(linear, triangles, size, all_shared, shared)],
        [],
        [],
        [],
    )
    for record, (triangle, columns) in enumerate(zip(triangles, linear.places, strict=True)):
        if all_shared[record]:
            own.append(no_own)
            continue
        mine = np.flatnonzero(owner == record)
        wide, held = np.zeros((len(triangle), n + 1)), np.zeros((mine.size, n))
        wide[:, columns], held[np.arange(mine.size), mine] = triangle, prior[mine]
        priors = np.concatenate([extra[of == record], held])
        rows = np.concatenate([wide[:, :-1] / size, priors])
        range_, root, blind, singular = _range_and_null_space(rows[:, mine])
        taken = range_.T @ rows[:, shared]
        lift[mine] = -root @ taken
        rest.append(np.linalg.qr(rows[:, shared] - range_ @ taken, mode="r"))
        own.append((mine, root, np.concatenate([priors[:, mine], priors[:, shared]], axis=1)))
        values.append(singular)
        null.append(np.zeros((len(blind), n)))
        null[-1][:, mine] = blind
    _, core, blind, singular = _range_and_null_space(np.concatenate(rest))
    null.append(blind @ lift.T)
    root = Root(size, lift, core, tuple(own), ties, np.linalg.qr(np.concatenate(null).T)[0].T)
    directions = root.null / size
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    covariance = root.covariance
    return Covariance(
        with_infinite_variance(directions, covariance),
        covariance,
        "Gauss–Newton",
        np.concatenate([singular, *values]),
        directions,
        root,
    )


def _factor_of_shared_numbers(
    linear: Linearisation,
    triangles: np.ndarray,
    size: np.ndarray,
    selected: np.ndarray,
    shared: np.ndarray,
) -> np.ndarray:
    """Return a triangular matrix that replaces the derivatives of the errors of those recordings
    whose errors depend on shared numbers only.

    A free number of the fit is an own number of a recording if no other recording depends on it,
    and no prior ties it to another one. All other free numbers are called shared; there are s. The
    returned matrix A (q, s) is computed by a QR decomposition. AᵀA is the same as for the
    derivatives of the errors with respect to the shared numbers.

    **Arguments:**

    - `linear`: the derivatives of the errors of all R recordings.
    - `triangles`: (R, q, m) for each recording the triangular factor (QR) of the weighted
      derivatives with respect to its m numbers.
    - `size`: (n,) for each free number the factor by which the derivatives with respect to it are
      divided, to make them of order one.
    - `selected`: (R,) true for recordings whose errors depend on shared numbers only.
    - `shared`: (s,) the indices of the shared numbers among all n.
    """
    wide = np.zeros((int(selected.sum()), triangles.shape[1], linear.free_count + 1))
    columns = np.broadcast_to(linear.places[selected][:, None, :], triangles[selected].shape)
    np.put_along_axis(wide, columns, triangles[selected], axis=2)
    rows = (wide[..., :-1] / size).reshape(-1, linear.free_count)
    return np.linalg.qr(rows[:, shared], mode="r")


def _only_dependent_recordings(linear: Linearisation) -> np.ndarray:
    """Return, for each of n free numbers, the index of the only recording whose errors depend on
    this number.

    The index is −1 for a number on which no recording depends, or more than one recording. It is −1
    as well for numbers of different recordings that one prior ties together. The argument `linear`
    holds the indices of the numbers of each recording (`places`), and the derivatives of the
    residuals of priors that tie numbers together (`extra_slopes`).
    """
    records, n = len(linear.places), linear.free_count
    owner, used = np.full(n + 1, -1), np.zeros((records, n + 1), bool)
    used[np.arange(records)[:, None], linear.places] = True
    alone = used.sum(axis=0) == 1
    owner[alone] = used.argmax(axis=0)[alone]
    for row in linear.extra_slopes != 0:
        tied = np.flatnonzero(row)
        if np.unique(owner[tied][owner[tied] >= 0]).size > 1:
            owner[tied] = -1
    return owner[:-1]


def _range_and_null_space(
    rows: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Compute the range and the null space of a matrix by a singular value decomposition.

    The argument `rows` (q, k) holds derivatives of q residuals with respect to k numbers, with
    columns of order one. A direction is a null direction if its singular value is at most 1e-8 of
    the largest one (or at most 1e-8 if all are smaller than 1). The other r directions are called
    determined.

    **Returns** four things:

    - an orthonormal basis (q, r) of the range;
    - a root (k, r) of the inverse of `rowsᵀ rows` within the determined directions, where a root of
      a matrix A is a matrix B with B Bᵀ = A;
    - the null directions (j, k);
    - all singular values.
    """
    u, singular, directions = np.linalg.svd(rows, full_matrices=False)
    determined = singular > BLIND * singular.max(initial=1.0)
    root = directions[determined].T / singular[determined]
    return u[:, determined], root, directions[~determined], singular


def white_or_sandwich_covariance(
    linear: Linearisation, times: "CorrelationTimes", white: Covariance | None = None
) -> Covariance:
    """Return the covariance for white errors, or the sandwich covariance `H⁻¹ M H⁻¹` if the errors
    are autocorrelated.

    Here H⁻¹ is the covariance for white errors, and M is `Jᵀ C J` plus the information of the
    priors, where J holds the derivatives of the errors and C is the covariance of the errors in
    time. In each channel (one component of a sensor) the second differences of the errors give the
    variance of a white part. The remaining variance belongs to a part whose autocorrelation decays
    exponentially. The decay time cannot be found well from the errors of a fit. Each number
    therefore gets the largest variance over decay times from two samples to half a record. The
    errors of a fit are smaller than the true errors: `Jᵀ C J` is multiplied by n/(n − p) for n
    independent errors and p free numbers. If there are many recordings, the scatter between
    recordings gives a second estimate of the variance, and the larger estimate is used. Source:
    White 1980, doi:10.2307/1912934; Liang and Zeger 1986, doi:10.1093/biomet/73.1.13.

    **Arguments:**

    - `linear`: the errors at the best point, with their derivatives J and weights.
    - `times`: over how many samples the errors are correlated.
    - `white`: the covariance for white errors; `None` computes it.
    """
    white = white_covariance(linear) if white is None else white
    if times.longest_span <= 1.5 or not np.isfinite(white.determined).all():
        return white
    covariance = _sandwich_covariance(linear, white, times)
    kind = f"sandwich: the errors are autocorrelated over {times.longest_span:.0f} samples"
    shown = with_infinite_variance(white.null_directions, covariance)
    return dataclasses.replace(white, covariance=shown, determined=covariance, kind=kind)


def with_infinite_variance(null: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the `covariance` (n, n) with an infinite variance for each number that the data do not
    determine.

    The rows of `null` (k, n) are the directions that the data do not determine. A number is not
    determined if it changes along one of these directions.
    """
    shown = covariance.copy()
    blind = np.abs(null).max(axis=0, initial=0.0) > 1e-6
    shown[blind, blind] = np.inf
    return shown


def covariance_root(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two things: a root (n, m) of the inverse of the matrix `information` (n, n), and the
    null directions (k, n) of this matrix.

    A root of a matrix A is a matrix B with B Bᵀ = A. A null direction is a direction of the n
    numbers that the information does not determine. The inverse is taken within all other
    directions.
    """
    size = np.sqrt(np.diag(information))
    size = np.maximum(size, max(WEAKEST * size.max(), 1e-150))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    determined = values > 1e-14 * values.max()
    half = vectors[:, determined] / np.sqrt(values[determined]) / size[:, None]
    null = vectors[:, ~determined].T / size
    return half, null / np.linalg.norm(null, axis=1, keepdims=True)


def distance_to_minimum(
    linear: Linearisation, white: Covariance, directions: Sequence[np.ndarray] = ()
) -> float:
    """Return the distance from a point to the minimum of the misfit in standard deviations,
    `√(gᵀ(JᵀWJ)⁻¹g)`.

    Here g is the gradient of the misfit at the point, and (JᵀWJ)⁻¹ is the covariance `white` for
    white errors. MINUIT ends a search if this distance is small (James and Roos 1975,
    doi:10.1016/0010-4655(75)90039-9). Each entry of `directions` is the derivative (n,) of a
    function that keeps its value on the way to the minimum, such as the flatness of a body.
    """
    covariance = white.determined
    for row in directions:
        across = covariance @ row
        covariance = covariance - np.outer(across, across) / max(row @ across, 1e-300)
    return float(np.sqrt(max(linear.misfit_gradient @ covariance @ linear.misfit_gradient, 0.0)))


def _sandwich_covariance(
    linear: Linearisation, white: Covariance, times: "CorrelationTimes"
) -> np.ndarray:
    """Return the covariance (n, n) of a fit for errors that are correlated in time.

    It is the sandwich `H⁻¹ M H⁻¹`, where H⁻¹ is the covariance for white errors. The matrix M is
    `Jᵀ C J` plus the information of the priors, where J holds the derivatives of the errors, and C
    is the covariance of the errors in time.

    The variance of each number is the largest of several estimates: one for white errors, one for
    each of several decay times of the autocorrelation and, if there are many recordings, one from
    the scatter between recordings. The derivatives J are first written in orthonormal columns (QR),
    since round-off in products of the derivatives themselves could make variances negative.

    **Arguments:**

    - `linear`: the errors at the best point, with their derivatives J and weights.
    - `white`: the covariance for white errors, with a root of it (a matrix B with B Bᵀ = H⁻¹).
    - `times`: over how many samples the errors are correlated, and the number of independent
      errors.
    """
    columns, triangles = np.linalg.qr(linear.weighted_jacobian)
    longest = max(int(np.median((linear.weights[0] > 0).sum(axis=1))) // 2, 2)
    spans = 2.0 ** np.arange(1, np.log2(longest) + 1)
    n, records = linear.free_count, len(linear.places)
    grown = times.independent / max(times.independent - n, 0.1 * times.independent)
    channels, root = _spectra_and_smooth_shares(linear, columns), white.root
    assert root is not None
    meats = [grown * _correlated_information(*channels, span) for span in spans]
    estimates = [root.sandwich_covariance(triangles, linear.places, meat) for meat in meats]
    if records > n // 2 and records > 5:
        # The scatter of the gradients of the misfit between many recordings gives the variance
        # without a model of how the errors are correlated. The factor R/(R − 1), for R recordings,
        # is the usual one for a variance estimated from R samples.
        between = np.full((records, 1, 1), records / (records - 1))
        estimates.append(
            root.sandwich_covariance(
                linear.misfit_gradients_by_recording[:, None], linear.places, between
            )
        )
    # Take the estimate whose variances are largest on average, relative to those for white errors.
    # Scale it up for each number that has a larger variance in another estimate; the covariance for
    # white errors counts as an estimate, too.
    all_ = np.stack([np.diag(white.determined), *(np.diag(c) for c in estimates)])
    least = np.maximum(all_[0], 1e-300)
    out = estimates[int(np.argmax((all_[1:] / least).mean(axis=1)))]
    own = np.maximum(np.diag(out), 1e-300)
    factor = np.sqrt(np.maximum(all_.max(axis=0) / own, 1.0))
    return out * np.outer(factor, factor)


def _spectra_and_smooth_shares(
    linear: Linearisation, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return two arrays for all k channels: the spectra in time of the derivatives of the errors of
    a fit; and the fraction of the variance of the errors that is not white.

    A channel is one component of one sensor.

    **Arguments:** `linear` the errors of R recordings at T times, with their weights; `columns`
    (R, N, m) orthonormal columns that span the derivatives of the N errors of each recording.

    **Returns** two things:

    - the spectra (R, k, 2, T + 1, m) of the columns, multiplied by the standard deviation of the
      errors of the channel: the real and the imaginary part at each of T + 1 frequencies;
    - for each channel the fraction (k, 1, 1) of the variance of its errors that is smooth in time,
      between 0 and 1.
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
            shares.append(smooth_variance_share(e, weight > 0))
    # The columns are padded with zeros to twice the length, since a convolution by FFT would
    # otherwise wrap around.
    size = 2 * slopes[0].shape[1]
    spectra = np.fft.rfft(np.stack(slopes, axis=1), size, axis=2)
    each = np.full(size // 2 + 1, 2.0 / size)
    each[[0, -1]] = 1.0 / size
    parts = np.stack([spectra.real, spectra.imag], axis=2) * np.sqrt(each)[:, None]
    return parts, np.array(shares)[:, None, None]


def _correlated_information(
    spectra: np.ndarray, smooth_shares: np.ndarray, decay_time: float
) -> np.ndarray:
    """Return `Jᵀ C J` (R, m, m), for errors whose covariance C in time has a white and a smooth
    part.

    J holds the derivatives of the errors of R recordings with respect to m numbers. The smooth part
    has an autocorrelation that decays exponentially over `decay_time` samples; the rest of the
    variance is white.

    **Arguments:**

    - `spectra`: (R, k, 2, T + 1, m) the Fourier transforms in time of J for k channels (components
      of sensors), multiplied by the standard deviation of the errors of the channel. They have a
      real and an imaginary part at each of T + 1 frequencies.
    - `smooth_shares`: (k, 1, 1) the fraction of the variance of each channel that is smooth.
    - `decay_time`: the decay time, in samples.
    """
    size = 2 * spectra.shape[3] - 2
    lags = np.arange(size)
    decay = np.exp(-np.minimum(lags, size - lags) / decay_time)
    power = smooth_shares * np.fft.rfft(decay).real[:, None] + (1.0 - smooth_shares)
    weighed = spectra * power[:, None]
    flat = (*spectra.shape[:2], -1, spectra.shape[-1])
    return np.sum(weighed.reshape(flat).swapaxes(2, 3) @ spectra.reshape(flat), axis=1)


def smooth_variance_share(errors: np.ndarray, mask: np.ndarray) -> float:
    """Return the fraction of the variance of `errors` (R, T) that is not white noise, from 0 to 1.

    The variance of the white noise in the R rows of T samples is estimated from the second
    differences of the errors; the rest of the variance belongs to a part that is smooth in time.
    Only the errors where `mask` (R, T) is true are used.
    """
    rows = [x[kept] for x, kept in zip(errors, mask, strict=True)]
    total = sum(float(row @ row) for row in rows) / max(sum(row.size for row in rows), 1)
    return float(np.clip(1.0 - white_noise_variance(rows) / total, 0.0, 1.0)) if total > 0 else 1.0


def white_noise_variance(samples: list[np.ndarray]) -> float:
    """Return the variance of the white noise in `samples`, estimated from second differences in
    time.

    Each entry of `samples` is an array of successive samples, such as the errors of one recording.
    A smooth signal hardly changes the second differences. The variance is 0 if no array has three
    samples.
    """
    bends = np.concatenate([row[2:] - 2.0 * row[1:-1] + row[:-2] for row in samples])
    # The second difference of white noise has six times the variance of the noise.
    return float(np.mean(bends**2)) / 6.0 if bends.size else 0.0


class CorrelationTimes(eqx.Module):
    """Hold the autocorrelation of the errors of a fit.

    **Fields:**

    - `spans`: for each channel of each sensor (each component of its errors) the number of samples
      over which errors are autocorrelated; 1 for white errors.
    - `closeness`: the correlation of neighbouring errors in the channel with the largest span; 0 if
      the errors of all channels are white.
    - `independent`: the number of independent errors of all channels together.
    """

    spans: tuple[tuple[float, ...], ...]
    closeness: float
    independent: float

    @property
    def longest_span(self) -> float:
        """Return the largest number of samples over which the errors of any channel are
        autocorrelated.
        """
        return max(span for sensor in self.spans for span in sensor)


def correlation_times(linear: Linearisation) -> CorrelationTimes:
    """Return over how many samples the errors of each channel (one component of a sensor) are
    correlated.

    The autocorrelation time is `1 + 2 Σ ρ_l`, with the correlation ρ_l of errors that are l samples
    apart. The sum ends before the first ρ_l that is below twice the standard deviation of ρ_l for
    white errors, or for which there are fewer than ten pairs of errors. Readings at full scale are
    left out. The argument `linear` holds the errors with their weights.
    """
    spans, longest, closest, independent = [], 1.0, 0.0, 0.0
    for error, weight, kept in zip(linear.errors, linear.weights, linear.mask, strict=True):
        weighted, of_sensor = error * np.sqrt(weight)[..., None], []
        for channel in range(error.shape[-1]):
            mask = kept[..., channel]
            span, first = _autocorrelation_time_and_first_correlation(weighted[..., channel], mask)
            if span > longest:
                longest, closest = span, first
            of_sensor.append(span)
            independent += float(np.sum(mask)) / span
        spans.append(tuple(of_sensor))
    return CorrelationTimes(tuple(spans), closest, independent)


def _autocorrelation_time_and_first_correlation(
    errors: np.ndarray, mask: np.ndarray
) -> tuple[float, float]:
    """Return two numbers: the autocorrelation time of errors, in samples; and the correlation of
    neighbouring errors.

    The autocorrelation time is `1 + 2 Σ ρ_l`, with the correlation ρ_l of errors that are l samples
    apart; it is 1 for white errors. The sum ends before the first ρ_l that is below twice the
    standard deviation of ρ_l for white errors, or for which there are fewer than ten pairs of
    errors. The correlation of neighbouring errors is 0 if there are fewer than ten pairs of
    neighbours.

    **Arguments:** `errors` (R, T) for R recordings and T times, the errors of one component of a
    sensor; `mask` (R, T) true for the errors to use.
    """
    counts = mask.sum(axis=1, keepdims=True)
    mean = np.where(mask, errors, 0.0).sum(axis=1, keepdims=True) / np.maximum(counts, 1)
    centred = np.where(mask, errors - mean, 0.0)
    variance = np.sum(centred**2)
    if not variance > 0:
        return 1.0, 0.0
    lags = np.arange(1, max(2, int(np.max(np.nonzero(mask)[1], initial=0) + 1) // 3))
    # The sum at each lag is divided by its number of pairs, which is smaller than at lag zero.
    pairs, products = (
        np.round(_sums_of_lagged_products(mask)[lags]),
        _sums_of_lagged_products(centred)[lags],
    )
    rho = products / variance * (counts.sum() / np.maximum(pairs, 1))
    ends = (pairs < 10) | (rho < 2.0 / np.sqrt(max(counts.sum(), 1)))
    last = int(np.argmax(ends)) if ends.any() else lags.size
    first = rho[0] if lags.size and pairs[0] >= 10 else 0.0
    return 1.0 + 2.0 * float(rho[:last].sum()), float(first)


def _sums_of_lagged_products(rows: np.ndarray) -> np.ndarray:
    """Return, for each lag l from 0 to T − 1, the sum of the products of entries that are l samples
    apart.

    The argument `rows` (R, T) holds x[r, i] for R recordings and T samples. The sums (T,) of
    `x[r, i] x[r, i + l]` over all r and i are computed by FFT.
    """
    size = rows.shape[1]
    return np.fft.irfft(np.sum(np.abs(np.fft.rfft(rows, 2 * size)) ** 2, axis=0), 2 * size)[:size]
