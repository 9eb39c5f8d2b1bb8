"""Make windows of measured states, to identify driven machines by many short predictions.

A record of measured states is cut into windows, which are short parts of the record. From the
measured state at the start of each window the model predicts the states that follow. It uses the
recorded inputs but no further measurements (open-loop). The predictions are compared with the
measured states at every step.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from rigidjax import _checks
from rigidjax._types import HasSpin, Numbers
from rigidjax.identify.data.recording import Reading, Recording, unchecked_recording
from rigidjax.identify.data.reference_states import ReferenceStates
from rigidjax.identify.sensors.attitude import StateSensor
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.manifold import leaf_names, minus_small, parts_by_name
from rigidjax.motion.torques.inputs import delays_of


class Horizons(NamedTuple):
    """Hold the errors of open-loop predictions, as functions of the horizon.

    The horizon is the number of steps from the measured start of a window to the predicted state.
    Each field but `steps` is a dict of kind → array, where the kinds are the parts of the state:
    `x` (m), `v` (m/s), `q` (rad) and `omega` (rad/s).

    **Fields:**

    - `steps`: (L,) the horizons 1 to L.
    - `mean_absolute`: for each kind the mean absolute value (L,) of a component of the error.
    - `mean_norm`: for each kind the mean length (L,) of the error vector.
    - `rms`: for each kind the square root (L,) of the mean squared length of the error vector.

    >>> t = np.arange(6.0)
    >>> spin = rj.Spin(np.stack([t, 0 * t, 0 * t], 1))
    >>> held = rj.identify.windows(t, spin, length=2).held_horizons()
    >>> held.rms["omega"].tolist()   # the rate grows by 1 a step
    [1.0, 2.0]
    """

    steps: np.ndarray
    mean_absolute: dict[str, np.ndarray]
    mean_norm: dict[str, np.ndarray]
    rms: dict[str, np.ndarray]


def by_horizon(starts: HasSpin, errors: Float[Array, "windows steps n"]) -> Horizons:
    """Return the mean sizes of the error vectors over all windows, as functions of the horizon.

    The type of the `starts` tells of which parts an error vector consists.
    """
    by_kind = parts_by_name(jax.tree.map(lambda leaf: leaf[0], starts), errors)
    absolute = {k: np.asarray(jnp.mean(jnp.abs(v), (0, 2))) for k, v in by_kind.items()}
    squares = {k: jnp.sum(v * v, 2) for k, v in by_kind.items()}
    norm = {k: np.asarray(jnp.mean(jnp.sqrt(v), 0)) for k, v in squares.items()}
    rms = {k: np.asarray(jnp.sqrt(jnp.mean(v, 0))) for k, v in squares.items()}
    return Horizons(np.arange(1, errors.shape[1] + 1), absolute, norm, rms)


@jax.jit
def held_errors(starts: HasSpin, measured: HasSpin) -> Float[Array, "windows steps n"]:
    """Return the errors, start minus measured state, of a prediction of a constant state."""
    return jax.vmap(jax.vmap(minus_small, (None, 0)))(starts, measured)


class Windows(eqx.Module):
    """Hold the N windows of a record: parts of L steps, each of which begins at a measured state.

    The function `windows` cuts a record into windows; `Windows.join` joins the windows of several
    records.

    **Fields:**

    - `step`: s, the time between two samples.
    - `starts`: the states at the starts of the windows, with a leading axis (N,).
    - `wanted`: the L measured states that follow each start, with leading axes (N, L).
    - `inputs`: a dict of name → samples (N, before + L, *k), where each sample has the shape k. In
      step i after the start (i = 0, 1, …) an input without a delay has the sample of row
      `before + i`.
    - `before`: the number of samples of each input before the start of a window.
    - `noise`: a dict of kind → standard deviation of a component of the measured states, where the
      kinds are the fields of the state, such as `omega`; `None` if the noise is unknown.
    - `start_deviation`: a dict of kind → standard deviation of a component of the measured start;
      `None` if the measured starts are taken as exact.

    >>> cut = windows(np.arange(6.0), Spin(np.ones((6, 3))), length=2, stride=2)
    >>> cut.count, cut.length, cut.wanted.omega.shape
    (2, 2, (2, 2, 3))
    """

    step: float = eqx.field(static=True)
    starts: HasSpin
    wanted: HasSpin
    inputs: dict[str, Array]
    before: int = eqx.field(static=True, default=0)
    noise: dict[str, float] | None = eqx.field(static=True, default=None)
    start_deviation: dict[str, float] | None = eqx.field(static=True, default=None)

    @property
    def count(self) -> int:
        """Return the number of windows."""
        return int(self.starts.omega.shape[0])

    @property
    def length(self) -> int:
        """Return the number of steps of each window."""
        return int(self.wanted.omega.shape[1])

    @property
    def scales(self) -> Float[Array, " m"]:
        """Return the scale (m,) of each of the m components of an error of the state.

        The scale is the field `noise` if this is given. Otherwise each part of the state, such as
        the body rate, has its own scale: the root mean square error of a prediction that the state
        stays constant in each window.
        """
        if self.noise is not None:
            return jnp.asarray(np.repeat([self.noise[kind] for kind in leaf_names(self.starts)], 3))
        squares = np.mean(np.asarray(held_errors(self.starts, self.wanted)) ** 2, (0, 1))
        each = np.sqrt(np.mean(squares.reshape(-1, 3), 1))
        return jnp.asarray(np.repeat(np.where(each == 0, 1.0, each), 3))

    def records(self) -> Recording:
        """Return the N windows as N recordings, in one `Recording` whose arrays have a leading axis
        (N,).

        Each recording has one sensor, which reads the whole state. The first time of a recording is
        the start of the window. The reading at this time is masked, because predictions begin
        there.
        """
        kind, scales = type(self.starts), np.asarray(self.scales)
        steps = np.arange(self.length + 1, dtype=self.wanted.omega.dtype)
        t = np.broadcast_to(self.step * steps, (self.count, steps.size))
        first = [np.asarray(leaf)[:, None] for leaf in jax.tree.leaves(self.starts)]
        later = [np.asarray(leaf) for leaf in jax.tree.leaves(self.wanted)]
        rows = [np.concatenate(pair, axis=1) for pair in zip(first, later, strict=True)]
        mask = np.broadcast_to(steps > 0, t.shape)
        noise = jnp.asarray(np.broadcast_to(scales, (self.count, scales.size)).astype(t.dtype))
        unknown = self.noise is None
        sensor = StateSensor(kind, noise, unknown)  # pyright: ignore[reportCallIssue]
        values = jnp.asarray(np.concatenate(rows, axis=-1))
        reading = Reading(sensor, values, jnp.asarray(mask))
        # A window of L steps has L + 1 times, but L input samples from its start on. A recording
        # needs a sample for each time: repeat the last sample, which is not used at the last time.
        inputs = {name: np.asarray(rows) for name, rows in self.inputs.items()}
        inputs = {
            name: jnp.asarray(np.concatenate([rows, rows[:, -1:]], axis=1))
            for name, rows in inputs.items()
        }
        return unchecked_recording(jnp.asarray(t), (reading,), inputs)

    def held_horizons(self) -> Horizons:
        """Return the errors of a prediction that the state stays constant in each window.

        A model is of use only if its predictions have smaller errors than this prediction, which
        needs no model.
        """
        return by_horizon(self.starts, held_errors(self.starts, self.wanted))

    @staticmethod
    def join(*parts: "Windows") -> "Windows":
        """Join the windows of several records, all of one step and one length, in one `Windows`.

        **Raises:** `ValueError` without an argument, or if the steps, lengths, types of state,
        inputs, numbers of samples before the start, or deviations of the arguments differ.
        """
        if not parts:
            raise ValueError("Windows.join: wanted at least one Windows")
        kinds = {
            (
                p.step,
                p.length,
                tuple(sorted(p.inputs)),
                type(p.starts),
                p.before,
                str(p.noise),
                str(p.start_deviation),
            )
            for p in parts
        }
        if len(kinds) > 1:
            got = [
                f"{k[0]:g} s, {k[1]}, {k[3].__name__}, {k[2]}, before={k[4]}, noise={k[5]}, "
                f"starts={k[6]}"
                for k in kinds
            ]
            raise ValueError(
                "Windows.join: wanted one step, length, kind of state and the same inputs, got "
                + "; ".join(got)
            )
        if len(parts) == 1:
            return parts[0]
        return jax.tree.map(lambda *a: jnp.concatenate(a), *parts)


def windows(
    t: Float[ArrayLike, " times"] | Numbers,
    states: PyTree,
    inputs: Mapping[str, Any] | None = None,
    *,
    length: int,
    stride: int = 1,
    before: int = 0,
    noise: Mapping[str, float] | None = None,
    starts: Mapping[str, float] | None = None,
) -> Windows:
    """Return the windows of `length` steps of a record of measured states.

    A window starts at every `stride`-th sample of the record.

    **Arguments:**

    - `t`: (T,) evenly spaced times, s. Some samples may be missing. A window with its `before`
      input samples never reaches across a missing sample.
    - `states`: the measured states with a leading axis (T,), in one `Spin` (body rates), `Attitude`
      (attitudes and body rates) or `Rigid` (positions and velocities, too).
    - `inputs`: a dict of name → samples (T, *k), for each `rigidjax.torques.Input` of a torque.
      Each sample is held until the next one.
    - `length`: the number of steps of a window.
    - `stride`: the number of samples from one start to the next.
    - `before`: the number of input samples kept before each start, for a torque that delays inputs
      (`rigidjax.torques.Delayed`) or has states of its own, such as `Lagged`. The states of the
      torque follow the inputs up to the start, while the body is held at the start.
    - `noise`: a dict of kind → standard deviation of a component of the measured states, where the
      kinds are the fields of the state, such as `q` and `omega`; `None` if the noise is unknown.
    - `starts`: a dict of kind → standard deviation of a component of the measured start of a
      window, infinite for a start that is free. `None` takes the measured starts as exact. If
      `starts` is given, `noise` must be given, too.

    **Raises:** `ValueError` for shapes that do not agree, NaN, uneven times, or a record without a
    window of this length; `TypeError` for states of another type.

    >>> t = np.arange(6.0)
    >>> windows(t, Spin(np.ones((6, 3))), length=2, stride=2).count
    2
    """
    times = _checks.host_array(t, "t")
    length, stride = _checks.integer(length, "length", 1), _checks.integer(stride, "stride", 1)
    before = _checks.integer(before, "before", 0)
    _checks.require_instance(states, (Spin, Attitude, Rigid), "states")
    if times.ndim != 1 or times.size < length + 1:
        raise ValueError(
            f"t: wanted at least length + 1 = {length + 1} times (T,), got shape {times.shape}"
        )
    if not isinstance(inputs, Mapping | None):
        raise TypeError(
            "inputs: wanted a mapping from names to arrays, such as {'u': array}, got "
            f"{type(inputs).__name__}"
        )
    inputs = {k: _checks.without_mask(v, f"inputs[{k!r}]") for k, v in (inputs or {}).items()}
    step, broken = _sampling(times, states, inputs)
    begin = np.arange(before, times.size - length, stride)
    begin = begin[broken[begin + length] == broken[begin - before]]
    if not begin.size:
        longest = int(np.bincount(broken).max()) - 1
        raise ValueError(
            f"windows: no stretch of {before + length} steps (before + length) without a gap; the "
            f"longest has {longest}"
        )
    rows_of = begin[:, None] + np.arange(-before, length)
    follow = begin[:, None] + 1 + np.arange(length)
    kind = jnp.result_type(float)
    arrays = jax.tree.map(lambda a: np.asarray(a, kind), states)
    samples = {k: np.asarray(v, kind) for k, v in inputs.items()}
    kinds = leaf_names(states)
    if noise is not None:
        noise = _by_part(noise, kinds, "noise", _checks.positive_float)
    if starts is not None:

        def deviation(value: object, name: str) -> float:
            number = _checks.python_float(value, name)
            if not number > 0:
                raise ValueError(
                    f"{name}: wanted a positive deviation, or infinity for a start that is free, "
                    f"got {number}"
                )
            return number

        if noise is None:
            raise ValueError(
                "starts: deviations of the starts need the noise of the readings: give noise={…}, "
                "too"
            )
        starts = _by_part(starts, kinds, "starts", deviation)
    return Windows(
        round(step, 12),
        jax.tree.map(lambda a: jnp.asarray(a[begin]), arrays),
        jax.tree.map(lambda a: jnp.asarray(a[follow]), arrays),
        {k: jnp.asarray(v[rows_of]) for k, v in samples.items()},
        before,
        noise,
        starts,
    )


def _by_part(
    numbers: object, kinds: tuple[str, ...], name: str, check: Callable[[Any, str], float]
) -> dict[str, float]:
    """Return the user's numbers for the `kinds` of a state as floats, after checks.

    `check` raises an error for a number, whose name it gets.
    """
    by_kind = _checks.require_instance(numbers, Mapping, name, requirement="numbers by kind")
    if set(by_kind) != set(kinds):
        raise ValueError(f"{name}: wanted a number for each of {kinds}, got {tuple(by_kind)}")
    return {kind: float(check(by_kind[kind], f"{name}[{kind!r}]")) for kind in kinds}


class Sampling(NamedTuple):
    """Hold the step and the gaps of a record."""

    # The median interval between successive times, s.
    step: float
    # How many gaps come before each time.
    broken: Int[np.ndarray, " times"]


def _sampling(times: np.ndarray, states: PyTree, inputs: Mapping[str, Any]) -> Sampling:
    """Return the step and the gaps of a record, after a check of its rows.

    States and inputs must be finite, quaternions of length 1 to within 0.01, and the intervals
    within a thousandth of their median, or gaps of more than 1.5 times the median.
    """
    rows = dict(zip(leaf_names(states), jax.tree.leaves(states), strict=True))
    rows |= {f"inputs[{k!r}]": v for k, v in inputs.items()}
    for name, value in rows.items():
        if np.shape(value)[:1] != times.shape:
            raise ValueError(
                f"{name}: wanted a row for each of {times.size} times, got shape {np.shape(value)}"
            )
        bad = ~np.isfinite(np.asarray(value, float)).reshape(times.size, -1).all(1)
        if bad.any():
            raise ValueError(
                f"{name}: NaN or infinity in row {int(np.argmax(bad))}; leave such rows out: a "
                "window does not go across the gap"
            )
    if isinstance(states, Attitude | Rigid):
        off = np.abs(np.linalg.norm(np.asarray(states.q, float), axis=-1) - 1.0)
        row = int(np.argmax(off))
        if off[row] > 0.01:
            raise ValueError(
                f"q: wanted quaternions of length 1, scalar first, got another in row {row}: "
                f"{np.asarray(states.q)[row]}"
            )
    gaps = np.diff(times)
    h = float(np.median(gaps))
    even = np.abs(gaps - h) <= 1e-3 * h
    allowed = even | (gaps > 1.5 * h)
    if not allowed.all():
        i = int(np.argmin(allowed))
        raise ValueError(
            f"t: wanted even times with or without gaps, got {gaps[i]:.6g} s after row {i} where "
            f"others are {h:.6g} s apart; resample first"
        )
    return Sampling(h, np.concatenate([[0], np.cumsum(~even)]))


def require_windows(windows: PyTree) -> None:
    """Raise an error unless `windows` is a `Windows` whose states are finite."""
    wanted = "what identify.windows returns"
    _checks.require_instance(windows, Windows, "windows", requirement=wanted)
    for name, axes in (("starts", 2), ("wanted", 3)):
        for leaf in jax.tree.leaves(getattr(windows, name)):
            if leaf.ndim != axes or not leaf.shape[0]:
                raise ValueError(
                    f"windows: wanted arrays with one row for each window in {name}, got an "
                    f"array of shape {leaf.shape}"
                )
            _checks.require_finite(leaf, f"windows: {name}")


def outside_delays(torque: PyTree, history: float, length: float) -> list[str]:
    """Describe each delay that makes a torque read an input where a window has no samples.

    The inputs are known for the time `history` before a window; both times are in s.
    """
    out = []
    for name, delay in delays_of(torque):
        least, most = float(np.min(np.asarray(delay))), float(np.max(np.asarray(delay)))
        if -least > length:
            out.append(
                f"inputs[{name!r}]: a delay of {least:.6g} s reaches beyond the end of windows "
                f"of {length:.6g} s; is it in seconds?"
            )
        elif most > history:
            out.append(
                f"inputs[{name!r}]: a delay of {most:.6g} s, and inputs that are known "
                f"{history:.6g} s before a window: cut them with windows(…, before=k)"
            )
    return out


class WindowStarts(NamedTuple):
    """Hold the starts of windows."""

    # The measured starts; a fit finds a true start as a change of the measured one.
    reference: ReferenceStates
    # The unit of each parameter of a start over the standard deviation of the measured start;
    # `None` if the measured starts are taken as exact.
    weights: Float[Array, "windows m"] | None
    # The index of the stretch of each window.
    stretches: Int[Array, " windows"]


def window_starts(windows: Windows, stretches: int) -> WindowStarts:
    """Return the starts of windows, and the stretches to which the windows belong."""
    count, scales = windows.count, np.asarray(windows.scales)
    dtype = windows.wanted.omega.dtype
    units = jnp.asarray(np.broadcast_to(scales, (count, scales.size)).astype(dtype))
    rate = jnp.full(count, float(scales[-1]), dtype)
    clusters = jnp.asarray(np.arange(count) * min(stretches, count) // count, jnp.int32)
    weight = None
    if windows.start_deviation is not None:
        wide = np.repeat([windows.start_deviation[kind] for kind in leaf_names(windows.starts)], 3)
        weight = jnp.asarray(np.broadcast_to(scales / wide, units.shape).astype(dtype))
    return WindowStarts(ReferenceStates(windows.starts, rate, units), weight, clusters)
