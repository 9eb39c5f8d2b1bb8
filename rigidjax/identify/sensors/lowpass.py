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

from rigidjax import _checks, _show
from rigidjax._types import Scalar, ScalarLike

# An interval between two samples is a hole in the log if it is longer than _HOLE times the median
# interval. After a hole the filter starts anew.
_HOLE = 3.0
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
    input u that is a cubic between samples. Before the first sample u is taken as the cubic through
    the first four samples. A hole in the log is an interval of more than three times the median
    interval. After a hole the filter starts anew: before the first sample after the hole, u is
    taken as the cubic of the interval that follows this sample.

    **Arguments:** `cutoff` Hz, the frequency of gain 1/√2 (a fit estimates it if it is a `Free`);
    `order` 1 or 2. **Raises** `ValueError` for a cutoff that is not positive, and for another
    order. Source: Butterworth 1930, Experimental Wireless 7:536.

    >>> slow = LowPass(0.5)(jnp.arange(4.0), jnp.ones((4, 1)))
    >>> bool(jnp.allclose(slow, 1.0))
    True
    """

    cutoff: Scalar
    order: int = eqx.field(static=True)

    __repr__ = _show.fields_as_text

    def __init__(self, cutoff: ScalarLike, order: int = 1):
        cutoff = _checks.array_of_shape(cutoff, (), "cutoff")
        cutoff = _checks.require_positive(cutoff, "cutoff", "a positive frequency, Hz")
        self.cutoff = cutoff.astype(jnp.result_type(float))
        if _checks.integer(order, "order", 1) > 2:
            raise ValueError(f"order: wanted 1 or 2, got {order}")
        self.order = order

    def __call__(
        self, t: Float[Array, " times"], values: Float[Array, "times k"]
    ) -> Float[Array, "times k"]:
        """Return the filtered samples (T, k).

        **Arguments:** `t` (T,) increasing times, s; `values` (T, k), of any unit. **Raises**
        `ValueError` if times do not increase, if a number is NaN, or if the cube of a number would
        overflow in float32; these checks are left out if JAX traces the times or values.
        """
        values = _checks.numeric_array(values, "values")
        if values.ndim != 2:
            raise ValueError(
                f"values: wanted an array (T, k), with a row of k numbers for each of T times, got "
                f"shape {values.shape}"
            )
        t = _checks.array_of_shape(t, values.shape[:1], "t", hint="a time for each row of values")
        t = t.astype(values.dtype)
        if _checks.is_known((t, values)):
            _require_in_range(np.asarray(t, float), np.asarray(values, float))
        if values.shape[0] < 2:
            return values
        w = 2 * math.pi * self.cutoff.astype(values.dtype)
        intervals = jnp.diff(t)
        # The padding of a shorter record repeats the last time of the record. The intervals of the
        # padding, which are zero, are replaced by the median interval. The samples of the padding
        # are masked, so that their filtered values do not matter.
        is_padding = intervals <= 0
        usual = jnp.nanmedian(jnp.where(is_padding, jnp.nan, intervals))
        intervals = jnp.where(is_padding, usual, intervals)
        is_hole = intervals > _HOLE * usual
        before, after = _end_slopes(intervals, jnp.diff(values, axis=0), is_hole, is_padding)
        # On each interval u = u₀ + b s + c s² + d s³, where s is the time since the begin of the
        # interval.
        h = intervals[:, None]
        chord = jnp.diff(values, axis=0) / h
        c, d = (3 * chord - 2 * before - after) / h, (before + after - 2 * chord) / h**2
        ends = (before, 2 * c, 6 * d), (after, 2 * c + 6 * d * h, 6 * d)
        particular = partial(_particular, self.order, w)
        y0, y1 = particular(values[:-1], ends[0]), particular(values[1:], ends[1])
        begin = y0[0]
        if intervals.size > 2:
            first = particular(values[:1], _first_derivatives(intervals, chord))[0]
            begin = jnp.where(jnp.any(is_hole[:3]), begin, first)
        return _filter_samples(
            begin, y0, y1, partial(_propagator, self.order, w), intervals, is_hole
        )


def lowpass_of(lowpass: object) -> LowPass | None:
    """Return `lowpass` if it is a `LowPass` or `None`; raise `TypeError` for anything else."""
    wanted = "LowPass(cutoff in Hz) or None"
    return _checks.require_instance(lowpass, (LowPass, NoneType), "lowpass", requirement=wanted)


def _require_in_range(t: np.ndarray, values: np.ndarray) -> None:
    """Raise `ValueError` for samples that a low-pass filter cannot use.

    **Arguments:** `t` (T,) the times, s, which must increase; `values` (T, k) the samples. All
    times and samples must be finite, and so small that their cubes do not overflow in float32.
    """
    if not np.isfinite(values).all() or np.abs(values).max(initial=0.0) > _LARGEST:
        raise ValueError(
            f"values: wanted finite numbers up to {_LARGEST:g}, got NaN or a larger one"
        )
    if not (np.isfinite(t).all() and np.abs(t).max(initial=0.0) <= _LARGEST):
        raise ValueError(f"t: wanted finite times up to {_LARGEST:g} s, got NaN or a larger one")
    if not (np.diff(t) > 1 / _LARGEST).all():
        index = int(np.argmin(np.diff(t) > 1 / _LARGEST)) + 1
        raise ValueError(f"t: wanted increasing times; t[{index}] is not above t[{index - 1}]")


def _end_slopes(
    intervals: Array, changes: Array, is_hole: Array, is_padding: Array
) -> tuple[Array, Array]:
    """Return two arrays (n, k): the time derivatives of a sampled input at the begin, and at the
    end, of each of n intervals between samples.

    Each derivative is the slope of the parabola through three neighbouring samples or, at a sample
    next to a hole in the log, the slope of the straight line through the two samples of the
    interval.

    **Arguments:**

    - `intervals`: (n,) the lengths of all intervals, s.
    - `changes`: (n, k) the changes of the k channels of the input over the intervals.
    - `is_hole`: (n,) true for an interval that is a hole in the log.
    - `is_padding`: (n,) true for the padding after the last sample.
    """
    h, chord = intervals[:, None], changes / intervals[:, None]
    apart = (is_hole[1:] | is_hole[:-1])[:, None]
    bend = jnp.where(apart, 0.0, jnp.diff(chord, axis=0) / (h[1:] + h[:-1]))
    # The last interval of a record has no next interval. The parabola at its begin is used at its
    # end, too.
    bend = jnp.where(is_padding[1:, None], jnp.roll(bend, 1, axis=0), bend)
    begin = jnp.concatenate([bend[:1] * h[:1], bend * h[1:]]) if bend.shape[0] else 0.0 * chord
    end = jnp.concatenate([bend * h[:-1], bend[-1:] * h[-1:]]) if bend.shape[0] else 0.0 * chord
    return chord - begin, chord + end


def _first_derivatives(intervals: Array, mean_slopes: Array) -> tuple[Array, Array, Array]:
    """Return the first, second and third time derivative of a sampled input at its first sample.

    The three arrays (1, k), for k channels, are the derivatives of the cubic through the first four
    samples.

    **Arguments:** `intervals` (n,) the lengths of the intervals between samples, s; `mean_slopes`
    (n, k) the mean slope of the input in each interval.
    """
    a, b = intervals[0], intervals[0] + intervals[1]
    one = (mean_slopes[1] - mean_slopes[0]) / b
    two = ((mean_slopes[2] - mean_slopes[1]) / (intervals[1] + intervals[2]) - one) / (
        b + intervals[2]
    )
    rate = mean_slopes[0] - one * a + two * (a * b)
    return rate[None], 2 * (one - two * (a + b))[None], 6 * two[None]


def _particular(
    order: int, w: Array, u: Array, du: tuple[ArrayLike, ArrayLike, ArrayLike]
) -> Array:
    """Return the state of a low-pass filter on the particular solution for an input that is a cubic
    in time.

    The state is the output y and, for a filter of order 2, ẏ/w, along a new last axis. The equation
    is `ẏ = w(u − y)` for order 1 and `ÿ + √2 w ẏ + w² y = w² u` for order 2; its particular
    solution is a cubic, too.

    **Arguments:**

    - `order`: the order of the filter, 1 or 2.
    - `w`: the angular frequency of the filter, 2π times its cutoff, rad/s.
    - `u`: (…) the value of the input at the time of the result.
    - `du`: the first three time derivatives of the input at this time.
    """
    # The solution y is a power series in the operator x = (d/dt)/w, applied to u. It is 1/(1 + x) =
    # 1 − x + x² − x³ … for order 1, and 1/(1 + √2 x + x²) = 1 − √2 x + x² + 0 x³ … for order 2. For
    # a cubic u higher powers are zero.
    if order == 1:
        return (u - du[0] / w + du[1] / w**2 - du[2] / w**3)[..., None]
    y = u - _ROOT * du[0] / w + du[1] / w**2
    return jnp.stack([y, (du[0] - _ROOT * du[1] / w + du[2] / w**2) / w], axis=-1)


def _propagator(order: int, w: Array, duration: Array) -> Array:
    """Return the matrix (order, order) that maps a transient of a low-pass filter to the same
    transient after a given duration.

    The equation of the filter, with its input u and output y, is `ẏ = w(u − y)` for order 1 and
    `ÿ + √2 w ẏ + w² y = w² u` for order 2. The transient is the difference of the filter's state
    (y and, for order 2, ẏ/w) from the particular solution for its input.

    **Arguments:** `order` the order of the filter, 1 or 2; `w` its angular frequency, 2π times its
    cutoff, rad/s; `duration` the duration, s.
    """
    if order == 1:
        return jnp.exp(-w * duration)[None, None]
    a = w * duration / _ROOT
    c, s, e = jnp.cos(a), jnp.sin(a), jnp.exp(-a)
    return e * jnp.stack([jnp.stack([c + s, _ROOT * s]), jnp.stack([-_ROOT * s, c - s])])


def _filter_samples(
    start: Array,
    solution_at_begin: Array,
    solution_at_end: Array,
    propagator: Callable[[Array], Array],
    intervals: Array,
    is_hole: Array,
) -> Array:
    """Return the output (n + 1, k) of a low-pass filter at all samples, by a scan over n intervals.

    The state of the filter is the output y and, for order 2, ẏ/w, where w is the angular frequency
    of the filter. It is the sum of a transient, which decays, and of the particular solution for
    the input, which is a cubic in each interval between samples.

    **Arguments:**

    - `start`: (k, order) the state of the filter at the first sample, for k channels.
    - `solution_at_begin`, `solution_at_end`: (n, k, order) the particular solutions at the begin
      and at the end of each interval.
    - `propagator`: a function of the length of an interval, s, that returns the matrix
      (order, order) by which a transient decays.
    - `intervals`: (n,) the lengths of all intervals, s.
    - `is_hole`: (n,) true for an interval that is a hole in the log. At the end of such an
      interval the state is set to the particular solution at the begin of the next interval,
      without a transient.
    """

    def step(state: Array, row: tuple[Array, ...]) -> tuple[Array, Array]:
        own0, own1, following, h, hole = row
        after = own1 + (state - own0) @ propagator(h).T
        state = jnp.where(hole, following, after)
        return state, state[:, 0]

    following = jnp.concatenate([solution_at_begin[1:], solution_at_end[-1:]])
    _, rest = lax.scan(
        step, start, (solution_at_begin, solution_at_end, following, intervals, is_hole)
    )
    return jnp.concatenate([start[None, :, 0], rest])
