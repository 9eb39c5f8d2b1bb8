"""Many short open-loop runs from measured starts, to identify driven machines.

A record of measured states is cut into windows. The model runs open-loop from the start of each,
driven by the recorded inputs, and is compared with the measured states at every step.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from rigidjax import _checks
from rigidjax.identify.data.recording import Reading, Recording, recording_of
from rigidjax.identify.data.reference_states import ReferenceStates
from rigidjax.identify.sensors.states import StateSensor
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.manifold import minus_small, names, parts
from rigidjax.motion.torques.inputs import delays_of


class Horizons(NamedTuple):
    """Open-loop errors by horizon, of each kind (`x` m, `v` m/s, `q` rad, `omega` rad/s).

    **Fields:** `steps` (L,) how many steps ahead; by kind, each (L,): `mean_absolute` of a
    component, `mean_norm` the mean length of the vector, `rms` the root of its mean square.

    >>> t = np.arange(6.0)
    >>> spin = rj.Spin(np.stack([t, 0 * t, 0 * t], 1))
    >>> rj.identify.windows(t, spin, length=2).held().rms["omega"].tolist()  # it grows by 1 a step
    [1.0, 2.0]
    """

    steps: Any
    mean_absolute: dict[str, Any]
    mean_norm: dict[str, Any]
    rms: dict[str, Any]


def by_horizon(starts: Any, found: Float[Array, "windows steps n"]) -> Horizons:
    """The means over windows of errors, as changes from the measured states."""
    by_kind = parts(jax.tree.map(lambda leaf: leaf[0], starts), found)
    absolute = {k: np.asarray(jnp.mean(jnp.abs(v), (0, 2))) for k, v in by_kind.items()}
    squares = {k: jnp.sum(v * v, 2) for k, v in by_kind.items()}
    norm = {k: np.asarray(jnp.mean(jnp.sqrt(v), 0)) for k, v in squares.items()}
    rms = {k: np.asarray(jnp.sqrt(jnp.mean(v, 0))) for k, v in squares.items()}
    return Horizons(np.arange(1, found.shape[1] + 1), absolute, norm, rms)


@jax.jit
def held_errors(starts: Any, wanted: Any) -> Float[Array, "windows steps n"]:
    """The errors of a prediction that holds the state at the start."""
    return jax.vmap(jax.vmap(minus_small, (None, 0)))(starts, wanted)


class Windows(eqx.Module):
    """Short runs of one length. `windows` makes them; `Windows.joined` joins several.

    **Fields:** `step` s between samples; `starts` N states; `wanted` the L states that follow each
    start, with leading axes (N, L); `inputs` by name (N, before + L, *k), row before + i held
    through step i, if there is no delay; `before` the number of rows before the start; `noise` and
    `start_deviation` by kind, as `windows` has them.

    >>> found = windows(np.arange(6.0), Spin(np.ones((6, 3))), length=2, stride=2)
    >>> found.count, found.length, found.wanted.omega.shape
    (2, 2, (2, 2, 3))
    """

    step: float = eqx.field(static=True)
    starts: Any
    wanted: Any
    inputs: dict[str, Array]
    before: int = eqx.field(static=True, default=0)
    noise: dict[str, float] | None = eqx.field(static=True, default=None)
    start_deviation: dict[str, float] | None = eqx.field(static=True, default=None)

    @property
    def count(self) -> int:
        """The number of windows."""
        return int(self.starts.omega.shape[0])

    @property
    def length(self) -> int:
        """The number of steps of each."""
        return int(self.wanted.omega.shape[1])

    @property
    def scales(self) -> Float[Array, " m"]:
        """The unit of each number of an error: `noise`, else the rms of a prediction that holds
        the state at the start.
        """
        if self.noise is not None:
            return jnp.asarray(np.repeat([self.noise[kind] for kind in names(self.starts)], 3))
        squares = np.mean(np.asarray(held_errors(self.starts, self.wanted)) ** 2, (0, 1))
        each = np.sqrt(np.mean(squares.reshape(-1, 3), 1))
        return jnp.asarray(np.repeat(np.where(each == 0, 1.0, each), 3))

    def records(self) -> Recording:
        """Return the windows as recordings, with a leading axis, that read the whole state.

        The first time of each is its start, which is no reading.
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
        # Nothing is read of the input at the last time.
        inputs = {name: np.asarray(rows) for name, rows in self.inputs.items()}
        inputs = {
            name: jnp.asarray(np.concatenate([rows, rows[:, -1:]], axis=1))
            for name, rows in inputs.items()
        }
        return recording_of(jnp.asarray(t), (reading,), inputs)

    def held(self) -> Horizons:
        """The errors of a prediction that holds the state at the start: what a model must beat.

        `mean_absolute` and `rms` after so many `steps`.
        """
        return by_horizon(self.starts, held_errors(self.starts, self.wanted))

    @staticmethod
    def joined(*parts: "Windows") -> "Windows":
        """The windows of several records, of one step and one length.

        **Raises:** `ValueError` for none, or for steps, lengths or inputs that differ.
        """
        if not parts:
            raise ValueError("Windows.joined: wanted at least one Windows")
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
                "Windows.joined: wanted one step, length, kind of state and the same inputs, got "
                + "; ".join(got)
            )
        if len(parts) == 1:
            return parts[0]
        return jax.tree.map(lambda *a: jnp.concatenate(a), *parts)


