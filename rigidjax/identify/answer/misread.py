"""Find the mistake with which a file was read, from the readings themselves, and read them again
without it.
"""

import itertools
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax.identify.answer.answers import Cause
from rigidjax.identify.data.full_scale import beyond_gyros
from rigidjax.identify.data.recording import Recording, readings_of
from rigidjax.identify.data.reference_states import Samples, attitudes, mean_rates, rates
from rigidjax.identify.model.model import Model, motion_in
from rigidjax.identify.search.starts import (
    integrated_euler,
    rate_only,
    regress_inertia,
    solve_inertia,
)
from rigidjax.identify.sensors import ForceTorque, Gyro
from rigidjax.motion.coupled import Coupled
from rigidjax.motion.suspension import Law
from rigidjax.motion.torques.forces import rotors_of
from rigidjax.motion.torques.states import freeze_own_states

# A correction of the recorded body rates is believed if two conditions hold. The error of the
# corrected rates, which is their difference from the rates between attitudes or the residual of
# Euler's equations, is less than BETTER times the error without the correction. This error is also
# less than LITTLE times the rates between attitudes or the angular momentum.
BETTER, LITTLE = 0.5, 0.3
# Several corrections cannot be told apart if the error with each of them is at most EQUAL times the
# least error: all of them are then named.
EQUAL = 1.1
_SAME = np.eye(3)

UNITS = {"deg/s read as rad/s": _SAME * np.pi / 180, "rad/s read as deg/s": _SAME * 180 / np.pi}
WORLD = "rates in the world's axes, not the body's"


def _orders() -> dict[str, Float[np.ndarray, "3 3"]]:
    """Return the matrices that correct rates read in one of the 47 wrong signed orders of axes."""
    words = {
        (0, 1, 2): "",
        (1, 0, 2): "x and y swapped",
        (0, 2, 1): "y and z swapped",
        (2, 1, 0): "x and z swapped",
        (1, 2, 0): "axes in the order y, z, x",
        (2, 0, 1): "axes in the order z, x, y",
    }
    out = {}
    for signs, order in itertools.product(itertools.product([1.0, -1.0], repeat=3), words):
        # Channel i reads `signs[i]` times the component `order[i]` of the rate.
        read = np.diag(signs) @ _SAME[list(order)]
        minus = [axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0]
        kept = [axis for axis, own in zip("xyz", np.diag(read), strict=True) if own == 1.0]
        if words[order]:
            turn = f" (a quarter turn about {kept[0]})" if kept and len(minus) == 1 else ""
            back = f", {' and '.join(minus)} reversed" if minus else ""
            out[f"{words[order]}{back}{turn}"] = read.T
        elif minus:
            one = f"the {minus[0]} axis mirrored", f"half a turn about {''.join(kept)}"
            out[(*one, "all signs turned round")[len(minus) - 1]] = read.T
    return out


ORDERS = _orders()
# Without attitudes, but under a torque, only these orders are tried.
FEW_ORDERS = {n: m for n, m in ORDERS.items() if not any(w in n for w in ("reversed", "half"))}
# These functions correct quaternions (n, 4) for each mistake with which attitudes may be read.
ATTITUDES = {
    "the quaternion's scalar last, not first": lambda q: np.roll(q, 1, axis=-1),
    "the quaternion from world to body": lambda q: q * [1.0, -1.0, -1.0, -1.0],
}


