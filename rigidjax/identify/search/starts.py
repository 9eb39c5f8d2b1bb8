"""Find the starting points of a fit: first by a regression if the data allow it, then by random
scatter.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from rigidjax._types import HasSpin
from rigidjax.body.inertia import Inertia
from rigidjax.identify.data import stacking
from rigidjax.identify.data.recording import Recording, inputs_as_functions
from rigidjax.identify.data.reference_states import rates
from rigidjax.identify.model.charts import BASIS, Bodies
from rigidjax.identify.model.model import Model
from rigidjax.motion import Spin
from rigidjax.motion.torques.base import Torque, evaluate_torque
from rigidjax.motion.torques.inputs import bind
from rigidjax.motion.torques.states import contains_own_states


def starting_points(model: Model, count: int, key: PRNGKeyArray | None) -> list[Float[Array, " n"]]:
    """Return `count` starting points (n,) of a fit, the first one from a regression, the others by
    random scatter.

    The body of the first point comes from `regress_inertia`, if the data allow it, and else from
    `Model.start`. The bodies of the other points lie about the regressed body or all over the chart
    of the body. Their initial rates differ from the measured rates by about a tenth of the typical
    rate. A `Free` starts at its value in the scene. There is only one point if neither a body nor
    initial rates are free.

    - `model`: the readings and the free numbers.
    - `count`: the number of points.
    - `key`: the random key of the scatter; without a key the points are the same at each call.
    """
    recordings = (
        stacking.recordings_on_host(model.records, model.counts) if model.index.bodies else ()
    )
    if isinstance(model.chart, Bodies):
        rows = list(zip(recordings, model.body_names, strict=True))
        bodies_by_name = {
            name: regress_inertia(tuple(record for record, of in rows if of == name), model.torque)
            for name in model.chart.names
        }
        regressed = {n: body for n, body in bodies_by_name.items() if body is not None} or None
    else:
        regressed = regress_inertia(recordings, model.torque) if recordings else None
    start = model.start(regressed)
    bodies, spins = slice(model.index.bodies), np.asarray(model.index.start)[:, -3:]
    # NumPy's random generator is used, since the generator of JAX takes seconds to compile.
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)) if key is not None else 0)
    out = []
    # If neither a body nor initial rates are free, there is nothing to scatter.
    for index in range(count if model.index.bodies or spins.size else 1):
        wide = 0.0 if index == 0 else (0.5 if regressed is not None and index % 2 else 1.5)
        x = np.array(start)
        middle = x[bodies] if (index == 0 or wide < 1) else 0 * x[bodies]
        x[bodies] = middle + wide * rng.normal(size=middle.shape)
        x[spins] += (0.0 if index == 0 else 0.1) * rng.normal(size=spins.shape)
        out.append(jnp.asarray(x, start.dtype))
    return out


def regress_inertia(recordings: tuple[Recording, ...], torque: Torque | None) -> Inertia | None:
    """Return the inertia of a body by a regression on Euler's equations in integral form.

    The equation `I ΔΩ + ∫ Ω × IΩ dt = ∫ τ dt` is linear in the six components of the inertia tensor
    I. Here Ω is the body rate, and ΔΩ its change during the time of the integrals. With a torque τ
    the components are found by least squares. Without a torque they are found up to scale, as the
    right singular vector of the smallest singular value. Principal second moments that are too
    small or negative are raised to 1 % of the largest one, so that the result is a possible body.
    The result is `None` if samples are too few or too far apart, if the torque depends on more than
    time and rate, or if the tensor has no positive trace.

    - `recordings`: recordings of this body, which show its rates.
    - `torque`: the torque on the body, or `None`.
    """
    balances = []
    for recording in recordings:
        t, w = rates(recording)
        if t.size < 10 or np.median(np.diff(t)) * np.linalg.norm(w, axis=1).max() > 0.5:
            return None
        if not depends_on_rate_only(torque):
            return None
        balances.append(integrated_euler_equations(recording, torque, np.eye(3)))
    matrix, side, _ = (np.concatenate(part) for part in zip(*balances, strict=True))
    components, _ = inertia_components_and_feasibility_margin(matrix, side)
    if not components[:3].sum() > 0:
        return None
    tensor = np.einsum("k,kij->ij", components, BASIS)
    values, axes = np.linalg.eigh(0.5 * np.trace(tensor) * np.eye(3) - tensor)
    values = np.maximum(values, 1e-2 * values.max())
    second_moment = (axes * values) @ axes.T
    return Inertia(jnp.asarray(np.trace(second_moment) * np.eye(3) - second_moment))


def inertia_components_and_feasibility_margin(
    matrix: np.ndarray, rhs: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return two things: the components (6,) of an inertia tensor by least squares; and a margin,
    which is positive if a body can have this tensor.

    The components solve `matrix @ components = rhs` in the least-squares sense, with `matrix` (n,
    6) and `rhs` (n,). If `rhs` is zero, the scale of the tensor is unknown, and its trace is set to
    one. The margin is the smallest eigenvalue of the tensor's matrix of second moments, divided by
    the largest magnitude of an eigenvalue.
    """
    if np.abs(rhs).max() > 0:
        components = np.linalg.lstsq(matrix, rhs, rcond=None)[0]
    else:
        components = np.linalg.svd(matrix, full_matrices=False)[2][-1]
        components = components * np.sign(components[:3].sum())
        components = components / components[:3].sum()
    tensor = np.einsum("k,kij->ij", components, BASIS)
    values = np.linalg.eigvalsh(0.5 * np.trace(tensor) * np.eye(3) - tensor)
    return components, float(values[0] / max(np.abs(values).max(), 1e-300))


