"""Compute the Kalman filter and the smoother of a linear model with normal noise, in square-root
form.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float

from rigidjax import _checks
from rigidjax._types import Numbers, Scalar
from rigidjax.identify.filtering import roots

# An argument of `LinearModel` is an array or nested lists of numbers. It may have a leading axis
# over steps or times.
Parameter = Float[ArrayLike, "..."] | Numbers


class LinearModel(eqx.Module):
    """Hold a linear model of a state x and its readings y, with normal noise.

    A step leads from x to `F x + d + G u`, and the readings are `y = H x + c + r v`, where r is
    multiplied by v entry by entry. The vectors u and v are normal, with independent entries of unit
    variance. The state x has n entries, y and v have k, and u has m.

    **Arguments:**

    - `transition`: F (n, n).
    - `noise`: G (n, m), a root of the covariance `G Gᵀ` that a step adds.
    - `matrix`: H (k, n).
    - `deviation`: r (k,), the standard deviation of the noise of each number read.
    - `push`: d (n,), or `None` for zero.
    - `offset`: c (k,), or `None` for zero.

    Each array may have a leading axis: F, G and d over the T − 1 steps between T times; H, r and c
    over the T times. The noise of the readings must be independent: if it is correlated, first
    multiply y, H and c by the inverse of the Cholesky factor of the covariance of the noise.
    **Raises:** `ValueError` for shapes that do not fit, and for a deviation that is not positive.

    >>> walk = LinearModel(jnp.eye(1), 0.1 * jnp.eye(1), jnp.eye(1), jnp.ones(1))
    >>> walk.size
    1
    """

    transition: Float[Array, "*steps n n"]
    noise: Float[Array, "*steps n m"]
    matrix: Float[Array, "*times k n"]
    deviation: Float[Array, "*times k"]
    push: Float[Array, "*steps n"] | None
    offset: Float[Array, "*times k"] | None

    def __init__(
        self,
        transition: Parameter,
        noise: Parameter,
        matrix: Parameter,
        deviation: Parameter,
        *,
        push: Parameter | None = None,
        offset: Parameter | None = None,
    ):
        self.transition = _checks.numeric_array(transition, "transition")
        self.noise = _checks.numeric_array(noise, "noise")
        self.matrix = _checks.numeric_array(matrix, "matrix")
        sigma = _checks.numeric_array(deviation, "deviation")
        words = (
            "deviation: wanted positive standard deviations; a measurement without noise is "
            "singular: leave the numbers that it fixes out of the state"
        )
        self.deviation = _checks.error_if(sigma, ~(sigma > 0).all(), words)
        self.push = None if push is None else _checks.numeric_array(push, "push")
        self.offset = None if offset is None else _checks.numeric_array(offset, "offset")
        if self.transition.ndim < 2:
            got = self.transition.shape
            raise ValueError(f"transition: wanted a matrix (n, n), got shape {got}")
        n, k = self.transition.shape[-1], self.matrix.shape[-2:-1]
        for name, wanted in {
            "transition": (n, n),
            "noise": (n, self.noise.shape[-1] if self.noise.ndim else 1),
            "matrix": (*k, n),
            "deviation": k,
            "push": (n,),
            "offset": k,
        }.items():
            part = getattr(self, name)
            extra = 0 if part is None else part.ndim - len(wanted)
            if part is not None and (extra not in (0, 1) or part.shape[extra:] != wanted):
                raise ValueError(
                    f"{name}: wanted shape {wanted}, with one leading axis of times or none, got "
                    f"{part.shape}"
                )

    @property
    def size(self) -> int:
        """Return n, the number of entries of the state of this model."""
        return self.transition.shape[-1]


class LinearEstimate(eqx.Module):
    """Hold the estimated state of a `LinearModel` at each time, and its covariance.

    There are T times; the state has n entries, a reading k numbers and the noise of a step m.

    **Fields:**

    - `mean`: (T, n) the mean of the state at each time.
    - `root`: (T, n, n) a root S of the covariance `S Sᵀ` of the state at each time.
    - `innovation`: (T, k) each number read minus its prediction from the numbers read before it.
    - `variance`: (T, k) the variance of each innovation.
    - `log_likelihood`: the logarithm of the density of all numbers read.
    - `kicks`: for a smoother, (T − 1, m) the mean of the noise u of each step; else `None`.
    - `kick_covariance`: for a smoother, (T − 1, m, m) the covariance of the noise u of each step;
      else `None`.
    """

    mean: Float[Array, "times n"]
    root: Float[Array, "times n n"]
    innovation: Float[Array, "times k"]
    variance: Float[Array, "times k"]
    log_likelihood: Scalar
    kicks: Float[Array, "steps m"] | None
    kick_covariance: Float[Array, "steps m m"] | None

    @property
    def covariance(self) -> Float[Array, "times n n"]:
        """Return the covariance `S Sᵀ` of the state at each time, with the roots S in `root`."""
        return self.root @ jnp.swapaxes(self.root, -1, -2)

    @property
    def deviation(self) -> Float[Array, "times n"]:
        """Return the standard deviation (T, n) of each of the n entries of the estimated state at
        each of the T times.
        """
        return jnp.sqrt(jnp.sum(self.root**2, -1))


# _AXES holds the number of axes of each array of a `LinearModel`. An array that changes from step
# to step, or from time to time, has one more axis. The arrays in _STEPS belong to the steps, all
# other arrays to the times.
_STEPS = {"transition": 2, "noise": 2, "push": 1}
_AXES = _STEPS | {"matrix": 2, "deviation": 1, "offset": 1}
ArraysByField = dict[str, Any]


Readings = Float[ArrayLike, "times k"] | Numbers
Mean = Float[ArrayLike, " n"] | Numbers
Root = Float[ArrayLike, "n n"] | Numbers
Mask = Bool[ArrayLike, "times k"] | Numbers | None


def linear_filter(
    model: LinearModel, readings: Readings, mean: Mean, root: Root, mask: Mask = None
) -> LinearEstimate:
    """Return the state of a `LinearModel` at each time from the readings up to this time (Kalman
    filter).

    **Arguments:**

    - `model`: a `LinearModel`.
    - `readings`: y (T, k), k numbers at each of T times.
    - `mean`: (n,) the mean of the state at the first time, before the first readings.
    - `root`: (n, n) a root S of the covariance `S Sᵀ` of the state at the first time.
    - `mask`: (T, k) true for the numbers that count; `None` if all numbers count.

    **Returns** a `LinearEstimate` with `mean`, `root`, `innovation`, `variance` and
    `log_likelihood`. **Raises:** `ValueError` for shapes that do not fit, and for NaN that is not
    masked.

    >>> walk = LinearModel(jnp.eye(1), 0.1 * jnp.eye(1), jnp.eye(1), jnp.ones(1))
    >>> estimate = linear_filter(walk, jnp.ones((3, 1)), jnp.zeros(1), jnp.eye(1))
    >>> estimate.mean[0].tolist(), estimate.innovation[0].tolist()
    ([0.5], [1.0])
    """
    return linear_estimate(*_checked(model, readings, mean, root, mask), smooth=False)


def linear_smooth(
    model: LinearModel, readings: Readings, mean: Mean, root: Root, mask: Mask = None
) -> LinearEstimate:
    """Return the state of a `LinearModel` at each time, and the noise of each step, from all
    readings.

    The method is the smoother of Rauch, Tung and Striebel (1965, doi:10.2514/3.3166), which here
    uses roots of the covariances.

    The arguments `model`, `readings`, `mean`, `root` and `mask` and the errors raised are as for
    `linear_filter`. The function **returns** a `LinearEstimate` that also holds `kicks`, the noise
    u of each step, and `kick_covariance`.

    >>> walk = LinearModel(jnp.eye(1), 0.1 * jnp.eye(1), jnp.eye(1), jnp.ones(1))
    >>> estimate = linear_smooth(walk, jnp.ones((3, 1)), jnp.zeros(1), jnp.eye(1))
    >>> bool(estimate.mean[0, 0] > 0.5), estimate.kicks.shape
    (True, (2, 1))
    """
    return linear_estimate(*_checked(model, readings, mean, root, mask), smooth=True)


class _Problem(NamedTuple):
    parts: ArraysByField
    readings: Float[Array, "times k"]  # zero where masked
    mean: Float[Array, " n"]
    root: Float[Array, "n n"]
    mask: Bool[Array, "times k"]


def _checked(
    model: LinearModel, readings: Readings, mean: Mean, root: Root, mask: Mask
) -> _Problem:
    """Return the arguments of `linear_filter` after checks, which raise its errors."""
    _checks.require_instance(model, LinearModel, "model")
    n, k = model.size, model.deviation.shape[-1]
    readings = _checks.array_of_rows(readings, (k,), "readings")
    mean = _checks.array_of_shape(mean, (n,), "mean")
    root = _checks.array_of_shape(root, (n, n), "root")
    times = readings.shape[0]
    if not times:
        raise ValueError("readings: wanted at least one row, got none")
    if mask is None:
        mask = jnp.ones(readings.shape, bool)
    mask = jnp.asarray(mask)
    if mask.dtype != bool or mask.shape != readings.shape:
        raise ValueError(
            f"mask: wanted truth values of shape {readings.shape}, got {mask.dtype} of {mask.shape}"
        )
    bad = mask & ~jnp.isfinite(readings)
    words = "readings: contains NaN or infinity; mask it if it is a gap"
    readings = jnp.where(mask, _checks.error_if(readings, bad.any(), words), 0)
    parts = {name: getattr(model, name) for name in _AXES}
    for name, part in _varying(parts).items():
        wanted = times - 1 if name in _STEPS else times
        if part.shape[0] != wanted:
            raise ValueError(f"{name}: wanted {wanted} rows for {times} times, got {part.shape[0]}")
    return _Problem(parts, readings, mean, root, mask)


def _varying(parts: ArraysByField) -> ArraysByField:
    """Return the arrays that change from step to step: these have one more axis, their first."""
    return {n: part for n, part in parts.items() if part is not None and part.ndim > _AXES[n]}


@partial(jax.jit, static_argnames="smooth")
def linear_estimate(
    parts: ArraysByField, readings: Array, mean: Array, root: Array, mask: Array, *, smooth: bool
) -> LinearEstimate:
    """Return the states of a linear model by the Kalman filter or, with `smooth`, by the smoother.

    The `parts` are the arrays of a `LinearModel`; `mean` and `root` are before the first readings.
    """
    varying = _varying(parts)
    steps = {name: part for name, part in varying.items() if name in _STEPS}
    times = {name: part for name, part in varying.items() if name not in _STEPS}

    def update_by(row: tuple, mean: Array, root: Array) -> roots.Update:
        times, y, mask = row
        at_time: dict[str, Any] = parts | times
        error = y if at_time["offset"] is None else y - at_time["offset"]
        return roots.kalman_update(
            mean, root, at_time["matrix"], error, at_time["deviation"] ** 2, mask
        )

    def advance(
        carry: tuple[Array, Array], row_of_step: tuple[ArraysByField, tuple]
    ) -> tuple[Any, Any]:
        (mean, root), (steps, row) = carry, row_of_step
        of_step: dict[str, Any] = parts | steps
        transition, noise, push = (of_step[name] for name in ("transition", "noise", "push"))
        predicted = jnp.sum(transition * mean[None], 1)
        if push is not None:
            predicted = predicted + push
        joint = smoother_matrices(transition, noise, root) if smooth else None
        before = joint.predicted if joint else roots.predicted_root(transition, root, noise)
        update = update_by(row, predicted, before)
        return (update.step, update.root), (update, predicted, joint)

    rows = times, readings, mask
    first_row, later_rows = (
        jax.tree.map(lambda leaf, at=at: leaf[at], rows) for at in (0, slice(1, None))
    )
    first = update_by(first_row, mean, root)
    _, (rest, predicted, joint) = lax.scan(advance, (first.step, first.root), (steps, later_rows))
    updates = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)
    means, all_roots, innovation, variance = updates
    total, kicks = roots.density_terms(innovation, variance, mask).total, (None, None)
    if smooth:
        end, noise = (means[-1], all_roots[-1]), parts["noise"]
        means, all_roots, *kicks = backward_pass(joint, means[:-1], predicted, noise, end)
    return LinearEstimate(means, all_roots, innovation, variance, total, *kicks)


class SmootherMatrices(NamedTuple):
    """Hold the matrices of one forward step that the backward pass of a smoother needs."""

    predicted: Float[Array, "n n"]  # a root of the covariance of the predicted state
    gain: Float[Array, "n n"]  # maps a change after the step to the change before it
    rest: Float[Array, "n n"]  # a root of the covariance before, for a known state after the step


def smoother_matrices(transition: Array, noise: Array, root: Array) -> SmootherMatrices:
    """Return the gain of a smoother and roots of covariances for one step, from blocks of the
    triangular root of `[[F S, G], [S, 0]]` (Park and Kailath 1995, doi:10.1080/00207179508921582).
    """
    n, m = noise.shape
    upper = jnp.concatenate([roots.matrix_product(transition, root), noise], 1)
    whole = jnp.concatenate([upper, jnp.pad(root, ((0, 0), (0, m)))])
    # If m < n, columns of zeros are added, which do not change `A Aᵀ`: the matrix A then has at
    # least as many columns as rows.
    whole = roots.triangular_root(jnp.pad(whole, ((0, 0), (0, max(0, n - m)))))
    predicted, cross = whole[:n, :n], whole[n:, :n]
    return SmootherMatrices(predicted, roots.right_divide(cross, predicted), whole[n:, n:])


class Backward(NamedTuple):
    mean: Float[Array, "times n"]
    root: Float[Array, "times n n"]
    kicks: Float[Array, "steps m"]  # the means of the unit noise of each step
    kick_covariance: Float[Array, "steps m m"]


def backward_pass(
    joint: SmootherMatrices, mean: Array, predicted: Array, noise: Array, last: tuple[Array, Array]
) -> Backward:
    """Return the smoothed states and the noise of each step, by a pass back over all steps.

    The method is the backward pass of Rauch, Tung and Striebel (1965). The covariance of the unit
    noise of a step is `I − ZᵀZ + (Zᵀ L⁻¹ S)(Zᵀ L⁻¹ S)ᵀ` with the unit matrix I and `Z = L⁻¹ G`.
    Here G maps the unit noise to the state after the step, L is a root of the predicted covariance
    of this state, and S is a root of its smoothed covariance. The filtered `mean` (T − 1, n) is
    that before each step, `predicted` that after it, and `last` holds mean and root at the end.
    """

    def noise_estimate(
        noise: Array, predicted_root: Array, error: Array, root: Array
    ) -> tuple[Array, Array]:
        m = noise.shape[1]
        both = roots.left_divide(predicted_root, jnp.concatenate([noise, error[:, None], root], 1))
        whitened, mean, scaled_root = both[:, :m], both[:, m], both[:, m + 1 :]
        mean = jnp.sum(whitened * mean[:, None], 0)
        left = jnp.eye(m, dtype=noise.dtype) - roots.matrix_product(whitened.T, whitened)
        known = roots.matrix_product(whitened.T, scaled_root)
        return mean, left + roots.matrix_product(known, known.T)

    def step_back(state_after: tuple[Array, Array], row: tuple) -> tuple[Any, Any]:
        joint, mean, predicted, own_noise = row
        off, root = state_after[0] - predicted, state_after[1]
        kicks = noise_estimate(
            noise if own_noise is None else own_noise, joint.predicted, off, root
        )
        mean = mean + jnp.sum(joint.gain * off[None], 1)
        out = mean, roots.predicted_root(joint.gain, root, joint.rest)
        return out, (*out, *kicks)

    own_noise = noise if noise.ndim > 2 else None
    _, before = lax.scan(step_back, last, (joint, mean, predicted, own_noise), reverse=True)
    means, all_roots = (jnp.concatenate([a, b[None]]) for a, b in zip(before, last, strict=False))
    return Backward(means, all_roots, *before[2:])
