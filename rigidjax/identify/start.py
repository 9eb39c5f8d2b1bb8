"""Where a fit starts: a linear regression where the data allow it, and scattered points around."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from rigidjax.body.inertia import Inertia
from rigidjax.identify.problem import Parameters, Problem, attitude_rate
from rigidjax.identify.recording import Recording
from rigidjax.identify.sensors import Gyro


def starting_points(problem: Problem, count: int, key: PRNGKeyArray) -> list[Parameters]:
    """`count` starting points, the most informed first.

    **Arguments:** `problem`; `count` ≥ 1; `key` a JAX random key. The first body rate is the first
    reading (or the first two attitudes over their time). The inertia is the regression on Euler's
    equations where a gyro sampled them finely enough, else a sphere; further starts scatter the
    shape over the whole chart and the rate by a tenth.
    """
    rate = _first_rate(problem.recording) / float(problem.typical_rate)
    regressed = regress_inertia(problem.recording)
    centre = np.zeros(problem.body.size)
    if regressed is not None:
        centre = np.asarray(problem.body.vector(regressed))
    turn = None if problem.reference is None else jnp.zeros(3)
    out = []
    for index in range(count):
        shape_key, rate_key, key = jax.random.split(key, 3)
        wide = 0.0 if index == 0 else (0.5 if regressed is not None and index % 2 else 1.5)
        middle = centre if (index == 0 or wide < 1) else 0 * centre
        body = middle + wide * jax.random.normal(shape_key, centre.shape)
        spin = rate + (0.0 if index == 0 else 0.1) * jax.random.normal(rate_key, (3,))
        out.append(Parameters(jnp.asarray(body), jnp.asarray(spin), turn))
    return out


def regress_inertia(recording: Recording) -> Inertia | None:
    """The inertia, up to scale, that Euler's equations fit best in integral form.

    Between two samples `I ΔΩ + ∫ Ω × IΩ dt = 0` is linear in the six components of I; the smallest
    right singular vector of all such rows is the answer, moved to the nearest second moment whose
    eigenvalues are positive. `None` where no gyro was there, or sampled too coarsely.
    """
    gyro = [r for r in recording.readings if isinstance(r.sensor, Gyro)]
    if not gyro:
        return None
    seen = gyro[0].seen
    t, w = np.asarray(recording.t)[seen], np.asarray(gyro[0].values)[seen]
    if t.size < 10 or np.median(np.diff(t)) * np.linalg.norm(w, axis=1).max() > 0.5:
        return None
    stride = max(1, t.size // 60)
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
        basis[k, i, j] = basis[k, j, i] = 1.0
    momenta = np.einsum("kij,tj->tki", basis, w)
    flux = np.cross(w[:, None, :], momenta)
    steps = 0.5 * (flux[1:] + flux[:-1]) * np.diff(t)[:, None, None]
    total = momenta + np.concatenate([np.zeros((1, 6, 3)), np.cumsum(steps, axis=0)])
    # What is conserved is constant: compare with its mean over the record.
    rows = (total - total.mean(axis=0))[::stride].transpose(0, 2, 1).reshape(-1, 6)
    components = np.linalg.svd(rows, full_matrices=False)[2][-1]
    tensor = np.einsum("k,kij->ij", components, basis)
    tensor = tensor * np.sign(np.trace(tensor)) / abs(np.trace(tensor))
    values, axes = np.linalg.eigh(0.5 * np.trace(tensor) * np.eye(3) - tensor)
    values = np.maximum(values, 1e-3)
    second_moment = (axes * values) @ axes.T
    return Inertia(jnp.asarray(np.trace(second_moment) * np.eye(3) - second_moment))


def _first_rate(recording: Recording) -> np.ndarray:
    for reading in recording.readings:
        if isinstance(reading.sensor, Gyro):
            return np.asarray(reading.values[int(np.argmax(reading.seen))])
    return attitude_rate(recording)
