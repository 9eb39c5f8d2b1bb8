"""Apply the low-pass filter that readings passed before they were logged."""

import math
from collections.abc import Callable
from functools import partial
from types import NoneType

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._types import Scalar, ScalarLike

# An interval between two samples is a gap (a hole in the log) if it is longer than _GAP times the
# median interval. After a gap the filter starts anew.
_GAP = 3.0
# Times and values must not be larger than this, since their third powers must be finite in float32,
# too.
_LARGEST = 1e12
_ROOT = math.sqrt(2.0)


class LowPass(eqx.Module):
    """Apply a low-pass filter of first or second order (Butterworth), as in the chips of gyros.

    Give the filter to a sensor (`Gyro(0.01, lowpass=LowPass(40.0))`): the predictions then pass the
    same filter as the readings. Without this filter a fit mistakes the lag of the readings for an
    offset of the clock.

    The filter is `ẏ = w(u − y)` for order 1, and `ÿ + √2 w ẏ + w² y = w² u` for order 2, with the
    input u, the output y and w = 2π · cutoff. It is solved exactly from sample to sample, for an
    input u that is a cubic between samples. Before the first sample u is the cubic through the
    first four samples; before the first sample after a gap of more than three intervals u is a
    straight line.

    **Arguments:** `cutoff` Hz, the frequency of gain 1/√2 (a `Free` may move it); `order` 1 or 2.
    **Raises** `ValueError` for a cutoff that is not positive, and for another order. Source:
    Butterworth 1930, Experimental Wireless 7:536.

    >>> slow = LowPass(0.5)(jnp.arange(4.0), jnp.ones((4, 1)))
    >>> bool(jnp.allclose(slow, 1.0))
    True
    """

    cutoff: Scalar
    order: int = eqx.field(static=True)

    def __init__(self, cutoff: ScalarLike, order: int = 1):
        cutoff = _checks.array_of_shape(cutoff, (), "cutoff")
        cutoff = _checks.require_sign(cutoff, "cutoff", "a positive frequency, Hz")
        self.cutoff = cutoff.astype(jnp.result_type(float))
        if _checks.integer(order, "order", 1) > 2:
            raise ValueError(f"order: wanted 1 or 2, got {order}")
        self.order = order

    def __call__(
        self, t: Float[Array, " times"], values: Float[Array, "times k"]
    ) -> Float[Array, "times k"]:
        """Return the filtered samples (T, k).

        **Arguments:** `t` (T,) increasing times, s; `values` (T, k), of any unit. **Raises**
        `ValueError`, for known times and values, if times do not increase, if a number is NaN, or
        if its cube overflows.
        """
        values = _checks.numeric_array(values, "values")
        if values.ndim != 2:
            raise ValueError(f"values: wanted (T, k), got shape {values.shape}")
        t = _checks.array_of_shape(t, values.shape[:1], "t", hint="a time for each row of values")
        t = t.astype(values.dtype)
        if _checks.is_known((t, values)):
            _require_in_range(np.asarray(t, float), np.asarray(values, float))
        if values.shape[0] < 2:
            return values
        w = 2 * math.pi * self.cutoff.astype(values.dtype)
        gaps = jnp.diff(t)
        # The padding of a shorter record repeats the last time of the record. The padding gets the
        # median interval here. Its samples are masked, so that their values do not matter.
        is_last = gaps <= 0
        usual = jnp.nanmedian(jnp.where(is_last, jnp.nan, gaps))
        gaps = jnp.where(is_last, usual, gaps)
        after_gap = gaps > _GAP * usual
        before, after = _end_slopes(gaps, jnp.diff(values, axis=0), after_gap, is_last)
        # On each interval u = u₀ + b s + c s² + d s³, where s is the time since the begin of the
        # interval.
        h = gaps[:, None]
        chord = jnp.diff(values, axis=0) / h
        c, d = (3 * chord - 2 * before - after) / h, (before + after - 2 * chord) / h**2
        ends = (before, 2 * c, 6 * d), (after, 2 * c + 6 * d * h, 6 * d)
        particular = partial(_particular_solution, self.order, w)
        y0, y1 = particular(values[:-1], ends[0]), particular(values[1:], ends[1])
        begin = y0[0]
        if gaps.size > 2:
            first = particular(values[:1], _first_derivatives(gaps, chord))[0]
            begin = jnp.where(jnp.any(after_gap[:3]), begin, first)
        return _filter_samples(begin, y0, y1, partial(_propagator, self.order, w), gaps, after_gap)


def lowpass_of(lowpass: object) -> LowPass | None:
    """Return `lowpass` if it is a `LowPass` or `None`; raise `TypeError` for anything else."""
    wanted = "LowPass(cutoff in Hz) or None"
    return _checks.require_instance(lowpass, (LowPass, NoneType), "lowpass", requirement=wanted)


def _require_in_range(t: np.ndarray, values: np.ndarray) -> None:
    """Raise `ValueError` for numbers that are NaN or whose cubes overflow, and for times that do
    not increase.
    """
    if not np.isfinite(values).all() or np.abs(values).max(initial=0.0) > _LARGEST:
        raise ValueError(f"values: wanted finite numbers up to {_LARGEST:g}, got NaN or more")
    if not (np.isfinite(t).all() and np.abs(t).max(initial=0.0) <= _LARGEST):
        raise ValueError(f"t: wanted finite times up to {_LARGEST:g} s, got NaN or more")
    if not (np.diff(t) > 1 / _LARGEST).all():
        raise ValueError("t: wanted increasing times")


