"""Rates with a wrong unit, sign or order of axes: a test by attitudes or Euler's equations."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from rigidjax._types import HasSpin
from rigidjax.identify.answers import Cause
from rigidjax.identify.direct_estimates import attitudes, rates_of
from rigidjax.identify.initial_guess import balance, tensor_and_margin
from rigidjax.identify.recording import Recording, readings_of
from rigidjax.identify.sensors import Gyro
from rigidjax.motion.torques.states import has_states

# Corrected rates must leave less than this share of the error as read, and of the whole signal.
BETTER, LITTLE = 0.5, 0.3
# As good as the best: these records cannot tell them apart.
EQUAL = 1.1
_SAME = np.eye(3)

# Mistakes in rates, and the matrix that corrects each.
RATES = {
    "deg/s read as rad/s": _SAME * np.pi / 180,
    "rad/s read as deg/s": _SAME * 180 / np.pi,
    "the x axis mirrored": np.diag([-1.0, 1.0, 1.0]),
    "the y axis mirrored": np.diag([1.0, -1.0, 1.0]),
    "the z axis mirrored": np.diag([1.0, 1.0, -1.0]),
    "all signs turned round": -_SAME,
    "x and y swapped": _SAME[[1, 0, 2]],
    "y and z swapped": _SAME[[0, 2, 1]],
    "x and z swapped": _SAME[[2, 1, 0]],
    "axes in the order y, z, x": _SAME[[2, 0, 1]],
    "axes in the order z, x, y": _SAME[[1, 2, 0]],
}
ATTITUDES = {
    "the quaternion's scalar last, not first": lambda q: np.roll(q, 1, axis=-1),
    "the quaternion from world to body": lambda q: q * [1.0, -1.0, -1.0, -1.0],
}


def misread(recordings: Sequence[Recording]) -> Cause | None:
    """The mistake in reading the rates of one body, if there is one.

    The rates are compared with the rates between attitudes. Without attitudes they are compared
    with Euler's equations, integrated over the record, for the best body: a correction counts only
    if that is a real body. A mirrored axis cannot be detected without a torque.
    """
    gyros = readings_of(recordings[0], Gyro)
    if not gyros or not _as_the_body(gyros[0].sensor):
        return None
    known = [attitudes(recording) for recording in recordings]
    if all(len(t) > 10 for t, _ in known):
        bound = BETTER * _of_attitudes(recordings, known, _SAME)
        found = {name: _of_attitudes(recordings, known, turn) for name, turn in RATES.items()}
        for name, change in ATTITUDES.items():
            changed = [(t, change(q)) for t, q in known]
            found[name] = _of_attitudes(recordings, changed, _SAME)
    elif all(_of_rates(recording.torque) for recording in recordings):
        bound, margin = _of_euler(recordings, _SAME)
        # Sensor errors alone can give numbers of no real body.
        bound *= BETTER if margin > -0.8 else EQUAL
        tried = {name: _of_euler(recordings, turn) for name, turn in RATES.items()}
        if recordings[0].torque is not None:
            tried["the torque with the other sign"] = _of_euler(recordings, _SAME, -1.0)
        # Any rates are a free motion of a ball.
        found = {name: left if -0.01 < m < 0.8 else np.inf for name, (left, m) in tried.items()}
    else:
        return None
    least = min(found.values())
    if not least < min(bound, LITTLE):
        return None
    words = " or ".join(name for name, left in found.items() if left <= EQUAL * least)
    return Cause("misread", "Gyro", 1.0, f"most likely {words}", f"read the log again: {words}")


def _as_the_body(gyro: Gyro) -> bool:
    """Whether a gyro's given axes and scales are close to those of the body."""
    turn, scale = (np.asarray(0.0 if x is None else x) for x in (gyro.mounting, gyro.scale))
    return bool(np.abs(turn).max() < 0.1 and (gyro.scale is None or np.abs(scale - 1).max() < 0.1))


def _of_rates(torque: Any) -> bool:
    """Whether there is no torque, or it depends on time and rate alone."""
    return torque is None or (getattr(torque, "feels", None) is HasSpin and not has_states(torque))


def _of_euler(
    recordings: Sequence[Recording], turn: np.ndarray, sign: float = 1.0
) -> tuple[float, float]:
    """The residual of Euler's equations, and the margin by which the best body is real."""
    found = [balance(recording, turn) for recording in recordings]
    matrix, side, momentum = (np.concatenate(part) for part in zip(*found, strict=True))
    components, margin = tensor_and_margin(matrix, sign * side)
    left = np.linalg.norm(matrix @ components - sign * side)
    return float(left / np.linalg.norm(momentum @ components)), margin


def _of_attitudes(recordings: Sequence[Recording], known: Sequence[Any], turn: np.ndarray) -> float:
    """The relative difference of rates from the rates between attitudes."""
    left, size = 0.0, 1e-300
    for recording, (t, q) in zip(recordings, known, strict=True):
        when, wanted = rates_of(t, jnp.asarray(q))
        reading = readings_of(recording, Gyro)[0]
        at, w = np.asarray(recording.t)[reading.seen], np.asarray(reading.values)[reading.seen]
        shown = np.stack([np.interp(when, at, axis) for axis in (w @ turn.T).T], axis=1)
        left += float(np.sum((shown - wanted) ** 2))
        size += float(np.sum(wanted**2))
    return float(np.sqrt(left / size))