def depends_on_rate_only(torque: Torque | None) -> bool:
    """Return whether a `torque` depends on time and body rate alone, and has no states of its own;
    true for `None`.
    """
    return torque is None or (
        getattr(torque, "feels", None) is HasSpin and not contains_own_states(torque)
    )


def integrated_euler_equations(
    recording: Recording, torque: Torque | None, rate_matrix: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Euler's equations integrated over a recording, as n linear equations for the six
    components of the inertia tensor.

    The three results are: the matrix (n, 6) of the equations; their right sides (n,), which come
    from the torque; and the part (n, 6) of the matrix that comes from the angular momentum IΩ. The
    other part of the matrix comes from the integral of Ω × IΩ. Here Ω is the body rate and I the
    inertia tensor.

    - `recording`: the recording, which shows the body rates.
    - `torque`: a torque that depends on time and body rate alone, or `None`.
    - `rate_matrix`: (3, 3) a matrix by which the recorded rates are multiplied first.
    """
    t, w = rates(recording)
    w, pushed = w @ rate_matrix.T, np.zeros((t.size, 3))
    if torque is not None:
        pushed = np.asarray(_torques_at(bind(torque, inputs_as_functions(recording)), t, w))
    momenta = np.einsum("kij,tj->tki", BASIS, w)
    turned = np.concatenate([np.cross(w[:, None, :], momenta), pushed[:, None, :]], axis=1)
    steps = 0.5 * (turned[1:] + turned[:-1]) * np.diff(t)[:, None, None]
    integral = np.concatenate([np.zeros_like(turned[:1]), np.cumsum(steps, axis=0)])
    total, impulse = momenta + integral[:, :-1], integral[:, -1:]

    def less_mean(x: np.ndarray) -> np.ndarray:
        # Each integrated equation has an unknown constant of integration. The difference of each
        # sample from the mean over the record does not contain this constant. About sixty samples
        # are enough.
        samples = (x - x.mean(axis=0))[:: max(1, t.size // 60)]
        return samples.transpose(0, 2, 1).reshape(-1, x.shape[1])

    return less_mean(total), less_mean(impulse)[:, 0], less_mean(momenta)


@eqx.filter_jit
def _torques_at(torque: Torque, t: ArrayLike, w: ArrayLike) -> Float[Array, "n 3"]:
    """Return the values (n, 3) of a `torque`, N m, at the times t (n,), s, and the body rates w (n,
    3), rad/s.

    The torque must depend on time and body rate alone. The body is not given, and a body of unit
    inertia takes its place.
    """
    body = Inertia(jnp.eye(3))
    return jax.vmap(lambda time, omega: evaluate_torque(torque, time, Spin(omega), body))(t, w)
