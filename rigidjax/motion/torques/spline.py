"""Interpolate a logged quantity as a smooth function of time: a cubic spline through evenly spaced
samples.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.lax import linalg
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks, _show
from rigidjax._types import NumbersLike, Scalar, ScalarLike, Vec3, Vector
from rigidjax.rotation.barrier import barrier
from rigidjax.rotation.linalg3 import cross, dot

Samples = Float[ArrayLike, "n *channels"] | Sequence[Any]


class Series(eqx.Module):
    """Interpolate evenly spaced samples by a cubic spline; it is constant beyond the ends.

    The spline costs little in a solver: the samples are evenly spaced, so that one division finds
    the two samples before and after a time. The derivative of the spline is continuous, so that a
    step of a solver may pass over a sample.

    **Arguments:** `times` (n,) s, evenly spaced, with an error of at most 1e-6 of a step plus the
    round-off of the times, which is large for times such as 1.7e9 s; `values` (n,) or (n, k). Both
    may be traced: a spline can be made under `jit`, `vmap` and `grad`. The third derivative of the
    spline does not jump at the second sample and at the last sample but one ("not a knot": de Boor,
    A Practical Guide to Splines, ch. IV).

    **Raises:** `ValueError` (`equinox` error under `jit`) for fewer than four samples, lengths that
    differ, NaN, uneven times.

    >>> Series([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 4.0, 9.0])(1.5)
    Array(2.25, dtype=float64)
    """

    start: Scalar
    step: Scalar
    values: Float[Array, "n *channels"]
    slopes: Float[Array, "n *channels"]

    __repr__ = _show.fields_as_text

    def __init__(self, times: Float[ArrayLike, " n"] | Sequence[Any], values: Samples):
        t, rows = (_numbers(value, name) for value, name in ((times, "times"), (values, "values")))
        if t.ndim != 1 or t.size < 4 or rows.shape[:1] != t.shape:
            words = f"got shapes {t.shape} and {rows.shape}"
            raise ValueError(f"Series: wanted at least four times and as many rows, {words}")
        t = _checks.require_finite(t, "Series: times")
        rows = _checks.require_finite(rows, "Series: values")
        step = (t[-1] - t[0]) / (t.size - 1)
        kind = np.dtype(getattr(times, "dtype", float))
        kind = kind if kind == jnp.bfloat16 else np.promote_types(kind, np.float16)
        slack = 1e-6 * step + 4 * float(jnp.finfo(kind).eps) * abs(t).max()
        uneven = ~((step > 0) & (abs(t[1:] - t[:-1] - step).max() <= slack))
        words = "Series: wanted evenly spaced, increasing times; resample, or use Linear"
        step = _checks.error_if(step, uneven, words)
        dtype = jnp.result_type(float)
        self.start, self.step = jnp.asarray(t[0], dtype), jnp.asarray(step, dtype)
        self.values = jnp.asarray(rows, dtype)
        self.slopes = _checks.require_finite(_slopes(self.values), "Series: slopes of the values")

    def __call__(self, t: ScalarLike) -> Any:
        """Return the value of the spline at the time `t`, s; its shape, () or (k,), is that of one
        sample.
        """
        n = self.values.shape[0]
        place = (jnp.asarray(t, self.start.dtype) - self.start) / self.step
        # `jnp.where` is used here, not `jnp.clip`: exactly at the first and the last sample the
        # derivative of `jnp.clip` is ½, which would halve the derivative of the spline.
        place = jnp.where(place < 0.0, 0.0, jnp.where(place > n - 1.0, n - 1.0, place))
        i = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, n - 2)
        s = place - i.astype(place.dtype)
        rows = self.values[i], self.values[i + 1], self.slopes[i], self.slopes[i + 1]
        # Without this optimisation barrier, XLA on CPU reads the table again for every number that
        # is computed from the rows.
        s, (left, right, out, into) = barrier((s, rows))
        # The cubic polynomial between two samples is determined by their values, `left` and
        # `right`, and by their slopes, `out` and `into`; it is written here as a Taylor series at
        # the left sample.
        bend = 3.0 * (right - left) - 2.0 * out - into
        twist = 2.0 * (left - right) + out + into
        return left + s * (out + s * (bend + s * twist))


def _numbers(value: NumbersLike, name: str) -> Any:
    """Return known numbers in float64 on the host, since the times of a log have more digits than
    float32; traced numbers in JAX's default precision.
    """
    if _checks.is_known(value):
        return _checks.host_array(value, f"Series: {name}")
    return _checks.numeric_array(value, f"Series: {name}").astype(jnp.result_type(float))


def _slopes(values: Float[Array, "n *channels"]) -> Float[Array, "n *channels"]:
    """Return the slopes of a cubic spline at evenly spaced samples, as the change for one step.

    With vᵢ the sample and sᵢ the slope at sample i, the slopes solve sᵢ₋₁ + 4 sᵢ + sᵢ₊₁ = 3 (vᵢ₊₁ −
    vᵢ₋₁): the second derivative is then continuous. The condition at the ends is "not a knot": the
    third derivative does not jump at the sample next to the end.
    """
    n = values.shape[0]
    v = values.reshape(n, -1)
    rise = v[1:] - v[:-1]
    ends = (2.5 * rise[:1] + 0.5 * rise[1:2], 2.5 * rise[-1:] + 0.5 * rise[-2:-1])
    sides = jnp.concatenate([ends[0], 3.0 * (rise[1:] + rise[:-1]), ends[1]])
    one, middle = np.ones(n, v.dtype), np.full(n, 4.0, v.dtype)
    below, above = one.copy(), one.copy()
    middle[[0, -1]], above[0], below[-1] = 1.0, 2.0, 2.0
    below[0], above[-1] = 0.0, 0.0
    below, middle, above = (jnp.asarray(band) for band in (below, middle, above))
    return linalg.tridiagonal_solve(below, middle, above, sides).reshape(values.shape)


class Wheel(eqx.Module):
    """Describe the momentum of a wheel whose speed was logged: `h = J w(t) a`, about an axis a that
    is fixed in the body.

    Pass a wheel to `Flywheel`, the torque of wheels inside a body: if the momentum of a wheel is
    known, a fit determines the absolute inertia of a body, not only ratios of moments of inertia.
    **Arguments:**

    - `inertia`: J, kg m², about the axis.
    - `axis`: a (3,), a unit vector, body frame.
    - `speed`: w, rad/s, relative to the body, a function of time such as `Series(times, speeds)`.
    - `delay`: s, the time by which the log is late: the value that it holds for the time t is the
      speed at t − delay. `None` means no delay.
    - `tilt`: (2,), the tangents of the two angles by which the axis is tilted towards two
      directions across it; a small tangent is the angle in rad. For an axis along x these
      directions are y and z, for y they are z and x, and for z they are x and y. `None` means no
      tilt.

    **Raises:** `ValueError` for an axis that is not a unit vector.

    >>> speed = Series([0.0, 1.0, 2.0, 3.0], [0.0, 10.0, 20.0, 30.0])
    >>> bool(abs(Wheel(2.0, [0.0, 0.0, 1.0], speed)(0.5)[2] - 10.0) < 1e-12)
    True
    """

    inertia: Scalar
    axis: Vec3
    speed: Any
    delay: Scalar | None
    tilt: Float[Array, "2"] | None

    __repr__ = _show.fields_as_text

    def __init__(
        self,
        inertia: ScalarLike,
        axis: Vector,
        speed: Callable[..., Any],
        *,
        delay: ScalarLike | None = None,
        tilt: NumbersLike | None = None,
    ):
        direction = _checks.array_of_shape(axis, (3,), "axis")
        x, y, z = _checks.array_module(direction).asarray(direction)
        got = f", got {np.asarray(direction)}" if _checks.is_known(direction) else ""
        off = ~(abs(x * x + y * y + z * z - 1) < 2e-6)
        direction = _checks.error_if(direction, off, f"axis: wanted a unit vector (3,){got}")
        _checks.require_function(speed, "speed", "of time to rad/s")
        dtype = jnp.result_type(float)
        self.inertia = _checks.finite_array(inertia, (), "inertia").astype(dtype)
        self.axis, self.speed = direction.astype(dtype), speed
        self.delay = (
            None if delay is None else _checks.finite_array(delay, (), "delay").astype(dtype)
        )
        self.tilt = None if tilt is None else _checks.finite_array(tilt, (2,), "tilt").astype(dtype)

    @property
    def direction(self) -> Vec3:
        """Return the direction of the wheel's axis after its tilt, a unit vector (3,), body
        frame.
        """
        if self.tilt is None:
            return self.axis
        # The wheel is tilted towards two directions across its axis. The body axis that is nearest
        # to the axis of the wheel determines these directions (see the argument `tilt`).
        next_one = jnp.roll(jnp.eye(3, dtype=self.axis.dtype), 1, axis=1)
        first = next_one[jnp.argmax(jnp.abs(self.axis))]
        first = first - dot(first, self.axis) * self.axis
        first = first / jnp.sqrt(dot(first, first))
        second = cross(self.axis, first)
        a, b = self.tilt[0], self.tilt[1]
        return (self.axis + a * first + b * second) / jnp.sqrt(1.0 + a * a + b * b)

    def __call__(self, t: ScalarLike) -> Vec3:
        when = t if self.delay is None else t + self.delay
        return self.inertia * self.direction * self.speed(when)
