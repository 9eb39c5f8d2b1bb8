"""Any linear model with normal noise: the Kalman filter and smoother, in square-root form."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.identify.filtering import roots


class LinearModel(eqx.Module):
    """`x' = F x + d + G u`, `y = H x + c + r v`: u and v of unit variance, independent.

    **Arguments:** `transition` F (n, n); `noise` G (n, m), a root of the covariance that is added;
    `matrix` H (k, n); `deviation` r (k,) of the noise of each number read; then, `None` for zero,
    `push` d (n,) and `offset` c (k,). Each may have a leading axis: F, G, d over the steps between
    T times (T − 1), H, r, c over the times (T). Make correlated noise independent first: divide y,
    H, c by the Cholesky factor of its covariance. **Raises:** `ValueError` for shapes that do not
    fit, and a deviation that is not positive.

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
        transition: Any,
        noise: Any,
        matrix: Any,
        deviation: Any,
        *,
        push: Any = None,
        offset: Any = None,
    ):
        self.transition = _checks.numbers(transition, "transition")
        self.noise, self.matrix = _checks.numbers(noise, "noise"), _checks.numbers(matrix, "matrix")
        spread = _checks.numbers(deviation, "deviation")
        words = (
            "deviation: wanted positive standard deviations; a measurement without noise is "
            "singular: leave the numbers that it fixes out of the state"
        )
        self.deviation = _checks.refuse(spread, ~(spread > 0).all(), words)
        self.push = None if push is None else _checks.numbers(push, "push")
        self.offset = None if offset is None else _checks.numbers(offset, "offset")
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
        """The number of numbers in the state."""
        return self.transition.shape[-1]


