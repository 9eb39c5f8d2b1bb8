"""Evaluate tables of numbers over time: straight lines between rows, or constant pieces."""

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from rigidjax import _checks, _show
from rigidjax._types import HasSpin, NumbersLike, Scalar, ScalarLike, Vec3
from rigidjax.motion.torques.base import AbstractTorque

Times = Float[ArrayLike, " times"] | Sequence[Any]
Rows = Float[ArrayLike, "rows 3"] | Sequence[Any]


class _Table(eqx.Module):
    """Hold a table of a quantity over time, s."""

    times: Float[Array, " n"]
    values: Float[Array, "n *k"]

    __repr__ = _show.fields_as_text

    def __init__(self, times: Times, values: Float[ArrayLike, "rows *k"] | Sequence[Any]):
        self.times, self.values = _checked_table("times", times, "values", values)

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Return the times of the rows, s, at each of which the quantity jumps or has a kink."""
        return self.times


class Linear(_Table):
    """Interpolate a function of time, t → (*k), by straight lines between rows; it is constant
    beyond the ends.

    **Arguments:** `times` (n,) s, increasing; `values` (n, *k), any number of channels: (n, 3) for
    a vector in the torques `InSpace`, `Flywheel`, `MagneticDipole` and `GravityGradient`, (n, R)
    for the speeds of R rotors in `Rotors`, (n, 3, 3) for the inertia in `ChangingInertia`. Both may
    be traced. The derivative at a row is the slope of the line after this row. `Series` is a cubic
    spline through evenly spaced rows, which has no kinks.

    **Raises:** `ValueError` for fewer than two rows, numbers of times and rows that differ, times
    that do not increase, or NaN.

    >>> Linear([0.0, 2.0], [[0.0, 0, 0], [0.0, 0, 4]])(1.0)
    Array([0., 0., 2.], dtype=float64)
    """

    def __call__(self, t: ScalarLike) -> Array:
        """Return the value, interpolated between the rows of `values`, at the time `t`, s; its
        shape (*k) is that of one row.
        """
        t = jnp.asarray(t, self.times.dtype)
        return _interpolate(self.times, self.values, jnp.clip(t, self.times[0], self.times[-1]))


class Held(_Table):
    """Hold each sample of a function of time, t → (*k), until the next sample (zero-order hold).

    **Arguments:** `times` (n,) s, increasing; `values` (n, *k), where row i holds from time i until
    time i + 1, the first row also before its time, and the last row for all later times. Both may
    be traced. The value jumps at `times`. So does a torque that reads it: its attribute
    `jump_times` contains these times, and adaptive steps end at them. For fixed steps give the
    samples to `rigidjax.batch.rollout` as `inputs`. **Raises:** as `Linear`.

    >>> Held([0.0, 1.0, 2.0], [[5.0], [6.0], [7.0]])(1.5)
    Array([6.], dtype=float64)
    """

    def __call__(self, t: ScalarLike) -> Array:
        """Return the value at the time `t`, s: the row of `values` that is held at this time, of
        the shape (*k).
        """
        i = _row_at(self.times, jnp.asarray(t, self.times.dtype))
        return self.values[jnp.clip(i, 0, self.times.shape[0] - 1)]


class Tabulated(AbstractTorque):
    """Interpolate a torque from a table by straight lines between rows; it is zero before the first
    row and after the last.

    **Arguments:** `times` (n,) s, increasing; `torques` (n, 3) N m, body frame. For a torque in the
    world frame take `InSpace(Linear(times, torques))`, for constant pieces `Pulses`. **Raises:** as
    `Linear`.

    A solver that steps over a kink loses its order, and a step over a whole pulse misses the pulse:
    `simulate` therefore ends a step at each of the `jump_times`.

    >>> Tabulated([0.0, 2.0], [[0.0, 0, 0], [0.0, 0, 4]]).jump_times
    Array([0., 2.], dtype=float64)
    """

    feels: ClassVar[type] = HasSpin
    rate_free: ClassVar[bool] = True
    times: Float[Array, " n"]
    torques: Float[Array, "n 3"]

    def __init__(self, times: Times, torques: Rows):
        self.times, self.torques = _checked_table("times", times, "torques", torques, beyond=0)

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Return the times (n,) of the rows of the table, s, at each of which the torque jumps or
        has a kink.
        """
        return self.times

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        t = jnp.asarray(t, self.times.dtype)
        inside = (t >= self.times[0]) & (t <= self.times[-1])
        value = _interpolate(self.times, self.torques, t)
        return jnp.where(inside, value, jnp.zeros_like(value))


