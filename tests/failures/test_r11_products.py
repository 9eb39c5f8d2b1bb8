"""Row R11: products of rotations have no matrix product in them, so TF32 cannot enter.

On a GPU since Ampere a float32 `@` is rounded to ten bits unless one asks otherwise. What is tested
is the compiled program's operations, and the drift under default settings. Bar: R·Rᵀ − 1 after 1e4 products to 1e-5.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.motion.equations import AttitudeEquations

TURN = jnp.array([0.3, -0.2, 0.5], jnp.float32)
BODY = rj.Inertia(jnp.diag(jnp.array([1.0, 2.0, 3.0], jnp.float32)))
START = rj.Attitude(jnp.array([1.0, 0, 0, 0], jnp.float32), TURN)
STEPS = {
    "so3.product": lambda v: rj.so3.product(rj.so3.exp(v), rj.so3.exp(v)),
    "so3.to_world": lambda v: rj.so3.to_world(rj.so3.exp(v), v),
    "so3.log": lambda v: rj.so3.log(rj.so3.exp(v)),
    "so3.project": lambda v: rj.so3.project(rj.so3.exp(v)),
    "quaternion": lambda v: rj.quaternion.rotate(rj.quaternion.exp(v), v),
    "field": lambda v: AttitudeEquations(BODY)(0.0, rj.Attitude(START.q, v), None).omega,
    "closed form": lambda v: rj.exact.free_body(BODY, rj.Attitude(START.q, v), 1.0).q,
}


@pytest.mark.parametrize("name", STEPS)
def test_r11_no_matrix_product(name):
    for function in (STEPS[name], jax.jacfwd(STEPS[name])):
        text = str(jax.make_jaxpr(function)(TURN))
        assert "dot_general" not in text


def test_r11_ten_thousand_products():
    """Plain products miss the bar (the step itself is a rotation to 6e-8 only); projected, not."""
    step = rj.so3.exp(TURN)

    def plain(r, _):
        return rj.so3.product(r, step), None

    def projected(r, _):
        return rj.so3.project(rj.so3.product(r, step)), None

    away = {}
    for turn in (plain, projected):
        run = jax.jit(lambda r, turn=turn: jax.lax.scan(turn, r, length=10_000)[0])
        r = np.asarray(run(jnp.eye(3, dtype=jnp.float32)), float)
        away[turn.__name__] = np.abs(r @ r.T - np.eye(3)).max()
    print(f"R11 {away}")
    assert away["projected"] < 1e-5
    # Round-off alone, 6e-8 a product at most: TF32's 1e-3 would be 1 by now.
    assert away["plain"] < 6e-8 * 10_000
