"""Find the most likely cause of the errors of a fit.

Each cause has a direction: the change that the cause would make in the readings along the fitted
motion. The errors are regressed on this direction together with the derivatives of the readings
with respect to all parameters (a score test: Rao 1948, doi:10.1017/S0305004100023987). Therefore a
cause explains nothing if a change of the parameters has the same effect on the readings.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax.identify.answer.answers import Cause
from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Recording, readings_of
from rigidjax.identify.data.reference_states import attitudes, mean_rates
from rigidjax.identify.model.charts import body_list, tensor_of
from rigidjax.identify.model.model import Model, part_of_sensor
from rigidjax.identify.model.terms import Noise, scaled_slopes
from rigidjax.identify.search.starts import (
    integrated_euler,
    rate_only,
    solve_inertia,
)
from rigidjax.identify.sensors import AbstractSensor, Gyro
from rigidjax.identify.sensors.base import extras
from rigidjax.identify.uncertainty.considered import slope_in_time
from rigidjax.identify.uncertainty.covariance import Linearisation
from rigidjax.motion.suspension import Law

# A correction of the recorded body rates is believed if two conditions hold. The error of the
# corrected rates, which is their difference from the rates between attitudes or the residual of
# Euler's equations, is less than BETTER times the error without the correction. This error is also
# less than LITTLE times the rates between attitudes or the angular momentum.
BETTER, LITTLE = 0.5, 0.3
# Several corrections cannot be told apart if the error with each of them is at most EQUAL times the
# least error: all of them are then named.
EQUAL = 1.1
_SAME = np.eye(3)

# These matrices (3, 3) correct the body rates for each mistake with which rates may be read.
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
# These functions correct quaternions (n, 4) for each mistake with which attitudes may be read.
ATTITUDES = {
    "the quaternion's scalar last, not first": lambda q: np.roll(q, 1, axis=-1),
    "the quaternion from world to body": lambda q: q * [1.0, -1.0, -1.0, -1.0],
}


def cause_by_misread_file(recordings: Sequence[Recording], torque: Law | None) -> Cause | None:
    """Return the likely mistake with which the gyro or the attitudes of one body were read.

    The correction of each possible mistake is tried on the recordings. The rates of the gyro are
    compared with the rates between successive attitudes. Without attitudes the rates are inserted
    in Euler's equations with the inertia that fits best, and a correction is accepted only if a
    real body can have this inertia. A mirrored axis then shows only under a torque: free motion
    with a mirrored axis is a free motion, too.
    """
    gyros = readings_of(recordings[0], Gyro)
    if not gyros:
        return None
    turn, scale = (getattr(gyros[0].sensor, name) for name in ("mounting", "scale"))
    # Look for no mistake if the user gave a large mounting turn, or a scale far from 1: this user
    # has considered the axes and the units of the sensor.
    if turn is not None and np.abs(turn).max() >= 0.1:
        return None
    if scale is not None and np.abs(np.asarray(scale) - 1).max() >= 0.1:
        return None
    known = [attitudes(recording) for recording in recordings]
    if all(len(t) > 10 for t, _ in known):
        bound = BETTER * _rate_difference(recordings, known, _SAME)
        ratios = {name: _rate_difference(recordings, known, turn) for name, turn in RATES.items()}
        for name, change in ATTITUDES.items():
            changed = [(t, change(q)) for t, q in known]
            ratios[name] = _rate_difference(recordings, changed, _SAME)
    elif rate_only(torque):
        bound, margin = _euler_residual(recordings, torque, _SAME)
        # The body that fits the uncorrected rates best may be unreal. Sensor errors alone can make
        # it slightly unreal, but not as far as a margin of −0.8. With such a margin the file was
        # misread, and a correction to a real body is believed even if it does not make the residual
        # smaller.
        bound *= BETTER if margin > -0.8 else EQUAL
        fits = {name: _euler_residual(recordings, torque, turn) for name, turn in RATES.items()}
        if torque is not None:
            fits["the torque with the other sign"] = _euler_residual(
                recordings, torque, _SAME, -1.0
            )
        # A correction is believed only if the body that fits best is real (a margin not below
        # zero) and no ball (a margin near 1): any constant rate is a free motion of a ball, so that
        # a ball is no evidence for a correction.
        ratios = {name: left if -0.01 < m < 0.8 else np.inf for name, (left, m) in fits.items()}
    else:
        return None
    least = min(ratios.values())
    if not least < min(bound, LITTLE):
        return None
    words = " or ".join(name for name, left in ratios.items() if left <= EQUAL * least)
    if all(np.median(np.diff(recording.t)) == 1 for recording in recordings):
        # The motion shows the product of rates and times only.
        words = words.replace("deg/s read", "numbers of frames read as times, or deg/s read")
    return Cause("misread", "Gyro", 1.0, f"most likely {words}", f"read the log again: {words}")


class _EulerResidual(NamedTuple):
    residual: float  # relative to the angular momentum
    # The smallest eigenvalue of the matrix of second moments, divided by the largest magnitude of
    # an eigenvalue: positive if a real body can have the tensor.
    margin: float


def _euler_residual(
    recordings: Sequence[Recording],
    torque: Law | None,
    correction: Float[np.ndarray, "3 3"],
    sign: float = 1.0,
) -> _EulerResidual:
    """Return the residual of Euler's equations with the inertia tensor that fits best.

    The recorded rates are multiplied by `correction`, the torque by `sign`.
    """
    balances = [integrated_euler(recording, torque, correction) for recording in recordings]
    matrix, side, momentum = (np.concatenate(part) for part in zip(*balances, strict=True))
    components, margin = solve_inertia(matrix, sign * side)
    left = np.linalg.norm(matrix @ components - sign * side)
    return _EulerResidual(float(left / np.linalg.norm(momentum @ components)), margin)


def _rate_difference(
    recordings: Sequence[Recording],
    attitudes: Sequence[tuple[np.ndarray, np.ndarray]],
    correction: Float[np.ndarray, "3 3"],
) -> float:
    """Return the root mean square difference of the rates of a gyro, times `correction`, from those
    between successive `attitudes` (times and quaternions), relative to these.
    """
    left, size = 0.0, 1e-300
    for recording, (t, q) in zip(recordings, attitudes, strict=True):
        when, wanted = mean_rates(t, jnp.asarray(q))
        reading = readings_of(recording, Gyro)[0]
        used = reading.host_mask
        gyro_times, w = np.asarray(recording.t)[used], np.asarray(reading.values)[used]
        shown = np.stack(
            [np.interp(when, gyro_times, axis) for axis in (w @ correction.T).T], axis=1
        )
        left += float(np.sum((shown - wanted) ** 2))
        size += float(np.sum(wanted**2))
    return float(np.sqrt(left / size))


# The best cause is named if it explains more than the fraction ENOUGH of the squared errors. A
# cause that explains at least NEARLY times as much as the best one is then named, too.
ENOUGH, NEARLY = 0.7, 0.95
# A cause changes the readings along one or more directions of length one. All changes of the
# readings that the parameters can make are subtracted from them. A combination of the remainders is
# dropped if its singular value is at most this number, since the parameters could make nearly the
# same change.
APART = 0.05
# The causes in LINEAR change the readings in proportion to their size only if the size is below
# SMALL.
LINEAR, SMALL = ("scale", "mounting", "skew"), 0.5
# The entry SKEW[i, j, k] is 1 if the k-th angle of skew adds component i, times this angle, to the
# reading of axis j.
SKEW = np.zeros((3, 3, 3))
SKEW[1, 0, 0] = SKEW[2, 0, 1] = SKEW[2, 1, 2] = 1.0


class _Candidate(NamedTuple):
    name: str
    direction: Float[np.ndarray, "records times 3 c"]  # the change by a cause of unit size
    words: str  # with `{size}` for the size of the cause
    remedy: str


class _Share(NamedTuple):
    share: float  # of the squared errors, 0 to 1
    size: Float[np.ndarray, " c"]  # of the cause, such as the components of a bias


def causes(
    model: Model,
    x: Float[Array, " n"],
    noise: Noise,
    linear: Linearisation,
    indices: Sequence[int],
) -> tuple[Cause, ...]:
    """Return the most likely cause of the errors of each sensor in `indices` that has one.

    If a file was most likely misread, this cause alone is returned.
    """
    for one in stacking.kinds_of(model):
        given = zip(stacking.on_host(one.records, one.counts), one.body_names, strict=True)
        mine = [recording for recording, name in given if name == one.body_names[0]]
        wrong = cause_by_misread_file(mine, one.torque)
        if wrong is not None:
            return (wrong,)
    if not np.isfinite(linear.weighted_jacobian).all():
        return ()
    free = np.linalg.qr(linear.weighted_jacobian)[0]
    out = []
    for index in indices:
        sensor: Any = model.records.readings[index].sensor
        cause = time_stamp_cause(model, noise, linear, index)
        if cause is None and _is_vector_error(sensor):
            rows = _candidates(model, x, linear, index)
            shares = [_share(model, noise, linear, index, free, row.direction) for row in rows]
            cause = _likeliest(sensor, rows, shares)
        suspect = extras(sensor).suspect
        if cause is None and suspect is not None:
            cause = Cause(suspect[0], type(sensor).__name__, None, *suspect[1:])
        out += [] if cause is None else [cause]
    return tuple(out)


def time_stamp_cause(model: Model, noise: Noise, linear: Linearisation, index: int) -> Cause | None:
    """Return the cause "clock" if the time stamps of a sensor scatter by more than its jitter.

    A late time stamp makes an error along dy/dt, the derivative of the readings y with respect to
    time: the errors along it are then larger than errors of random direction would be.
    """
    sensor, error = model.records.readings[index].sensor, linear.raw[index]
    kept = linear.mask[index].all(axis=-1)
    if not (_is_vector_error(sensor) and error[kept].any()):
        return None
    slope = slope_in_time(model, np.asarray(model.records.readings[index].values) - error)
    late = model.records.readings[index].jitter_error
    both = np.asarray(scaled_slopes(np.stack([error, slope], -1), noise[index], late))
    error, slope = both[..., 0], both[..., 1]
    moved = np.sum(slope**2, axis=-1) * kept
    moving = moved > 1e-2 * moved.max()
    if not moving.any():
        return None
    along = np.sum(np.sum(error * slope, axis=-1)[moving] ** 2 / moved[moving])
    channels = np.sum(error[kept] ** 2, axis=0)
    # Random errors lie along dy/dt, too, by chance. If they are as large in each channel as the
    # errors of the fit, `chance` is the expected fraction of their sum of squares along dy/dt.
    ways = np.mean(slope[moving] ** 2 / moved[moving][:, None], axis=0)
    chance, share = float(ways @ channels / channels.sum()), float(along / channels.sum())
    if not share > chance + 0.5 * (1.0 - chance) + 1.0 / np.sqrt(moving.sum()):
        return None
    # Noise across dy/dt, two of the three components, shows how much of it lies along dy/dt.
    across = (float(np.sum(error[moving] ** 2)) - float(along)) / 2
    scatter = np.sqrt(max(float(along) - across, 0.0) / moved[moving].sum())
    return _cause_with_share(
        "clock", sensor, share, f"time stamps that scatter by {1e3 * scatter:.2g} ms",
        f"take times from the sensor's own count of samples, or give it jitter={scatter:.2g}",
    )  # fmt: skip


def _cause_with_share(
    name: str, sensor: AbstractSensor, share: float, words: str, remedy: str
) -> Cause:
    """Return a cause whose words say what fraction of the squared errors it explains."""
    kind = type(sensor).__name__
    explained = f"{100 * share:.0f} % of the squared errors of the {kind}"
    return Cause(name, kind, share, f"most likely {words}: {explained}", remedy)


def _likeliest(
    sensor: AbstractSensor, candidates: Sequence[_Candidate], shares: Sequence[_Share]
) -> Cause | None:
    """Return the cause that explains most of the squared errors of a `sensor`, if that is enough.

    Causes that explain nearly as much are joined to it by "or". A large error of the scale,
    mounting or skew does not change the readings in proportion to its size, as the shares take it,
    so that it is left out.
    """
    kept = [
        (share, one.name, one.words.format(size=", ".join(f"{x:.2g}" for x in size)), one.remedy)
        for one, (share, size) in zip(candidates, shares, strict=True)
        if one.name not in LINEAR
        or np.abs(size).max() < SMALL
        # A wrong unit, such as g read as m/s², is a large scale error that is the same for all
        # axes.
        or (one.name == "scale" and np.ptp(size) < 0.1 * abs(size.mean()))
    ]
    most = max((share for share, *_ in kept), default=0.0)
    if not most > ENOUGH:
        return None
    best = [row for share, *row in kept if share >= NEARLY * most]
    names, words, remedies = (" or ".join(column) for column in zip(*best, strict=True))
    return _cause_with_share(names, sensor, most, words, remedies)


def _is_vector_error(sensor: AbstractSensor) -> bool:
    return sensor.reading_shape == (3,) and sensor.components == 3


def _candidates(
    model: Model, x: Float[Array, " n"], linear: Linearisation, index: int
) -> list[_Candidate]:
    """Return the possible causes of the errors of a sensor."""
    reading = model.records.readings[index]
    t, shown = np.asarray(model.records.t), np.asarray(reading.values) - linear.raw[index]
    axes = np.broadcast_to(np.eye(3), (*shown.shape, 3))
    turned = np.cross(shown[..., None, :], axes).swapaxes(-1, -2)
    unit, itself = reading.sensor.unit, shown[..., None] * axes
    response = _rate_response(model, x, linear, index)
    rows = (
        ("lag", slope_in_time(model, shown)[..., None], "a clock offset of {size} s",
         "let a Free move the sensor's offset, or the delay of the torque's log"),
        ("bias", axes, f"a bias left out, ({{size}}) {unit}", "let a Free move the sensor's bias"),
        ("scale", itself,
         "scale errors of ({size}) (all equal: a unit, or a clock that runs fast or slow)",
         "look at the sensor's unit, or let a Free move its scale"),
        ("drag", response(-itself), "a torque against the rate, such as drag of the air",
         "add a Damping or QuadraticDamping whose coefficient is free"),
        ("wheel", response(turned), "a constant internal angular momentum, such as a wheel's",
         "add a Flywheel whose momentum is free"),
        ("mounting", turned, "axes turned by ({size}) rad",
         "let a Free move the sensor's mounting, or take a chart of the full tensor"),
        ("skew", np.einsum("rti,ijk->rtjk", shown, SKEW),
         "axes not orthogonal by ({size}) rad", "let a Free move the sensor's skew"),
        ("push", response(axes), "a constant torque in the body's axes",
         "add a ConstantTorque whose value is free"),
        ("drift", axes * (t - t[:, :1])[..., None, None],
         f"a bias that drifts by ({{size}}) {unit} a second",
         "cut the record into pieces with a bias each"),
    )  # fmt: skip
    return [_Candidate(*row) for row in rows]


def _rate_response(
    model: Model, x: Float[Array, " n"], linear: Linearisation, index: int
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from torques τ (R, T, 3, c) to the changes of the body rate by them.

    The change is `Φ(t) ∫ Φ⁻¹ I⁻¹ τ dt`, with the integral from the first time to t, where
    Φ = dΩ/dΩ₀ is the derivative of the rate with respect to the initial rate along the fitted
    motion. It is zero for a sensor that is not a `Gyro`.
    """
    if not isinstance(model.records.readings[index].sensor, Gyro):
        return np.zeros_like
    width, of = part_of_sensor(model, index).model.index.width, model.body_indices
    flow = linear.raw_slopes[index][..., width - 3 : width]
    tensors = np.stack([np.asarray(tensor_of(b)) for b in body_list(model.bodies(x))])
    back = np.linalg.inv(tensors)[np.zeros(model.count, int) if of is None else np.asarray(of)]
    back = np.linalg.pinv(flow) @ back[:, None]
    steps = np.diff(np.asarray(model.records.t), axis=1)[..., None, None]

    def response(torque: np.ndarray) -> np.ndarray:
        pushed = back @ torque
        middle = 0.5 * (pushed[:, 1:] + pushed[:, :-1]) * steps
        return flow @ np.concatenate([0 * pushed[:, :1], np.cumsum(middle, axis=1)], axis=1)

    return response


