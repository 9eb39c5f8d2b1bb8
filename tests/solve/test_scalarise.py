"""A field rewritten on scalars is the same function, whatever it is made of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.solve import components
from rigidjax.solve.scalarise import scalarise


@jax.custom_jvp
def odd(x):
    return jnp.sum(x**2)


@odd.defjvp
def _odd_jvp(primals, tangents):
    # Wrong on purpose: it must be this rule that is used, not the derivative of the body.
    return odd(*primals), 7.0 * jnp.sum(tangents[0])


TABLE = jnp.arange(200.0).reshape(100, 2)
MATRIX = jnp.asarray(np.random.default_rng(0).normal(size=(3, 4)))
FUNCTIONS = {
    "elementwise": lambda v, m: jnp.sin(v) * jnp.exp(-(v**2)) + jnp.where(v > 0, v, 2.0 * v) ** 3,
    "products": lambda v, m: m @ v + jnp.cross(v, m[0]) + jnp.einsum("ij,j->i", m.T, v) + jnp.dot(v, v),
    "matrices": lambda v, m: jnp.trace(m @ m.T) + (m @ MATRIX).sum(axis=0)[::-1],
    "moves": lambda v, m: jnp.concatenate([m.reshape(9)[2:7:2], jnp.roll(v, 1), m.T[1], jnp.flip(v)]),
    "reductions": lambda v, m: jnp.stack([jnp.linalg.norm(v), m.max(), jnp.mean(m), jnp.prod(v), v.argmax().astype(v.dtype)]),
    "tables": lambda v, m: jnp.interp(v, TABLE[:, 0], TABLE[:, 1]) + TABLE[3, 1],
    "indices": lambda v, m: m[jnp.array([2, 0]), 1] + v.at[1].set(5.0)[:2],
    "branches": lambda v, m: jax.lax.cond(v[0] > 0, lambda u: u, lambda u: -2.0 * u, v),
    "loops": lambda v, m: jax.lax.fori_loop(0, 5, lambda i, u: 0.5 * u + v, v),
    "scans": lambda v, m: jax.lax.scan(lambda c, row: (c + row, c * row), v, m)[1],
    "rules": lambda v, m: odd(v) * v,
    "solve": lambda v, m: jnp.linalg.solve(m + 5.0 * jnp.eye(3), v),
    "rotations": lambda v, m: rj.quaternion.rotate(rj.quaternion.exp(v), m[1]),
    "constant": lambda v, m: jnp.zeros(3),
}  # fmt: skip
VECTOR = jnp.array([0.3, -0.7, 1.2])
SQUARE = jnp.asarray(np.random.default_rng(1).normal(size=(3, 3)))


@pytest.mark.oldest
@pytest.mark.parametrize("function", list(FUNCTIONS.values()), ids=list(FUNCTIONS))
def test_values_and_derivatives_are_the_same(function):
    def through(v, m):
        like = jax.eval_shape(function, v, m)
        numbers = scalarise(function, v, m)(*components.split((v, m)))
        return components.join(numbers, like)

    def all_of(f):
        return lambda v, m: (
            f(v, m),
            jax.jacfwd(f)(v, m),
            jax.vmap(f, (0, None))(jnp.stack([v, -v]), m),
        )

    found = jax.jit(all_of(through))(VECTOR, SQUARE)
    wanted = jax.jit(all_of(function))(VECTOR, SQUARE)
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)


def test_parameters_are_differentiated_and_precision_is_kept():
    def end(k, v):
        return scalarise(lambda u: k * u, v)(*components.split(v))[2]

    assert float(jax.grad(end)(3.0, VECTOR)) == float(VECTOR[2])
    single = VECTOR.astype(jnp.float32)
    assert all(
        x.dtype == jnp.float32 for x in scalarise(jnp.sin, single)(*components.split(single))
    )


def test_trees_come_back_as_they_were():
    tree = {
        "a": jnp.arange(6.0).reshape(2, 3),
        "b": jnp.array(1.0),
        "c": jnp.zeros((0, 3)),
        "d": jnp.ones(50),
    }
    parts = components.split(tree)
    assert len(parts) == 8
    back = components.join(parts, tree)
    assert jax.tree.all(jax.tree.map(lambda x, y: bool((x == y).all()), back, tree))


def test_the_field_of_a_top_leaves_no_array_behind():
    # The point of it all: nothing but scalars inside the loop.
    top = rj.torques.HeavyTop(1.0, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
    field = rj.AttitudeEquations(rj.Inertia.from_principal(1.0, 1.3, 0.7), top)
    y0 = rj.Attitude([1.0, 0, 0, 0], [0.3, 0.2, 5.0])
    numbers = scalarise(lambda t, y: field(t, y, None), jnp.zeros(()), y0)
    jaxpr = jax.make_jaxpr(lambda *a: numbers(*a))(jnp.zeros(()), *components.split(y0))
    assert {v.aval.shape for e in jaxpr.eqns for v in e.outvars} == {()}
