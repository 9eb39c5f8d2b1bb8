"""Notebook 8: the spin after a flyby, against point masses whose orbit SciPy integrates."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once
from scipy.integrate import solve_ivp

import rigidjax as rj

NOTEBOOK = Path(__file__).parents[2] / "notebooks" / "08_flyby.ipynb"
MU, DAY, LENGTH = 3.986004418e14, 86400.0, 170.0
MOMENTS = np.array([0.64, 0.97, 1.0])
# Two equal masses on each axis that have these moments, at the size of the asteroid.
SECOND = 0.5 * MOMENTS.sum() - MOMENTS
PLACES = np.concatenate([np.diag(np.sqrt(SECOND)), -np.diag(np.sqrt(SECOND))]) * LENGTH


@pytest.fixture(scope="module")
def path():
    """The hyperbola that the notebook makes, by its own cell."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    (cell,) = ["".join(c["source"]) for c in cells if "class Flyby" in "".join(c["source"])]
    names = dict(jax=jax, jnp=jnp, np=np, eqx=eqx, rj=rj, MU=MU, DAY=DAY, AU=1.495978707e11)
    exec(cell, names)
    return names["path"]


def field(t, y):
    """Place, velocity, the rotation matrix and the angular momentum in space, per unit of mass."""
    r, v, turn, momentum = y[:3], y[3:6], y[6:15].reshape(3, 3), y[15:]
    omega = turn @ ((turn.T @ momentum) / MOMENTS)
    arms = PLACES @ turn.T
    forces = -MU * (r + arms) / np.linalg.norm(r + arms, axis=1)[:, None] ** 3
    torque = np.cross(arms, forces).sum(axis=0) / (2 * LENGTH**2)
    spin = np.cross(omega, turn.T).T
    return np.concatenate([v, -MU * r / np.linalg.norm(r) ** 3, spin.ravel(), torque])


@pytest.mark.long
def test_the_path_is_the_orbit_and_the_published_one(path):
    place, speed = jax.jit(lambda t: jax.jvp(path, (t,), (1.0,)))(0.0)
    # JPL's table of close approaches: 0.000254091 au, 7.42 km/s, 5.84 km/s far away.
    near, fast = np.linalg.norm(place), np.linalg.norm(speed)
    assert abs(near / 1.495978707e11 - 0.000254091) < 5e-9
    assert abs(fast - 7.4225e3) < 1
    assert abs(np.sqrt(fast**2 - 2 * MU / near) - 5.842e3) < 1
    start = np.concatenate([place, speed])
    orbit = lambda t, y: [*y[3:], *(-MU * y[:3] / np.linalg.norm(y[:3]) ** 3)]
    end = solve_ivp(orbit, (0.0, 2 * DAY), start, "DOP853", rtol=1e-12, atol=1e-6).y[:3, -1]
    np.testing.assert_allclose(path(jnp.asarray(2 * DAY)), end, rtol=1e-9)


@pytest.mark.long
def test_the_spin_after_is_that_of_point_masses(path):
    body, ts = rj.Inertia.from_principal(*MOMENTS), jnp.array([-0.5, 0.5]) * DAY
    start = rj.Attitude(jnp.array([0.4, -0.2, 0.8, 0.4]), 5.7e-5 * jnp.array([0.22, 0.05, 0.97]))
    law = rj.torques.GravityGradient(MU, path)
    end = once(lambda s: rj.simulate(body, s, ts, law, rtol=1e-11, atol=1e-15).ys)(start)
    found = rj.spatial_angular_momentum(body, jax.tree.map(lambda leaf: leaf[-1], end))
    place, speed = jax.jit(lambda t: jax.jvp(path, (t,), (1.0,)))(ts[0])
    q = start.q / jnp.linalg.norm(start.q)
    turn = np.asarray(rj.quaternion.to_matrix(q))
    momentum = turn @ (MOMENTS * np.asarray(start.omega))
    y = np.concatenate([place, speed, turn.ravel(), momentum])
    scale = np.concatenate(
        [np.full(3, 1e-3), np.full(3, 1e-7), np.full(9, 1e-13), np.full(3, 1e-18)]
    )
    y = solve_ivp(field, (float(ts[0]), float(ts[1])), y, "DOP853", rtol=1e-12, atol=scale).y[:, -1]
    # What is compared is a change.
    change = np.linalg.norm(y[15:] - momentum) / np.linalg.norm(momentum)
    assert change > 0.1
    np.testing.assert_allclose(found, y[15:], rtol=0, atol=1e-8 * np.linalg.norm(momentum))
    end_turn = rj.quaternion.to_matrix(end.q[-1])
    np.testing.assert_allclose(end_turn, y[6:15].reshape(3, 3), atol=1e-7)
