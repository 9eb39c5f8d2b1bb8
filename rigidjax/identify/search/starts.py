"""Find the starting points of a fit: first by a regression if the data allow it, then by random
scatter.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from rigidjax._types import HasSpin
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.body.symmetric3 import from_components
from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Recording, input_functions
from rigidjax.identify.data.reference_states import Samples, rates
from rigidjax.identify.model.charts import BASIS, body_list
from rigidjax.identify.model.first_order import FirstOrder, value_and_jacfwd
from rigidjax.identify.model.model import (
    Model,
    map_recordings,
    parts_of,
    scene_at,
    scene_errors,
)
from rigidjax.identify.model.moment import Moment
from rigidjax.identify.model.priors import pseudo_inertia
from rigidjax.identify.search.noise import initial_noise
from rigidjax.motion import Spin, Turn
from rigidjax.motion.suspension import AbstractSuspension, Law, moment_about
from rigidjax.motion.torques import Carried
from rigidjax.motion.torques.base import evaluate_torque
from rigidjax.motion.torques.inputs import bind
from rigidjax.motion.torques.states import contains_own_states


def starting_points(model: Model, count: int, key: PRNGKeyArray | None) -> list[Float[Array, " n"]]:
    """Return `count` starting points of a fit, the first from a regression, the others by scatter.

    The body of the first point comes from `regress_inertia`, if the data allow it, and else from
    `Model.start`. The bodies of the other points lie about the regressed body or all over the
    chart; their initial rates differ from the measured ones by about a tenth of the typical rate.
    There is only one point if neither a body nor initial rates are free. Without a `key` the points
    are the same at each call.
    """
    kinds = stacking.kinds_of(model)
    found: dict[str, Any] = {}
    # Carried bodies come first. A kind without a torque, which shows the inertia only up to scale,
    # comes last.
    in_order = sorted(kinds, key=lambda one: (one.torque is None) - _is_carried(one))
    for one in in_order if model.index.bodies else ():
        members: dict[str, list[Recording]] = {}
        recordings = stacking.on_host(one.records, one.counts)
        for name, record in zip(one.body_names, recordings, strict=True):
            members.setdefault(name, []).append(record)
        if _is_carried(one):
            mine = carried_bodies(one, list(members))
        else:
            every = ((name, regress_inertia(tuple(r), one.torque)) for name, r in members.items())
            mine = {name: None if one is None else one.body for name, one in every}
        found = {name: body for name, body in mine.items() if body is not None} | found
    swings = [part for part in parts_of(model) if part.model.state_kind is Turn]
    seen: dict[int, Any] = {}
    for part in swings:
        one = part.model
        own = body_list(one.unpack(one.start(_named(one, found))).body)
        own = dict(zip(dict.fromkeys(one.body_names), own, strict=True))
        for row, record in enumerate(stacking.on_host(one.records, one.counts)):
            seen[part.first + row] = swing = _swing(one.torque, record, own[one.body_names[row]])
            if swing is not None:
                found[one.body_names[row]] = swing.body
    regressed = _named(model, found)
    start = np.array(model.start(regressed))
    for part in swings:
        for row, x in enumerate(np.asarray(part.model.index.start)):
            if (swing := seen[part.first + row]) is not None and x.size:
                places = part.take(np.arange(model.size))[x]
                start[places] = swing.angle, swing.rate / float(part.model.reference.rate[row])
    bodies, places = slice(model.index.bodies), np.arange(model.size)
    starts = ((part, np.asarray(part.model.index.start)[:, -3:]) for part in parts_of(model))
    spins = np.concatenate([np.ravel(np.asarray(p.take(places))[rows]) for p, rows in starts])
    # NumPy's random generator is used, since the generator of JAX takes seconds to compile.
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)) if key is not None else 0)
    out = []
    # If neither a body nor initial rates are free, there is nothing to scatter. The readings of a
    # carried body are linear in its numbers: there is one best point.
    sure = all(_is_carried(one) or one.state_kind is Turn for one in kinds)
    sure = sure and None not in seen.values()
    for index in range(count if (model.index.bodies or spins.size) and not sure else 1):
        wide = 0.0 if index == 0 else (0.5 if regressed is not None and index % 2 else 1.5)
        x = np.array(start)
        middle = x[bodies] if (index == 0 or wide < 1) else 0 * x[bodies]
        x[bodies] = middle + wide * rng.normal(size=middle.shape)
        x[spins] += (0.0 if index == 0 else 0.1) * rng.normal(size=spins.shape)
        out.append(jnp.asarray(x, start.dtype))
    return out


def _named(model: Model, bodies: dict[str, Any]) -> Any:
    """Return `bodies` by name as `Model.start` takes them, or `None` for none."""
    if model.body_indices is None:
        return bodies.get("")
    return {name: body for name, body in bodies.items() if name in model.body_names} or None


class _Swing(NamedTuple):
    """Hold a body that swings with the recorded period, and the first angle, rad, and rate."""

    body: Any
    angle: float
    rate: float


def _swing(law: AbstractSuspension, recording: Recording, body: Any) -> _Swing | None:
    """Return where the fit of a swing starts: the body with its moment, the first angle and rate,
    from the period of the rate about the axis of most motion and the angle turned in
    the first period; `None` for a log of less than one period, and for a body that goes over the
    top.
    """
    t, w = rates(recording)
    if t.size < 10:
        return None
    unit = np.asarray(law.unit)
    along = np.linalg.eigh(np.cov(w.T))[1][:, -1]
    even = np.linspace(t[0], t[-1], t.size)
    rate = np.interp(even, t, w @ along * (np.sign(along @ unit) or 1.0))
    period = t[-1] - t[0]
    step = period / (t.size - 1)
    # The period of the whole record, then that of its first ten periods, if friction changes it.
    for _ in range(2):
        few = rate[: max(10, int(10 * period / step))]
        few = few - few.mean()
        size = 1 << (8 * few.size).bit_length()
        power = np.log(np.abs(np.fft.rfft(few * np.hanning(few.size), size)) + 1e-300)
        top = int(np.clip(np.argmax(power), 1, power.size - 2))
        left, middle, right = power[top - 1 : top + 2]
        top += 0.5 * (left - right) / (left - 2 * middle + right)
        period = size * step / top
    # The rate over whole periods is the bias of the gyro, unless the body goes over the top.
    whole = int(int((t[-1] - t[0]) / period) * period / step)
    bias = rate[:whole].mean() if whole else np.inf
    if not abs(bias) * period < 0.5 * np.pi:
        return None
    first = rate[: int(period / step) + 2] - bias
    angles = np.concatenate([[0.0], np.cumsum(0.5 * step * (first[1:] + first[:-1]))])
    amplitude = min(0.5 * np.ptp(angles), 3.0)
    squares, rest, own, moment = map(np.asarray, _squares(law, body, amplitude))
    # The square of the period is linear in the moment.
    factor = 1 + (period**2 - squares[0]) / (squares[1] - squares[0])
    if not np.isfinite(factor):
        return None
    factor = max(factor, 1 - 0.99 * own / moment)
    found = eqx.filter_jit(Moment(body, law).body)(jnp.log(jnp.asarray([factor])))
    return _Swing(found, float(rest - 0.5 * (angles.max() + angles.min())), float(first[0]))


@eqx.filter_jit
def _squares(law: AbstractSuspension, body: Any, amplitude: ArrayLike) -> tuple[Array, ...]:
    """Return the squares of the periods, s², of a body and of one with twice its moment; the angle
    of rest; and the body's moments about its centre of mass and about the axis.
    """
    bodies = [body, Moment(body, law).body(jnp.log(jnp.asarray([2.0])))]
    angles = jnp.linspace(-jnp.pi, jnp.pi, 1441)
    rest = jnp.nanargmin(jax.vmap(lambda angle: law.potential(body, angle))(angles))
    squares = jnp.stack([law.period(one, amplitude) ** 2 for one in bodies])
    return squares, angles[rest], moment_about(law.unit, body), law.moment(body, 0.0)


def _is_carried(model: Model) -> bool:
    return isinstance(model.torque, Carried)


class Regression(NamedTuple):
    """Hold the inertia of a body and the coefficients of further torques on it."""

    body: Inertia
    coefficients: Float[np.ndarray, " k"]


# This maps times (n,) and body rates (n, 3) to k torques (n, 3, k).
TorqueColumns = Callable[[np.ndarray, np.ndarray], np.ndarray]


def regress_inertia(
    recordings: tuple[Recording, ...], torque: Law | None, further: TorqueColumns | None = None
) -> Regression | None:
    """Return the inertia of a body by a regression on Euler's equations in integral form.

    The equation `I ΔΩ + ∫ Ω × IΩ dt = ∫ τ dt` is linear in the six components of I, and in the
    coefficients of `further` torques. Without a `torque` they are found up to scale, as the right
    singular vector of the smallest singular value. Principal second moments that are too small or
    negative are raised to 1 % of the largest one. The result is `None` if samples are too few or
    too far apart, if the torque depends on more than time and rate, or if the tensor has no
    positive trace.
    """
    balances = []
    for recording in recordings:
        t, w = rates(recording)
        if t.size < 10 or np.median(np.diff(t)) * np.linalg.norm(w, axis=1).max() > 0.5:
            return None
        if not rate_only(torque):
            return None
        balances.append(integrated_euler(recording, torque, Samples(t, w), further))
    matrix, side, _ = (np.concatenate(part) for part in zip(*balances, strict=True))
    numbers = solve_inertia(matrix, side).components
    tensor = np.einsum("k,kij->ij", numbers[:6], BASIS)
    if not np.trace(tensor) > 0:
        return None
    values, axes = np.linalg.eigh(0.5 * np.trace(tensor) * np.eye(3) - tensor)
    values = np.maximum(values, 1e-2 * values.max())
    second_moment = (axes * values) @ axes.T
    body = Inertia(jnp.asarray(np.trace(second_moment) * np.eye(3) - second_moment))
    return Regression(body, numbers[6:])


# The place of each of ten numbers in the symmetric matrix ∫ (r, 1)(r, 1)ᵀ dm: second moments about
# the origin of the body frame, mass times centre of mass, and mass.
_TEN = [(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1), (0, 3), (1, 3), (2, 3), (3, 3)]
_UNIT = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
# If this matrix has an eigenvalue below zero, those below this fraction of the largest are raised
# to it: the body is then possible.
_POSSIBLE = 1e-4
# A direction of the ten numbers is not seen below this fraction of the largest singular value.
_SEEN = 1e-12


def carried_bodies(model: Model, names: list[str]) -> dict[str, Any]:
    """Return the bodies of carried recordings, by name, by weighted linear least squares; an
    impossible result is replaced by the body of a pseudo-inertia with positive eigenvalues.
    """
    from scipy.linalg import lstsq

    x, rows = model.start(), np.array([one[0] for one in _TEN])
    columns = np.array([one[1] for one in _TEN])
    value, slope = _linear_errors(model, x)
    errors, slopes = [], []
    for reading, sigma, error, jacobian in zip(
        model.records.readings, initial_noise(model), value, slope, strict=True
    ):
        weights = np.asarray(reading.mask)[..., None] / np.asarray(sigma)[:, None]
        errors.append((weights * error).reshape(model.count, -1))
        slopes.append((weights[..., None] * jacobian).reshape(model.count, -1, 10))
    matrix = np.concatenate(slopes, axis=1)
    # The errors without a body: the numbers of a light one are then not lost beside `_UNIT`.
    side = matrix @ _UNIT - np.concatenate(errors, axis=1)

    def body_of(name: str) -> MassProperties:
        mine = np.array([other == name for other in model.body_names])
        # By QR with pivoting: NumPy's way by singular values takes thirty times as long.
        rows_of_body = matrix[mine].reshape(-1, 10)
        whole = np.zeros((4, 4))

        def solve(side: np.ndarray) -> Any:
            return lstsq(rows_of_body, side, cond=_SEEN, lapack_driver="gelsy")

        ten, _, rank, _ = solve(side[mine].ravel())
        if rank < 10:  # what the motion does not show stays that of the first guess
            guesses = dict(zip(names, body_list(model.bodies(x)), strict=True))
            guess = np.asarray(pseudo_inertia(guesses[name]))[rows, columns]
            ten = guess + solve(side[mine].ravel() - rows_of_body @ guess)[0]
        whole[rows, columns] = whole[columns, rows] = ten
        # Lengths in units of the body's size: the eigenvalues are then alike.
        size = np.sqrt(abs(np.trace(whole[:3, :3]) / whole[3, 3]))
        units = np.array([size, size, size, 1.0])
        values, axes = np.linalg.eigh(whole / np.outer(units, units))
        if not values[0] > 0:
            values = np.maximum(values, _POSSIBLE * np.abs(values).max())
            whole = (axes * values) @ axes.T * np.outer(units, units)
        return _body_of_ten(jnp.asarray(whole[rows, columns]))

    return {name: body_of(name) for name in names}


def _body_of_ten(ten: Float[Array, "10"]) -> MassProperties:
    """Return the body of ten numbers in the order of `_TEN`; its wrench is linear in them."""
    xx, yy, zz, yz, xz, xy = ten[:6]
    com = ten[6:9] / ten[9]
    about_origin = from_components(xx, yy, zz, xy, xz, yz)
    return MassProperties(ten[9], com, about_origin - ten[9] * jnp.outer(com, com))


@eqx.filter_jit
def _linear_errors(model: Model, x: Float[Array, " n"]) -> FirstOrder:
    """Return all errors (R, T, k) for the body `_UNIT`, and their derivative in ten numbers."""

    def of_recording(row: Array, record: Recording, *rest: Any) -> FirstOrder:
        scene = scene_at(model, row, record, *rest)

        def errors(ten: Array) -> tuple[Array, ...]:
            known = dataclasses.replace(scene, body=_body_of_ten(ten))
            return scene_errors(model, known, record)

        return value_and_jacfwd(errors, jnp.asarray(_UNIT, x.dtype))

    return map_recordings(of_recording, model, model.index.rows(x))


class Components(NamedTuple):
    """Hold the six components of an inertia tensor, and the coefficients of further torques."""

    components: Float[np.ndarray, " k"]
    # The smallest eigenvalue of the matrix of second moments, divided by the largest magnitude of
    # one: positive if a body can have this tensor.
    margin: float


def solve_inertia(matrix: Float[np.ndarray, "n k"], rhs: Float[np.ndarray, " n"]) -> Components:
    """Return the inertia tensor that solves `matrix @ components = rhs` by least squares.

    If `rhs` is zero, the scale is unknown, and the trace is set to one.
    """
    if np.abs(rhs).max() > 0:
        components = np.linalg.lstsq(matrix, rhs, rcond=None)[0]
    else:
        components = np.linalg.svd(matrix, full_matrices=False)[2][-1]
        components = components * np.sign(components[:3].sum())
        components = components / components[:3].sum()
    tensor = np.einsum("k,kij->ij", components[:6], BASIS)
    values = np.linalg.eigvalsh(0.5 * np.trace(tensor) * np.eye(3) - tensor)
    return Components(components, float(values[0] / max(np.abs(values).max(), 1e-300)))


def rate_only(torque: Law | None) -> bool:
    """Return whether a `torque` depends on time and body rate alone, without own states."""
    return torque is None or (
        getattr(torque, "feels", None) is HasSpin and not contains_own_states(torque)
    )


class Balance(NamedTuple):
    """Hold the integral of Euler's equations, `matrix @ components = rhs`."""

    matrix: Float[np.ndarray, "n k"]
    # The impulse of the torque.
    rhs: Float[np.ndarray, " n"]
    # The part of the matrix from the angular momentum IΩ; the rest is the integral of Ω × IΩ.
    momenta: Float[np.ndarray, "n 6"]