def windows(
    t: Float[ArrayLike, " times"] | Any,
    states: Any,
    inputs: Mapping[str, Any] | None = None,
    *,
    length: int,
    stride: int = 1,
    before: int = 0,
    noise: Mapping[str, float] | None = None,
    starts: Mapping[str, float] | None = None,
) -> Windows:
    """Cut a record of measured states into windows of `length` steps, one every `stride` samples.

    **Arguments:** `t` (T,) s, evenly spaced but for gaps; `states` a `Spin`, `Attitude` or `Rigid`
    with a leading axis (T,); `inputs` by name (T, *k), each held until the next sample, for the
    `rigidjax.torques.Input`s of a torque; `before` the number of input samples kept before each
    start, for a torque that delays them (`rigidjax.torques.Delayed`) or has states of its own, such
    as `Lagged`: these follow the inputs up to the start, with the body held there. No window, with
    the samples before it, goes across a gap. **Raises:** `ValueError` for shapes that do not agree,
    NaN, uneven times, a record without a window of this length; `TypeError` for other states.

    >>> t = np.arange(6.0)
    >>> windows(t, Spin(np.ones((6, 3))), length=2, stride=2).count
    2
    """
    times = _checks.on_host(t, "t")
    length, stride = _checks.whole(length, "length", 1), _checks.whole(stride, "stride", 1)
    before = _checks.whole(before, "before", 0)
    _checks.instance(states, (Spin, Attitude, Rigid), "states")
    if times.ndim != 1 or times.size < length + 1:
        raise ValueError(
            f"t: wanted at least length + 1 = {length + 1} times (T,), got shape {times.shape}"
        )
    if not isinstance(inputs, Mapping | None):
        raise TypeError(f"inputs: wanted arrays by name, got {type(inputs).__name__}")
    inputs = {k: _checks.without_mask(v, f"inputs[{k!r}]") for k, v in (inputs or {}).items()}
    _require_rows(times, states, inputs)
    h, even = _step_of(times)
    broken = np.concatenate([[0], np.cumsum(~even)])
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
    kinds = names(states)
    if noise is not None:
        noise = _by_kind(noise, kinds, "noise", _checks.positive)
    if starts is not None:
        if noise is None:
            raise ValueError(
                "starts: deviations of the starts need the noise of the readings: give noise={…}, "
                "too"
            )
        starts = _by_kind(starts, kinds, "starts", _deviation)
    return Windows(
        round(h, 12),
        jax.tree.map(lambda a: jnp.asarray(a[begin]), arrays),
        jax.tree.map(lambda a: jnp.asarray(a[follow]), arrays),
        {k: jnp.asarray(v[rows_of]) for k, v in samples.items()},
        before,
        noise,
        starts,
    )