def cause_by_misread_file(recordings: Sequence[Recording], torque: Law | None) -> Cause | None:
    """Return the likely mistake with which the gyro or the attitudes of one body were read.

    The correction of each possible mistake is tried on the recordings. The rates of the gyro are
    compared with the rates between successive attitudes. Without one of the two the rates are
    inserted in Euler's equations with the inertia that fits best, and a correction is accepted only
    if a real body can have this inertia. A wrong order of axes of a gyro then shows only under a
    torque: free motion with a mirrored axis is a free motion, too.
    """
    gyros = readings_of(recordings[0], Gyro)
    turn, scale = (getattr(gyros[0].sensor, n) if gyros else None for n in ("mounting", "scale"))
    # Look for no mistake if the user gave a large mounting turn, or a scale far from 1: this user
    # has considered the axes and the units of the sensor.
    if turn is not None and np.abs(turn).max() >= 0.1:
        return None
    if scale is not None and np.abs(np.asarray(scale) - 1).max() >= 0.1:
        return None
    known, read = ([of(one) for one in recordings] for of in (attitudes, rates))
    turning = all(len(t) > 10 for t, _ in known)
    bound, ratios = np.inf, {}
    if gyros and turning:
        pairs = list(zip(read, known, strict=True))
        shown, wanted, world = (np.concatenate(p) for p in zip(*map(_beside, pairs), strict=True))
        bound = BETTER * _difference(shown, wanted)
        turns = (UNITS | ORDERS).items()
        ratios = {name: _difference(shown @ turn.T, wanted) for name, turn in turns}
        ratios[WORLD] = _difference(world, wanted)
        for name, change in ATTITUDES.items():
            changed = [_beside((w, Samples(t, change(q)))) for w, (t, q) in pairs]
            shown, wanted, _ = (np.concatenate(p) for p in zip(*changed, strict=True))
            ratios[name] = _difference(shown, wanted)
    elif gyros and beyond_gyros(recordings[0].readings):
        ratios = {"deg/s read as rad/s": 0.0}
    elif (gyros or turning) and rate_only(torque):
        bound, margin = _euler_residual(recordings, read, torque)
        # The body that fits the uncorrected rates best may be unreal. Sensor errors alone can make
        # it slightly unreal, but not as far as a margin of −0.8. With such a margin the file was
        # misread, and a correction to a real body is believed even if it does not make the residual
        # smaller.
        bound *= BETTER if margin > -0.8 else EQUAL
        fits = {}
        orders = {} if torque is None else FEW_ORDERS
        for name, turn in (UNITS | orders if gyros else {}).items():
            turned = [Samples(t, w @ turn.T) for t, w in read]
            fits[name] = _euler_residual(recordings, turned, torque)
        for name, change in ({} if gyros else ATTITUDES).items():
            turned = [mean_rates(t, change(q)) for t, q in known]
            fits[name] = _euler_residual(recordings, turned, torque)
        if torque is not None:
            other = "the torque with the other sign"
            fits[other] = _euler_residual(recordings, read, torque, -1.0)
        # A correction is believed only if the body that fits best is real (a margin not below
        # zero) and no ball (a margin near 1): any constant rate is a free motion of a ball, so that
        # a ball is no evidence for a correction.
        ratios = {name: left if -0.01 < m < 0.8 else np.inf for name, (left, m) in fits.items()}
    least = min(ratios.values(), default=np.inf)
    if not least < min(bound, LITTLE):
        return None
    equal = [
        name
        for name in sorted(ratios, key=lambda one: ratios[one])
        if ratios[name] <= EQUAL * least
    ]
    words = " or ".join(equal)
    if all(np.median(np.diff(recording.t)) == 1 for recording in recordings):
        # The motion shows the product of rates and times only.
        words = words.replace("deg/s read", "numbers of frames read as times, or deg/s read")
    kind = "Gyro" if gyros else "AttitudeSensor"
    return Cause("misread", kind, 1.0, f"most likely {words}", f"read the log again: {words}")


def warn_of_unit(recording: Recording, torque: Law | None) -> None:
    """Warn, before the search, of rates that are too large or too small because of their unit.

    Such a search takes some twenty times as long, and its answer is wrong.
    """
    odd = beyond_gyros(recording.readings)
    turning = mean_rates(*attitudes(recording)).values
    if readings_of(recording, Gyro) and len(turning) > 10:
        sizes = [np.sqrt(np.mean(one**2)) for one in (rates(recording).values, turning)]
        odd = odd or not 0.1 < sizes[0] / max(sizes[1], 1e-150) < 10.0
    cause = cause_by_misread_file([recording], torque) if odd else None
    if cause is not None:
        words = "the search goes on, but takes long"
        warnings.warn(f"fit: {cause.words}: {cause.remedy}; {words}", stacklevel=4)


