"""Find the phases of a record: free flight, swings, rest, handling, gaps, full scale."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from rigidjax import _checks
from rigidjax.identify.data.full_scale import RUN, full_scale_of, runs
from rigidjax.identify.data.recording import Recording, input_functions, readings_of
from rigidjax.identify.data.reference_states import rates, swing_axis
from rigidjax.identify.sensors import Accelerometer

# Means are taken over this time, s, and free flight is looked for in windows of the other.
_MEAN, _WINDOW = 0.02, 0.1
# The shortest phases that are told, s: of free flight with an accelerometer, of free flight by the
# gyro alone, and of any other kind.
_SHORTEST = (0.08, 0.15, 0.3)
# A part of a force that is not explained, m/s², or of an angular acceleration, rad/s², and the
# share of the reading: less is an error of the sensors.
_UNEXPLAINED = (1.5, 0.05)
_UNEXPLAINED_TURN = (2.0, 0.1)
# The standard deviations, before anything is known, of the place of an accelerometer, m, of a ratio
# of moments, and of the bias of an accelerometer, m/s².
_FAR, _UNLIKE, _FORCE_BIAS = 0.1, 0.3, 0.3
# Windows of free flight are explained to this share of what is allowed.
_CLOSE = 0.4
# A body at rest has steadier rates and forces, rad/s and m/s², and a bias of the gyro below _BIAS.
_STEADY, _STEADY_FORCE, _BIAS = 0.03, 0.3, 0.15
_GRAVITY = 9.80665
# A tensor of inertia of the trace 2 is _I0 + Σ x B, with five tensors B that have no trace.
_I0 = 2 / 3 * np.eye(3)
_BASIS = np.zeros((5, 3, 3))
_BASIS[[0, 1, 2, 0, 1, 2], [0, 0, 1, 1, 2, 2], [1, 2, 2, 0, 0, 1]] = 1.0
_BASIS[3], _BASIS[4] = np.diag([1.0, -1.0, 0.0]), np.diag([1.0, 1.0, -2.0])
# A free flight that turns by a smaller angle, rad, says nothing of the body, nor do fewer readings.
_LEAST_TURN, _FEWEST = 0.5, 8


class Phase(NamedTuple):
    """Hold a part of a record in which one thing happens.

    **Fields:**

    - `kind`: `free`, `swing`, `rest`, `motors` (which run), `handling` (anything else), `gap`
      (without readings), or `full scale` (of the gyro; such a phase overlaps with others).
    - `start`, `end`: times, s.
    - `turned`: the angle ∫ |Ω| dt, rad.
    - `says`: what can be fitted from it, in one sentence.
    - `is_usable`: whether it is a free flight from which a body can be fitted.

    >>> wobble = [[np.cos(k), np.sin(k), 5.0] for k in 0.08 * np.arange(50)]
    >>> record = Recording(0.02 * np.arange(50), (rj.identify.Gyro(0.01), wobble))
    >>> [(phase.kind, phase.is_usable) for phase in find_phases(record)]
    [('free', True)]
    """

    kind: str
    start: float
    end: float
    turned: float
    says: str
    is_usable: bool = False


def find_phases(recording: Recording, motors: Sequence[str] = ()) -> list[Phase]:
    """Return the phases of a record, in the order of their starts.

    In free flight an accelerometer at the place r reads dΩ/dt × r + Ω × (Ω × r) and nothing else,
    with one small r in all flights of the record. Without an accelerometer the rates must obey
    Euler's equations of a free body, with one tensor of inertia in all flights: a hand that turns a
    body evenly cannot be told from a free flight. Several throws, and fast ones, are found better
    than one.

    **Arguments:**

    - `recording`: of a gyro or an attitude sensor, with an accelerometer if there is one.
    - `motors`: the names of inputs of the recording that are speeds or commands of motors: a motor
      runs while its input is above its least value by more than a twentieth of its range.

    **Raises:** `TypeError` for no recording, or a traced one, and for motors that are no sequence
    of names; `ValueError` without rates, for an accelerometer that does not read 9.8 m/s² at rest,
    and for a motor that is no input.

    >>> t, up = 0.01 * np.arange(100), np.tile([0.0, 0.0, 9.8], (100, 1))
    >>> up[30:80] = 0.0
    >>> turning = np.where(up == 0.0, 3.0, 1.0)
    >>> gyro, force = rj.identify.Gyro(0.01), rj.identify.Accelerometer(0.1, place=[0, 0, 0])
    >>> record = Recording(t, (gyro, turning), (force, up))
    >>> [phase.kind for phase in find_phases(record)]
    ['handling', 'free', 'handling']
    """
    _checks.require_instance(recording, Recording, "recording")
    if not _checks.is_known(recording):
        raise TypeError("find_phases: wanted a known recording, got a traced one; call it outside")
    if not isinstance(motors, Sequence) or isinstance(motors, str):
        raise TypeError(f"motors: wanted a sequence of names, got {type(motors).__name__}")
    t, w = (np.asarray(one, float) for one in rates(recording))
    if t.size < _FEWEST:
        raise ValueError(f"find_phases: wanted {_FEWEST} readings of a gyro at least, got {t.size}")
    step, force = float(np.median(np.diff(t))), _force(recording, t)
    gaps = np.diff(t) > max(5 * step, 0.05)
    mean, long = _means(round(_MEAN / step)), _means(round(0.3 / step))
    rest = (_scatter(mean(w), long) < _STEADY) & (np.linalg.norm(long(w), axis=1) < _BIAS)
    calm = np.linalg.norm(mean(w), axis=1) < _BIAS
    if force is not None:
        rest &= _scatter(mean(force), long) < _STEADY_FORCE
        calm &= np.abs(np.linalg.norm(mean(force), axis=1) - _GRAVITY) < 0.1 * _GRAVITY
        size = np.linalg.norm(force[rest], axis=1)
        if size.size > 10 and not 0.8 < np.median(size) / _GRAVITY < 1.2:
            raise ValueError(
                f"find_phases: at rest the accelerometer reads {np.median(size):.3g} m/s², wanted "
                "9.8: is it in another unit (g), or is gravity already taken off? take the raw one"
            )
    # The windows have lost the ends of a rest.
    rest |= calm & (long(rest.astype(float)) > 1e-9)
    # At the turning points of a large swing hardly a force acts: a swing comes before a flight.
    masks = {"motors": _running(recording, t, motors), "swing": _swings(t, w, ~rest)}
    masks |= {"free": _free(t, w, force, mean) & ~rest, "rest": rest}
    speed = np.linalg.norm(w, axis=1)
    angle = np.append(0.0, np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t)))
    kinds, left = np.full(t.size, "handling", dtype=object), np.ones(t.size, bool)
    for kind, mask in masks.items():
        least = _SHORTEST[1 if force is None else 0] if kind == "free" else _SHORTEST[2]
        for i, j in runs(mask & left, gaps):
            evenly = kind == "free" and force is None and angle[j] - angle[i] < _LEAST_TURN
            if t[j] - t[i] >= least and not evenly:
                kinds[i : j + 1], left[i : j + 1] = kind, False
    out = [
        Phase("gap", t[i], t[i + 1], 0.0, "no readings: nothing is fitted across it")
        for i in np.flatnonzero(gaps)
    ]
    out += [
        Phase("full scale", t[i], t[j], 0.0, f"the rate about {axis} is at least {top:.3g} rad/s")
        for axis, column in zip("xyz", w.T, strict=True)
        if (top := full_scale_of(column)) is not None
        for i, j in runs(np.abs(column) >= top * (1 - 1e-9))
        if j - i + 1 >= RUN
    ]
    for i, j in runs(kinds, gaps):
        turned = float(angle[j] - angle[i])
        out.append(_phase(kinds[i], t[i : j + 1], w[i : j + 1], turned, force is not None))
    return sorted(out, key=lambda phase: phase.start)


def _phase(kind: str, t: np.ndarray, w: np.ndarray, turned: float, by_force: bool) -> Phase:
    """Return a phase with the words on it."""
    says, usable = "nothing: the force of what holds the body is not known", False
    if kind == "rest":
        x, y, z = np.median(w, axis=0)
        says = f"the rate, which is the bias of a gyro: {x:.4f}, {y:.4f}, {z:.4f} rad/s"
    elif kind == "motors":
        says = "a law of the rotors, with the speeds or commands of the motors as inputs"
    elif kind == "swing":
        axis = np.linalg.eigh(w.T @ w)[1][:, -1]
        x, y, z = np.round(axis * np.sign(axis[np.argmax(np.abs(axis))]), 2) + 0.0
        says = f"the moment about [{x}, {y}, {z}]: python -m rigidjax swing --log"
    elif kind == "free":
        # The third difference of white noise has 20 times its variance.
        noise = np.median(np.abs(np.diff(w, 3, axis=0))) / 0.6745 / np.sqrt(20) if len(t) > 3 else 0
        if len(t) < _FEWEST:
            says = f"nothing: {len(t)} readings are too few"
        elif turned < _LEAST_TURN:
            says = f"nothing: it turns by {turned:.2g} rad only"
        elif np.sqrt(np.mean(w**2)) < 5 * noise:
            says = "nothing: the rates are hardly above their noise"
        else:
            says = "the ratios of the moments; with a wheel or a known torque the moments"
            says += "" if by_force else " (by the gyro alone: was it in the air?)"
            usable = True
    return Phase(kind, float(t[0]), float(t[-1]), turned, says, usable)


def _means(count: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return the running mean of rows, over a `count` that is made odd."""
    from scipy.ndimage import uniform_filter1d

    count = max(3, count | 1)
    return lambda x: uniform_filter1d(x, count, axis=0, mode="nearest")