def _share(
    model: Model,
    noise: Noise,
    linear: Linearisation,
    index: int,
    free_columns: Float[np.ndarray, "records rows m"],
    direction: Float[np.ndarray, "records times k c"],
) -> _Share:
    """Return the fraction of a sensor's squared errors that a cause along `direction` explains.

    The `free_columns` are orthonormal and span all changes of the errors that the parameters can
    make, which are subtracted from directions and errors.
    """
    roots = [np.sqrt(weight)[..., None] for weight in linear.weights]
    errors = [e * root for e, root in zip(linear.errors, roots, strict=True)]
    jitter_error = model.records.readings[index].jitter_error
    changes = scaled_slopes(direction, noise[index], jitter_error)
    scaled = np.asarray(changes) * roots[index][..., None]
    size = np.sqrt(np.sum(scaled**2, axis=(0, 1, 2)))
    size[size == 0] = 1.0
    columns = [np.zeros((*error.shape, size.size)) for error in errors]
    columns[index] = scaled / size

    def residual_of_free(parts: Sequence[np.ndarray], width: int) -> np.ndarray:
        x = np.concatenate([part.reshape(len(part), -1, width) for part in parts], axis=1)
        return (x - free_columns @ (free_columns.swapaxes(1, 2) @ x)).reshape(-1, width)

    u, s, v = np.linalg.svd(residual_of_free(columns, size.size), full_matrices=False)
    projection = np.where(s > APART, u.T @ residual_of_free(errors, 1)[:, 0], 0.0)
    total = float(np.sum(errors[index] ** 2))
    share = min(float(projection @ projection) / total, 1.0)
    return _Share(share, v.T @ (projection / np.maximum(s, APART)) / size)