class _EulerResidual(NamedTuple):
    residual: float  # relative to the angular momentum
    # The smallest eigenvalue of the matrix of second moments, divided by the largest magnitude of
    # an eigenvalue: positive if a real body can have the tensor.
    margin: float


def _euler_residual(
    recordings: Sequence[Recording],
    rates: Sequence[Samples],
    torque: Law | None,
    sign: float = 1.0,
) -> _EulerResidual:
    """Return the residual of Euler's equations with the inertia tensor that fits best.

    The torque is multiplied by `sign`.
    """
    pairs = zip(recordings, rates, strict=True)
    balances = [integrated_euler(recording, torque, mine) for recording, mine in pairs]
    matrix, side, momentum = (np.concatenate(part) for part in zip(*balances, strict=True))
    components, margin = solve_inertia(matrix, sign * side)
    left = np.linalg.norm(matrix @ components - sign * side)
    return _EulerResidual(float(left / np.linalg.norm(momentum @ components)), margin)


class _Beside(NamedTuple):
    """Hold what a gyro reads, and the rates between successive attitudes, at the same times."""

    shown: Float[np.ndarray, "n 3"]
    wanted: Float[np.ndarray, "n 3"]
    body: Float[np.ndarray, "n 3"]  # what it reads, turned from the world's to the body's axes


def _beside(pair: tuple[Samples, Samples]) -> _Beside:
    (t, w), (times, q) = pair
    when, wanted = mean_rates(times, jnp.asarray(q))
    shown = np.stack([np.interp(when, t, axis) for axis in w.T], axis=1)
    at = np.clip(np.searchsorted(times, when), 0, len(times) - 1)
    return _Beside(shown, wanted, _rotation(q[at]).inv().apply(shown))


def _rotation(q: Float[np.ndarray, "n 4"]) -> Any:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(q, -1, axis=-1))


def _difference(shown: Float[np.ndarray, "n 3"], wanted: Float[np.ndarray, "n 3"]) -> float:
    """Return the root mean square difference of rates from those `wanted`, relative to these."""
    return float(np.linalg.norm(shown - wanted) / max(np.linalg.norm(wanted), 1e-150))


def _in_body_axes(rates: Samples) -> Samples:
    """Return body rates from rates in the world's axes, whose integral is the attitude."""
    from scipy.spatial.transform import Rotation

    t, w = rates
    attitude, out = Rotation.identity(), [w[0]]
    for turn, rate in zip(
        Rotation.from_rotvec(0.5 * (w[1:] + w[:-1]) * np.diff(t)[:, None]), w[1:], strict=True
    ):
        attitude = turn * attitude
        out.append(attitude.inv().apply(rate))
    return Samples(t, np.stack(out))


class Reread(NamedTuple):
    """Hold a model without a mistake, to be fitted anew."""

    model: Model
    unit: float  # by which the errors are smaller than before
    name: str  # of the cause, "misread" or "sign"
    words: str
    remedy: str


