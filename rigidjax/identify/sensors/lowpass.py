"""Apply the low-pass filter that readings passed before they were logged."""

import math
from functools import partial
from types import NoneType

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float

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
            # The cubes of all numbers must be finite in float32, too.
            times, size = np.asarray(t, float), np.abs(np.asarray(values, float))
            if not size.max(initial=0.0) <= _LARGEST:
                raise ValueError(
                    f"values: wanted finite numbers up to {_LARGEST:g}, got NaN or a larger one"
                )
            if not np.abs(times).max(initial=0.0) <= _LARGEST:
                raise ValueError(
                    f"t: wanted finite times up to {_LARGEST:g} s, got NaN or a larger one"
                )
            if not (later := np.diff(times) > 1 / _LARGEST).all():
                index = int(np.argmin(later)) + 1
                raise ValueError(
                    f"t: wanted increasing times; t[{index}] is not above t[{index - 1}]"
                )
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

        # The state of the filter is the output and, for order 2, ẏ/w: a transient, which decays,
        # and the particular solution for the input. After a hole it starts without a transient.
        def step(state: Array, row: tuple[Array, ...]) -> tuple[Array, Array]:
            own0, own1, following, h, hole = row
            after = own1 + (state - own0) @ _propagator(self.order, w, h).T
            state = jnp.where(hole, following, after)
            return state, state[:, 0]

        following = jnp.concatenate([y0[1:], y1[-1:]])
        _, rest = lax.scan(step, begin, (y0, y1, following, intervals, is_hole))
        return jnp.concatenate([begin[None, :, 0], rest])


def lowpass_of(lowpass: object) -> LowPass | None:
    """Return `lowpass` if it is a `LowPass` or `None`."""
    wanted = "LowPass(cutoff in Hz) or None"
    return _checks.require_instance(lowpass, (LowPass, NoneType), "lowpass", requirement=wanted)


def _end_slopes(
    intervals: Float[Array, " n"],
    changes: Float[Array, "n k"],
    is_hole: Bool[Array, " n"],
    is_padding: Bool[Array, " n"],
) -> tuple[Float[Array, "n k"], Float[Array, "n k"]]:
    """Return the time derivatives of a sampled input at the begin and at the end of each interval.

    They are slopes of the parabola through three samples or, at a sample next to a hole, of the
    line through the two samples of the interval.
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
    """Return the first three derivatives of the cubic at the first of four samples."""
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
    """Return the state of the filter on the particular solution for a cubic input u with
    derivatives du.

    The state is the output y and, for order 2, ẏ/w along a new last axis; the solution is a cubic,
    too.
    """
    # The solution y is a power series in the operator x = (d/dt)/w, applied to u. It is 1/(1 + x) =
    # 1 − x + x² − x³ … for order 1, and 1/(1 + √2 x + x²) = 1 − √2 x + x² + 0 x³ … for order 2. For
    # a cubic u higher powers are zero.
    if order == 1:
        return (u - du[0] / w + du[1] / w**2 - du[2] / w**3)[..., None]
    y = u - _ROOT * du[0] / w + du[1] / w**2
    return jnp.stack([y, (du[0] - _ROOT * du[1] / w + du[2] / w**2) / w], axis=-1)


def _propagator(order: int, w: Array, duration: Array) -> Float[Array, "order order"]:
    """Return the matrix that maps a transient of the filter to that after a `duration`, s."""
    if order == 1:
        return jnp.exp(-w * duration)[None, None]
    a = w * duration / _ROOT
    c, s, e = jnp.cos(a), jnp.sin(a), jnp.exp(-a)
    return e * jnp.stack([jnp.stack([c + s, _ROOT * s]), jnp.stack([-_ROOT * s, c - s])])