def _by_kind(
    numbers: Any, kinds: tuple[str, ...], name: str, check: Callable[[Any, str], float]
) -> dict[str, float]:
    """Return the checked numbers of a mapping with these keys."""
    _checks.instance(numbers, Mapping, name, wanted="numbers by kind")
    if set(numbers) != set(kinds):
        raise ValueError(f"{name}: wanted a number for each of {kinds}, got {tuple(numbers)}")
    return {kind: float(check(numbers[kind], f"{name}[{kind!r}]")) for kind in kinds}


def _deviation(value: Any, name: str) -> float:
    number = _checks.number(value, name)
    if not number > 0:
        raise ValueError(
            f"{name}: wanted a positive deviation, or infinity for a start that is free, got "
            f"{number}"
        )
    return number


def _require_rows(times: np.ndarray, states: Any, inputs: Mapping[str, Any]) -> None:
    """Raise `ValueError` for states and inputs that are not a row of numbers for each time."""
    rows = dict(zip(names(states), jax.tree.leaves(states), strict=True))
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


def _step_of(times: np.ndarray) -> tuple[float, np.ndarray]:
    """The time between samples, s, and the samples without a gap after them."""
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
    return h, even


def require_windows(windows: Any) -> None:
    """Raise `TypeError` or `ValueError` unless these are several windows of finite numbers."""
    _checks.instance(windows, Windows, "windows", wanted="what identify.windows returns")
    for name, wanted in (("starts", 2), ("wanted", 3)):
        for leaf in jax.tree.leaves(getattr(windows, name)):
            if leaf.ndim != wanted or not leaf.shape[0]:
                raise ValueError(
                    f"windows: wanted a row for each of N windows in {name}, got {leaf.shape}"
                )
            _checks.finite(leaf, f"windows: {name}")


def mistakes_of_delays(law: Any, known: float, length: float) -> list[str]:
    """Return the mistake of each delay that reads an input beyond those of a window, in words.

    **Arguments:** `known` s, the time before a window from which its inputs are known; `length` s
    of a window.
    """
    out = []
    for name, delay in delays_of(law):
        least, most = float(np.min(np.asarray(delay))), float(np.max(np.asarray(delay)))
        if -least > length:
            out.append(
                f"inputs[{name!r}]: a delay of {least:.6g} s reaches beyond the end of windows "
                f"of {length:.6g} s; is it in seconds?"
            )
        elif most > known:
            out.append(
                f"inputs[{name!r}]: a delay of {most:.6g} s, and inputs that are known "
                f"{known:.6g} s before a window: cut them with windows(…, before=k)"
            )
    return out


def starts_of_windows(
    windows: Windows, stretches: int
) -> tuple[ReferenceStates, Float[Array, "windows m"] | None, Int[Array, " windows"]]:
    """Return the starts of windows as a reference, their weights, and the stretch of each window.

    The weight is one over the deviation of a start, in steps of order one; `None` for known starts.
    """
    count, scales = windows.count, np.asarray(windows.scales)
    dtype = windows.wanted.omega.dtype
    units = jnp.asarray(np.broadcast_to(scales, (count, scales.size)).astype(dtype))
    rate = jnp.full(count, float(scales[-1]), dtype)
    clusters = jnp.asarray(np.arange(count) * min(stretches, count) // count, jnp.int32)
    weight = None
    if windows.start_deviation is not None:
        wide = np.repeat([windows.start_deviation[kind] for kind in names(windows.starts)], 3)
        weight = jnp.asarray(np.broadcast_to(scales / wide, units.shape).astype(dtype))
    return ReferenceStates(windows.starts, rate, units), weight, clusters