def other_readings(model: Model, index: int) -> list[Reread]:
    """Return a model without each mistake in the readings of a sensor that only a fit can show."""
    reading, out, again = model.records.readings[index], [], "read the log again: {}"
    values, alone = np.asarray(reading.values), len(model.records.readings) == 1
    if isinstance(reading.sensor, Gyro) and model.torque is None and alone:
        for name, turn in UNITS.items():
            other = with_values(model, index, values @ turn)
            unit = float(turn[0, 0])
            out.append(Reread(other, unit, "misread", name, again.format(name)))
        world, counts = values.copy(), np.asarray(model.counts).tolist()
        for row, t, count in zip(world, np.asarray(model.records.t), counts, strict=True):
            row[:count] = _in_body_axes(Samples(t[:count], row[:count])).values
        other = with_values(model, index, world)
        out.append(Reread(other, 1.0, "misread", WORLD, again.format(WORLD)))
    pairs, structure = jax.tree.flatten_with_path(model)
    names = [getattr(path[-1], "name", "") for path, _ in pairs]
    if "gravity" in names:
        leaves = [-x if n == "gravity" else x for n, (_, x) in zip(names, pairs, strict=True)]
        words = "gravity points the other way in the frame of the poses", "negate gravity"
        out.append(Reread(jax.tree.unflatten(structure, leaves), 1.0, "sign", *words))
    if isinstance(reading.sensor, ForceTorque):
        words = "the readings are what the body does to the support", "negate all readings"
        out.append(Reread(with_values(model, index, -values), 1.0, "sign", *words))
    if isinstance(reading.sensor, Gyro) and rotors_of(model.torque) and not model.parts:
        out += _other_rotors(model)
    return out


def _other_rotors(model: Model) -> list[Reread]:
    """Return models whose rotors stand and turn as a regression of the first recording says.

    The regression on Euler's equations has a torque of any direction for the square of each speed,
    and one along each rotor's axis for its derivative.
    """
    from scipy.optimize import linear_sum_assignment

    record, scenes = model.recording, model.scenes(model.start())
    scene = jax.tree.map(lambda leaf: leaf[0] if eqx.is_array(leaf) else leaf, scenes)
    states, law = motion_in(model, scene, record)

    def speeds_at(t: Array, state: Any) -> Array:
        frozen = freeze_own_states(law, state.own) if isinstance(state, Coupled) else law
        speeds: Any = rotors_of(frozen)[0].speeds
        return jnp.asarray(speeds(t) if callable(speeds) else speeds)

    speeds = np.asarray(jax.jit(jax.vmap(speeds_at))(record.t, states))
    rotors, count = rotors_of(model.torque)[0], speeds.shape[1]
    places, axes = np.asarray(rotors.positions), np.asarray(rotors.directions)

    def columns(t: np.ndarray, w: np.ndarray) -> np.ndarray:
        n = np.stack([np.interp(t, np.asarray(record.t), one) for one in speeds.T], axis=1)
        n = n / (np.abs(n).max() or 1.0)
        pushes = np.einsum("ti,jk->tjik", n**2, np.eye(3)).reshape(t.size, 3, -1)
        return np.concatenate([pushes, axes.T * np.gradient(n, t, axis=0)[:, None]], axis=2)

    found = regress_inertia((record,), None, columns)
    if found is None:
        return []
    pushes, arms = found.coefficients[: 3 * count].reshape(count, 3), np.cross(places, axes)
    order = linear_sum_assignment(-pushes @ arms.T)[1]
    # The sense of a rotor is less certain than its place: those that were given may be right.
    given, seen = np.asarray(rotors.spins), -np.sign(np.sum(pushes * axes[order], axis=1))
    sets = [tuple(x.astype(int).tolist()) for x in (seen, given, given[order], -given[order])]
    names, out = ("positions", "directions", "spins"), []
    parts = lambda m: [getattr(rotors_of(m.torque)[0], name) for name in names]  # noqa: E731
    for spins in dict.fromkeys(sets):
        if (order != np.arange(count)).any() or spins != sets[1]:
            rows = places[order], axes[order], np.array(spins, float)
            other = eqx.tree_at(parts, model, [jnp.asarray(each) for each in rows])
            words = f"take rows {order.tolist()} of positions and directions, and spins {spins}"
            said = "rotors in another order or sense of turning"
            out.append(Reread(other, 1.0, "misread", said, words))
    return out


def with_values(model: Model, index: int, values: np.ndarray) -> Model:
    """Return a model with other readings of one sensor."""
    return eqx.tree_at(lambda m: m.records.readings[index].values, model, jnp.asarray(values))