def _end_slopes(gaps: Array, steps: Array, after_gap: Array, is_last: Array) -> tuple[Array, Array]:
    """Return two arrays (n, k): the slope du/dt of the input u at the begin, and at the end, of
    each of n intervals between samples.

    A slope is computed from the parabola through three neighbouring samples, or from the straight
    line through two samples next to a gap (a hole in the log).

    **Arguments:**

    - `gaps`: (n,) the lengths of the intervals, s.
    - `steps`: (n, k) the changes of u over the intervals.
    - `after_gap`: (n,) true for an interval that is a gap.
    - `is_last`: (n,) true for the padding after the last sample.
    """
    h, chord = gaps[:, None], steps / gaps[:, None]
    apart = (after_gap[1:] | after_gap[:-1])[:, None]
    bend = jnp.where(apart, 0.0, jnp.diff(chord, axis=0) / (h[1:] + h[:-1]))
    # The last interval of a record has no next interval. The parabola at its begin is used at its
    # end, too.
    bend = jnp.where(is_last[1:, None], jnp.roll(bend, 1, axis=0), bend)
    begin = jnp.concatenate([bend[:1] * h[:1], bend * h[1:]]) if bend.shape[0] else 0.0 * chord
    end = jnp.concatenate([bend * h[:-1], bend[-1:] * h[-1:]]) if bend.shape[0] else 0.0 * chord
    return chord - begin, chord + end


def _first_derivatives(gaps: Array, chord: Array) -> tuple[Array, Array, Array]:
    """Return the first, second and third derivative, (1, k) each, of the cubic through the first
    four samples, at the first sample.

    **Arguments:** `gaps` (n,) the lengths of the intervals between samples, s; `chord` (n, k) the
    mean slope in each interval.
    """
    a, b = gaps[0], gaps[0] + gaps[1]
    one = (chord[1] - chord[0]) / b
    two = ((chord[2] - chord[1]) / (gaps[1] + gaps[2]) - one) / (b + gaps[2])
    rate = chord[0] - one * a + two * (a * b)
    return rate[None], 2 * (one - two * (a + b))[None], 6 * two[None]


def _particular_solution(
    order: int, w: Array, u: Array, du: tuple[ArrayLike, ArrayLike, ArrayLike]
) -> Array:
    """Return the particular solution of the filter's equation that is a cubic in time: y, and ẏ/w
    for a filter of order 2, along a new last axis.

    **Arguments:** `order` the order of the filter; `w` its angular frequency, rad/s; `u` the value
    of the input, a cubic in time, at the time of the result; `du` the first three time derivatives
    of the input at this time.
    """
    # With x = (d/dt)/w: 1/(1 + x) = 1 − x + x² − x³ …, 1/(1 + √2 x + x²) = 1 − √2 x + x² + 0 x³ …
    if order == 1:
        return (u - du[0] / w + du[1] / w**2 - du[2] / w**3)[..., None]
    y = u - _ROOT * du[0] / w + du[1] / w**2
    return jnp.stack([y, (du[0] - _ROOT * du[1] / w + du[2] / w**2) / w], axis=-1)


def _propagator(order: int, w: Array, h: Array) -> Array:
    """Return the matrix of the homogeneous solution: multiplied by the difference of the filter's
    state from the particular solution, it gives this difference after a time h.

    **Arguments:** `order` the order of the filter; `w` its angular frequency, rad/s; `h` the time,
    s.
    """
    if order == 1:
        return jnp.exp(-w * h)[None, None]
    a = w * h / _ROOT
    c, s, e = jnp.cos(a), jnp.sin(a), jnp.exp(-a)
    return e * jnp.stack([jnp.stack([c + s, _ROOT * s]), jnp.stack([-_ROOT * s, c - s])])


def _filter_samples(
    begin: Array,
    y0: Array,
    y1: Array,
    propagator: Callable[[Array], Array],
    gaps: Array,
    after_gap: Array,
) -> Array:
    """Return the filtered samples (n + 1, k), computed in a scan over the n intervals between
    samples.

    **Arguments:**

    - `begin`: the state of the filter at the first sample.
    - `y0`, `y1`: the particular solutions at the begin and at the end of each interval.
    - `propagator`: given the length of an interval, it returns the matrix of `_propagator`.
    - `gaps`: (n,) the lengths of the intervals, s.
    - `after_gap`: (n,) true for an interval that is a gap (a hole in the log); after a gap the
      state is the particular solution at the begin of the next interval.
    """

    def step(state: Array, row: tuple[Array, ...]) -> tuple[Array, Array]:
        own0, own1, following, h, gap = row
        after = own1 + (state - own0) @ propagator(h).T
        state = jnp.where(gap, following, after)
        return state, state[:, 0]

    following = jnp.concatenate([y0[1:], y1[-1:]])
    _, rest = lax.scan(step, begin, (y0, y1, following, gaps, after_gap))
    return jnp.concatenate([begin[None, :, 0], rest])