class LinearEstimate(eqx.Module):
    """The means of a state at each time, and roots of its covariances.

    **Fields:** `mean` (T, n), `root` (T, n, n), `innovation`, `variance` (T, k) of each number read
    given those before it, and `log_likelihood` of all; of a smoother `kicks` (T − 1, m), the means
    of the noise u, and `kick_covariance` (T − 1, m, m), else `None`.
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
        """The covariances."""
        return self.root @ jnp.swapaxes(self.root, -1, -2)

    @property
    def deviation(self) -> Float[Array, "times n"]:
        """The standard deviations."""
        return jnp.sqrt(jnp.sum(self.root**2, -1))


def linear_filter(
    model: LinearModel, readings: Any, mean: Any, root: Any, seen: Any = None
) -> LinearEstimate:
    """The Kalman filter of a `LinearModel`: the state at each time from the readings so far.

    **Arguments:** `model`; `readings` y (T, k); `mean` (n,) and `root` (n, n), a root of the
    covariance, at the first time before its reading; `seen` (T, k) which numbers count, `None` all.
    **Returns** `mean`, `root`, `innovation`, `variance` and `log_likelihood` (`LinearEstimate`).
    **Raises:** `ValueError` for shapes that do not fit, NaN that is not masked.

    >>> walk = LinearModel(jnp.eye(1), 0.1 * jnp.eye(1), jnp.eye(1), jnp.ones(1))
    >>> found = linear_filter(walk, jnp.ones((3, 1)), jnp.zeros(1), jnp.eye(1))
    >>> found.mean[0].tolist(), found.innovation[0].tolist()
    ([0.5], [1.0])
    """
    return solved(*_given(model, readings, mean, root, seen), back=False)


def linear_smooth(
    model: LinearModel, readings: Any, mean: Any, root: Any, seen: Any = None
) -> LinearEstimate:
    """The state at each time, and the noise of each step, from all readings.

    Rauch, Tung and Striebel 1965, doi:10.2514/3.3166, on roots of the covariances.

    **Arguments**, **returns** and **raises** as `linear_filter`, with `kicks`, the noise u of each
    step, and `kick_covariance`.

    >>> walk = LinearModel(jnp.eye(1), 0.1 * jnp.eye(1), jnp.eye(1), jnp.ones(1))
    >>> found = linear_smooth(walk, jnp.ones((3, 1)), jnp.zeros(1), jnp.eye(1))
    >>> bool(found.mean[0, 0] > 0.5), found.kicks.shape
    (True, (2, 1))
    """
    return solved(*_given(model, readings, mean, root, seen), back=True)


def _given(model: LinearModel, readings: Any, mean: Any, root: Any, seen: Any) -> tuple:
    _checks.instance(model, LinearModel, "model")
    n, k = model.size, model.deviation.shape[-1]
    readings = _checks.rows(readings, (k,), "readings")
    mean, root = _checks.floating(mean, (n,), "mean"), _checks.floating(root, (n, n), "root")
    times = readings.shape[0]
    if not times:
        raise ValueError("readings: wanted at least one row, got none")
    if seen is None:
        seen = jnp.ones(readings.shape, bool)
    seen = jnp.asarray(seen)
    if seen.dtype != bool or seen.shape != readings.shape:
        raise ValueError(f"seen: wanted truth values {readings.shape}, got {seen.shape}")
    bad = seen & ~jnp.isfinite(readings)
    words = "readings: contains NaN or infinity; mask it by `seen` if it is a gap"
    readings = jnp.where(seen, _checks.refuse(readings, bad.any(), words), 0)
    parts = {name: getattr(model, name) for name in _AXES}
    for name, part in _moving(parts).items():
        wanted = times - 1 if name in _STEPS else times
        if part.shape[0] != wanted:
            raise ValueError(f"{name}: wanted {wanted} rows for {times} times, got {part.shape[0]}")
    return parts, readings, mean, root, seen


# The axes of each part of a model; one more if it changes from step to step, or time to time.
_STEPS = {"transition": 2, "noise": 2, "push": 1}
_AXES = _STEPS | {"matrix": 2, "deviation": 1, "offset": 1}
Parts = dict[str, Any]


def _moving(parts: Parts) -> Parts:
    """The parts that change."""
    return {n: part for n, part in parts.items() if part is not None and part.ndim > _AXES[n]}


@partial(jax.jit, static_argnames="back")
def solved(
    parts: Parts, readings: Array, mean: Array, root: Array, seen: Array, *, back: bool
) -> LinearEstimate:
    """The filter forward, and with `back` the smoother's pass; `parts` are a `LinearModel`'s."""
    steps = {name: part for name, part in _moving(parts).items() if name in _STEPS}
    times = {name: part for name, part in _moving(parts).items() if name not in _STEPS}

    def read(row: tuple, mean: Array, root: Array) -> roots.Absorbed:
        times, y, seen = row
        now = parts | times
        error = y if now["offset"] is None else y - now["offset"]
        return roots.absorb_all(mean, root, now["matrix"], error, now["deviation"] ** 2, seen)

    def body(carry: tuple[Array, Array], now: Any) -> tuple[Any, Any]:
        (mean, root), (steps, row) = carry, now
        grown, noise, push = ((parts | steps)[name] for name in ("transition", "noise", "push"))
        predicted = jnp.sum(grown * mean[None], 1)
        if push is not None:
            predicted = predicted + push
        kept = joint(grown, noise, root) if back else None
        before = roots.predicted(grown, root, noise) if kept is None else kept.predicted
        passed = read(row, predicted, before)
        return (passed.step, passed.root), (passed, predicted, kept)

    rows = times, readings, seen
    now, later = (jax.tree.map(lambda leaf, at=at: leaf[at], rows) for at in (0, slice(1, None)))
    first = read(now, mean, root)
    _, (rest, predicted, kept) = lax.scan(body, (first.step, first.root), (steps, later))
    passed = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)
    means, spread, innovation, variance = passed
    total, kicks = roots.terms(innovation, variance, seen).log_density, (None, None)
    if back:
        end = means[-1], spread[-1]
        means, spread, *kicks = smoothed(kept, means[:-1], predicted, parts["noise"], end)
    return LinearEstimate(means, spread, innovation, variance, total, *kicks)


class Joint(NamedTuple):
    """The values of a forward step that the backward pass needs: see `joint`."""

    predicted: Float[Array, "n n"]
    gain: Float[Array, "n n"]
    rest: Float[Array, "n n"]


def joint(grown: Array, noise: Array, root: Array) -> Joint:
    """Roots of the predicted and the conditional covariance, and the smoother's gain, from the
    triangle of `[[F S, G], [S, 0]]`: Park and Kailath 1995, doi:10.1080/00207179508921582.
    """
    n, m = noise.shape
    upper = jnp.concatenate([roots.product(grown, root), noise], 1)
    whole = jnp.concatenate([upper, jnp.pad(root, ((0, 0), (0, m)))])
    # A triangle of 2n needs as many columns.
    whole = roots.triangular(jnp.pad(whole, ((0, 0), (0, max(0, n - m)))))
    predicted, cross = whole[:n, :n], whole[n:, :n]
    return Joint(predicted, roots.divide_right(cross, predicted), whole[n:, n:])


def smoothed(
    kept: Joint, mean: Array, predicted: Array, noise: Array, end: tuple[Array, Array]
) -> tuple[Array, Array, Array, Array]:
    """Means and roots at all times, and means and covariances of the unit noise of all steps.

    The pass back (Rauch, Tung, Striebel 1965), and of the noise (m, m) with `Z = L⁻¹ G`, L the
    predicted root: `1 − ZᵀZ + (Zᵀ L⁻¹ S)(Zᵀ L⁻¹ S)ᵀ`, S the smoothed root after the step.
    """

    def kick(noise: Array, lower: Array, off: Array, root: Array) -> tuple[Array, Array]:
        m = noise.shape[1]
        both = roots.divide(lower, jnp.concatenate([noise, off[:, None], root], 1))
        whitened, mean, spread = both[:, :m], both[:, m], both[:, m + 1 :]
        mean = jnp.sum(whitened * mean[:, None], 0)
        left = jnp.eye(m, dtype=noise.dtype) - roots.product(whitened.T, whitened)
        known = roots.product(whitened.T, spread)
        return mean, left + roots.product(known, known.T)

    def back(later: tuple[Array, Array], now: Any) -> tuple[Any, Any]:
        kept, mean, predicted, moving = now
        off, root = later[0] - predicted, later[1]
        kicks = kick(noise if moving is None else moving, kept.predicted, off, root)
        mean = mean + jnp.sum(kept.gain * off[None], 1)
        out = mean, roots.predicted(kept.gain, root, kept.rest)
        return out, (*out, *kicks)

    moving = noise if noise.ndim > 2 else None
    _, before = lax.scan(back, end, (kept, mean, predicted, moving), reverse=True)
    means, spread = (jnp.concatenate([a, b[None]]) for a, b in zip(before, end, strict=False))
    return means, spread, *before[2:]