class Pulses(AbstractTorque):
    """Apply a torque in constant pieces, such as thruster firings; it is zero before the first edge
    and after the last.

    **Arguments:** `edges` (n + 1,) s, increasing; `torques` (n, 3) N m, body frame: row i acts from
    edge i until edge i + 1. One pulse: `Pulses([1.0, 1.5], [[0.0, 0.0, 3.0]])`. **Raises:**
    `ValueError` for another number of edges, edges that do not increase, NaN.

    The value of the torque at one time has no derivative with respect to the edges, but a motion
    under the torque has this derivative if the solver ends steps at `jump_times`, as `simulate`
    does. The derivative of `impulse` is exact.

    >>> Pulses([1.0, 1.5], [[0.0, 0.0, 3.0]]).impulse
    Array([0. , 0. , 1.5], dtype=float64)
    """

    feels: ClassVar[type] = HasSpin
    rate_free: ClassVar[bool] = True
    edges: Float[Array, " edges"]
    torques: Float[Array, "n 3"]

    def __init__(self, edges: Times, torques: Rows):
        self.edges, self.torques = _checked_table("edges", edges, "torques", torques, beyond=1)

    @property
    def jump_times(self) -> Float[Array, " edges"]:
        """Return the times (n + 1,), s, at which this torque of n pulses jumps: the edges of the
        pulses.
        """
        return self.edges

    @property
    def impulse(self) -> Vec3:
        """Return the angular impulse of all pulses together, the integral ∫ τ dt of the torque τ
        over time, (3,), N m s, body frame.
        """
        return jnp.sum((self.edges[1:] - self.edges[:-1])[:, None] * self.torques, axis=0)

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        t = jnp.asarray(t, self.edges.dtype)
        inside = (t >= self.edges[0]) & (t <= self.edges[-1])
        value = self.torques[jnp.clip(_row_at(self.edges, t), 0, self.torques.shape[0] - 1)]
        return jnp.where(inside, value, jnp.zeros_like(value))


def _row_at(times: Float[Array, " n"], t: Scalar) -> Int[Array, ""]:
    """Return the index of the last row whose time is not after t, or −1 before the first row."""
    # The row is found by a comparison of t with the times of all rows in a short table, since XLA
    # compiles this comparison into the one kernel of the solver; a binary search would be a loop of
    # its own.
    method = "compare_all" if times.shape[0] <= 128 else "scan"
    return jnp.searchsorted(times, t, side="right", method=method) - 1


def _interpolate(times: Float[Array, " n"], rows: Float[Array, "n *k"], t: Scalar) -> Array:
    """Return the value at one time on the straight line through the rows before and after it; the
    first and the last line are continued.
    """
    i = jnp.clip(_row_at(times, t), 0, times.shape[0] - 2)
    part = (t - times[i]) / (times[i + 1] - times[i])
    return rows[i] + part * (rows[i + 1] - rows[i])


def _checked_table(
    times_name: str,
    times: NumbersLike,
    rows_name: str,
    values: NumbersLike,
    beyond: int | None = None,
) -> tuple[Float[Array, " times"], Float[Array, "rows *k"]]:
    """Return increasing times and a quantity as arrays of finite numbers of one dtype.

    With `beyond`, the number of times less that of rows, each row has the shape (3,): 0 for a row
    at each time, 1 for a row between two times. `None` also means a row at each time, of any shape.
    """
    edges = _checks.array_of_rows(times, (), times_name)
    rows = _checks.numeric_array(values, rows_name)
    count = edges.shape[0]
    if count < 2:
        raise ValueError(f"{times_name}: wanted at least 2 times, shape (n,), got {edges.shape}")
    if beyond is None and rows.shape[:1] != edges.shape:
        raise ValueError(f"{rows_name}: wanted a row for each of {count} times, got {rows.shape}")
    if beyond is not None and rows.shape != (count - beyond, 3):
        lines = "n times go with n rows (constant pieces: Pulses)"
        pieces = "n constant pieces have n + 1 edges (Tabulated draws lines between n rows)"
        advice = pieces if beyond else lines
        words = f"{rows_name}: wanted {count - beyond} rows of 3"
        raise ValueError(f"{words}, got shape {rows.shape}; {advice}")
    edges, rows = _checks.require_finite(edges, times_name), _checks.require_finite(rows, rows_name)
    ordered = _checks.array_module(edges).asarray(edges)
    falling = ordered[1:] <= ordered[:-1]
    where = ""
    if _checks.is_known(falling) and falling.any():
        where = f"; {times_name}[{int(np.argmax(falling)) + 1}] is not above the one before"
    edges = _checks.error_if(
        edges, falling.any(), f"{times_name}: wanted increasing times, s{where}"
    )
    dtype = jnp.result_type(edges, rows)
    return edges.astype(dtype), rows.astype(dtype)