def integrated_euler(
    recording: Recording,
    torque: Law | None,
    rates: Samples,
    further: TorqueColumns | None = None,
) -> Balance:
    """Return Euler's equations integrated along the body `rates` of a recording, linear in the
    components of the tensor and in the coefficients of `further` torques.
    """
    (t, w), pushed = rates, np.zeros((rates.t.size, 3))
    if torque is not None:
        pushed = np.asarray(_torques(bind(torque, input_functions(recording)), t, w))
    momenta = np.einsum("kij,tj->tki", BASIS, w)
    more = np.zeros((t.size, 3, 0)) if further is None else further(t, w)
    parts = np.cross(w[:, None, :], momenta), -more.swapaxes(1, 2), pushed[:, None, :]
    turned = np.concatenate(parts, axis=1)
    steps = 0.5 * (turned[1:] + turned[:-1]) * np.diff(t)[:, None, None]
    integral = np.concatenate([np.zeros_like(turned[:1]), np.cumsum(steps, axis=0)])
    total, impulse = integral[:, :-1], integral[:, -1:]
    total[:, :6] += momenta

    def less_mean(x: np.ndarray) -> np.ndarray:
        # Each integrated equation has an unknown constant of integration. The difference of each
        # sample from the mean over the record does not contain this constant. About sixty samples
        # are enough.
        samples = (x - x.mean(axis=0))[:: max(1, t.size // 60)]
        return samples.transpose(0, 2, 1).reshape(-1, x.shape[1])

    return Balance(less_mean(total), less_mean(impulse)[:, 0], less_mean(momenta))


@eqx.filter_jit
def _torques(
    torque: Any, t: Float[ArrayLike, " n"], w: Float[ArrayLike, "n 3"]
) -> Float[Array, "n 3"]:
    """Return the values, N m, at the times t, s, and the rates w, rad/s, of a `torque` that does
    not read the body: one of unit inertia takes its place.
    """
    body = Inertia(jnp.eye(3))
    return jax.vmap(lambda time, omega: evaluate_torque(torque, time, Spin(omega), body))(t, w)