def _scatter(x: np.ndarray, mean: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the running standard deviation of rows."""
    return np.sqrt(np.maximum(mean(x**2) - mean(x) ** 2, 0).sum(axis=1))


def _force(recording: Recording, t: np.ndarray) -> Float[np.ndarray, "n 3"] | None:
    """Return the specific force, m/s², at the times, or `None` without an accelerometer."""
    for reading in readings_of(recording, Accelerometer):
        mask = reading.host_mask
        there, values = np.asarray(recording.t)[mask], np.asarray(reading.values)[mask]
        return np.stack([np.interp(t, there, column) for column in values.T], axis=1)
    return None


def _running(recording: Recording, t: np.ndarray, motors: Sequence[str]) -> Bool[np.ndarray, " n"]:
    """Return when a motor runs."""
    out, inputs = np.zeros(t.size, bool), input_functions(recording)
    for name in motors:
        if name not in inputs:
            raise ValueError(f"motors: wanted inputs of the recording, got {name!r}")
        values = np.asarray(jax.vmap(inputs[name])(jnp.asarray(t))).reshape(t.size, -1)
        above = values - values.min(axis=0)
        out |= (above > 0.05 * np.abs(values).max(axis=0)).any(axis=1)
    return out


def _cross(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Return the matrices of v ×."""
    out = np.zeros((len(v), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, k, j], out[:, j, k] = v[:, i], -v[:, i]
    return out


def _free(
    t: np.ndarray,
    w: np.ndarray,
    force: np.ndarray | None,
    mean: Callable[[np.ndarray], np.ndarray],
) -> Bool[np.ndarray, " n"]:
    """Return where few numbers, the same in the whole record, explain the forces, or the rates."""
    system = _force_rows if force is not None else _turn_rows
    slope, turn = np.gradient(w, t, axis=0), _cross(w)
    rows = system(slope, w, turn, force)
    a, b = mean(rows.a), mean(rows.b)
    # By what a row may be off.
    off = rows.off[0] + rows.off[1] * np.linalg.norm(b, axis=1, keepdims=True)
    starts = np.arange(0, t.size, max(3, round(_WINDOW / float(np.median(np.diff(t))))))
    sizes, left = np.diff(np.append(starts, t.size)), a / off[..., None]
    total = functools.partial(np.add.reduceat, indices=starts, axis=0)
    gram, side = total(left.mT @ left), total((left.mT @ (b / off)[..., None])[..., 0])
    square, ridge = total(((b / off) ** 2).sum(axis=1)), np.diag(rows.prior**-2.0)

    def fits(x: np.ndarray) -> Bool[np.ndarray, " windows"]:
        """Return which windows the numbers `x` explain."""
        bent = (gram @ x[..., None])[..., 0]
        return square - 2 * (side * x).sum(-1) + (bent * x).sum(-1) < _CLOSE**2 * sizes

    x = np.linalg.solve(gram + ridge, side[..., None])[..., 0]
    near = fits(x)
    if force is None:
        moments = np.linalg.eigvalsh(_I0 + np.einsum("nk,kij->nij", x, _BASIS))
        near &= (moments[:, 0] > 0.05) & (moments[:, 2] < 1.1)
    near = np.flatnonzero(near)
    if not near.size:
        return np.zeros(t.size, bool)
    tried = x[near[np.linspace(0, near.size - 1, min(near.size, 300)).astype(int)]]
    best = max(tried, key=lambda one: int(fits(one).sum()))
    for _ in range(4):
        mine = fits(best)
        best = np.linalg.solve(gram[mine].sum(axis=0) + ridge, side[mine].sum(axis=0))
    good = (np.linalg.norm(b - a @ best, axis=1) < off[:, 0]) & (rows.speed > 1.0)
    if force is None:
        return good
    # A mean has lost the ends of a flight: readings there count one by one, with a derivative from
    # either side.
    near = np.flatnonzero(mean(good.astype(float)) > 1e-9)
    sides = np.diff(w, axis=0) / np.diff(t)[:, None]
    slopes = (slope, np.concatenate([sides[:1], sides]), np.concatenate([sides, sides[-1:]]))
    alone = [system(one[near], w[near], turn[near], force[near]) for one in slopes]
    raw = np.min([np.linalg.norm(one.b - one.a @ best, axis=1) for one in alone], axis=0)
    usual = 3 * np.median(raw[good[near]]) if near.size else 0.0
    good[near] |= raw < np.maximum(usual, _CLOSE * off[near, 0])
    return good


class _Rows(NamedTuple):
    """Hold linear equations A x = b of few numbers x in each row of a free flight."""

    a: Float[np.ndarray, "n 3 k"]
    b: Float[np.ndarray, "n 3"]
    off: tuple[float, float]
    # The standard deviations of the numbers before anything is known.
    prior: Float[np.ndarray, " k"]
    speed: Any = np.inf


def _force_rows(slope: np.ndarray, w: np.ndarray, turn: np.ndarray, force: Any) -> _Rows:
    """Return the equations of the place, m, and the bias, m/s², of an accelerometer."""
    one = np.broadcast_to(np.eye(3), turn.shape)
    columns = np.concatenate([_cross(slope) + turn @ turn, one], axis=2)
    return _Rows(columns, force, _UNEXPLAINED, np.repeat([_FAR, _FORCE_BIAS], 3))


def _turn_rows(slope: np.ndarray, w: np.ndarray, turn: np.ndarray, force: Any) -> _Rows:
    """Return Euler's equations of a tensor of inertia of the trace 2."""
    columns = np.einsum("kij,nj->nik", _BASIS, slope) + turn @ np.einsum("kij,nj->nik", _BASIS, w)
    speed = np.linalg.norm(w, axis=1)
    return _Rows(columns, -slope @ _I0, _UNEXPLAINED_TURN, np.full(5, _UNLIKE), speed)


def _swings(t: np.ndarray, w: np.ndarray, left: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Return where the rates go there and back about one axis, in windows of 2 s, for two periods
    at least.
    """
    out = np.zeros(t.size, bool)
    for i, j in runs(left):
        last = t[j] - 2.0
        for start in np.append(np.arange(t[i], last, 0.5), last) if last > t[i] else ():
            rows = slice(*np.searchsorted(t, [start, start + 2.0 + 1e-9]))
            out[rows] |= swing_axis(w[rows]) is not None
    for i, j in runs(out):
        axis = np.linalg.eigh(w[i : j + 1].T @ w[i : j + 1])[1][:, -1]
        along = w[i : j + 1] @ axis
        along = along[np.abs(along) > 0.2 * np.abs(along).max()]
        out[i : j + 1] &= np.count_nonzero(np.diff(np.sign(along))) > 3
    return out
