"""Row D5 and the seams of row D4: the closed form at and around the separatrix, both precisions.

The classes of bodies and their bars: tests/exact/test_free_body.py. Here the distance from the
separatrix is a ladder, δ of either sign down to 0, so that a jump at any rung would be seen.
Bar: 1e-13 (1 + λt) in float64, 1e-5 in float32, λ the growth about the middle axis, times how
far rounding of the start carries.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import rigidjax as rj

sys.path.insert(0, str(Path(__file__).parents[1] / "exact"))
import twin

MOMENTS = (1.0, 2.0, 3.0)
# On the separatrix 2T I2 = L²: I1 (I2 − I1) Ω1² = I3 (I3 − I2) Ω3².
DELTAS = [s * 10.0**-k for s in (1, -1) for k in (1, 2, 3, 4, 6, 8, 10, 12, 15)] + [0.0]
BARS = {np.float64: 1e-13, np.float32: 1e-5}


def start(delta):
    """On the separatrix for δ = 0, inside and outside of it for either sign."""
    w3 = 0.4
    w1 = w3 * np.sqrt(
        MOMENTS[2] * (MOMENTS[2] - MOMENTS[1]) / (MOMENTS[0] * (MOMENTS[1] - MOMENTS[0]))
    )
    return np.array([w1 * (1 + delta), 0.7, w3])


def exactly(omega, t):
    with mp.workdps(40):
        q, w = twin.principal(MOMENTS, [1, 0, 0, 0], [float(c) for c in omega], t)
    return np.array([float(c) for c in [*q, *w]])


@pytest.mark.parametrize(
    "dtype",
    [
        pytest.param(np.float64, marks=pytest.mark.slow),
        pytest.param(np.float32, marks=pytest.mark.slow),
    ],
)
def test_d05_no_jump_at_the_separatrix(dtype):
    starts = np.array([start(d) for d in DELTAS]).astype(dtype)
    times = np.array([0.3, 5.0], dtype)
    body = rj.Inertia(jnp.diag(jnp.asarray(MOMENTS, dtype)))
    q = jnp.array([1.0, 0, 0, 0], dtype)

    def end(omega, t):
        found = rj.exact.free_body(body, rj.Attitude(q, omega), t)
        found = jnp.concatenate([found.q, found.omega])
        return found, found

    both = jax.jacfwd(end, has_aux=True)
    slopes, found = jax.jit(jax.vmap(jax.vmap(both, (None, 0)), (0, None)))(starts, times)
    slopes, found = np.asarray(slopes), np.asarray(found)
    assert found.dtype == dtype and np.isfinite(slopes).all()
    # λ = Ω2 √((I2 − I1)(I3 − I2)/(I1 I3)) about the middle axis.
    rate = 1.2 * np.sqrt(1 / 3)
    for i, t in enumerate(times):
        wanted = np.array([exactly(row, float(t)) for row in starts])
        away = np.abs(found[:, i] - wanted).max()
        print(f"D5 {np.dtype(dtype).name} t = {t}: {away:.1e}")
        assert away < BARS[dtype] * (1 + rate * t)
        # Neighbours on the ladder have neighbouring derivatives: no seam.
        near = np.abs(DELTAS) <= (1e-8 if dtype == np.float64 else 1e-12)
        spread = np.ptp(slopes[near, i], axis=0).max() / np.abs(slopes[near, i]).max()
        assert spread < (1e-5 if dtype == np.float64 else 1e-4)
