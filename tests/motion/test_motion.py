"""Equations of motion against closed forms, and that a scene pays only for what it has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.motion.equations import AttitudeEquations, EulerEquations, NewtonEuler

TENSOR = np.array([[1.0, 0.1, -0.05], [0.1, 1.6, 0.2], [-0.05, 0.2, 2.1]])
OMEGA = np.array([0.9, -1.1, 0.4])
Q = np.array([0.8, -0.2, 0.4, 0.4])
Q = Q / np.linalg.norm(Q)


def test_euler_equations_are_the_textbook_ones():
    i1, i2, i3 = 1.0, 1.7, 2.2
    found = EulerEquations(rj.Inertia.from_principal(i1, i2, i3))(0.0, rj.Spin(OMEGA)).omega
    a, b, c = OMEGA
    wanted = [(i2 - i3) / i1 * b * c, (i3 - i1) / i2 * c * a, (i1 - i2) / i3 * a * b]
    np.testing.assert_allclose(found, wanted, rtol=1e-15)


def test_full_tensor_against_numpy():
    torque = np.array([0.2, -0.1, 0.5])
    field = EulerEquations(rj.Inertia(TENSOR), rj.torques.ConstantTorque(torque))
    wanted = np.linalg.solve(TENSOR, torque - np.cross(OMEGA, TENSOR @ OMEGA))
    np.testing.assert_allclose(field(0.0, rj.Spin(OMEGA)).omega, wanted, rtol=1e-14)


def test_kinematics_is_the_derivative_of_the_attitude():
    # dM/dt = M J' (notes, eq 50): the matrix of q(t) turns with Ω in body axes.
    rate = AttitudeEquations(rj.Inertia(TENSOR))(0.0, rj.Attitude(Q, OMEGA)).q
    _, matrix_rate = jax.jvp(rj.quaternion.to_matrix, (jnp.asarray(Q),), (rate,))
    wanted = rj.quaternion.to_matrix(jnp.asarray(Q)) @ rj.so3.hat(jnp.asarray(OMEGA))
    np.testing.assert_allclose(matrix_rate, wanted, atol=1e-15)
    assert abs(float(rate @ Q)) < 1e-16


def test_newton_euler_turns_as_attitude_and_moves_straight():
    body = rj.MassProperties(2.0, jnp.zeros(3), rj.Inertia(TENSOR).second_moment)
    state = rj.Rigid([1.0, 2, 3], [4.0, 5, 6], Q, OMEGA)
    found = NewtonEuler(body)(0.0, state)
    turning = AttitudeEquations(rj.Inertia(TENSOR))(0.0, rj.Attitude(Q, OMEGA))
    np.testing.assert_array_equal(found.x, state.v)
    np.testing.assert_array_equal(found.v, jnp.zeros(3))
    np.testing.assert_allclose(found.q, turning.q, rtol=1e-15)
    np.testing.assert_allclose(found.omega, turning.omega, rtol=1e-14)


def _operations(field, state):
    compiled = jax.jit(lambda y: field(0.0, y, None)).lower(state).compile()
    analysis = compiled.cost_analysis()
    return (analysis[0] if isinstance(analysis, list) else analysis)["flops"]


def test_a_scene_pays_only_for_what_it_has():
    inertia = rj.Inertia(TENSOR)
    body = rj.MassProperties(2.0, jnp.zeros(3), inertia.second_moment)
    damping = rj.torques.Damping(jnp.ones(3))
    spin, attitude = rj.Spin(OMEGA), rj.Attitude(Q, OMEGA)
    rigid = rj.Rigid([1.0, 2, 3], [4.0, 5, 6], Q, OMEGA)
    free = _operations(EulerEquations(inertia), spin)
    assert free < _operations(EulerEquations(inertia, damping), spin)
    assert free < _operations(AttitudeEquations(inertia), attitude)
    numbers = [sum(leaf.size for leaf in jax.tree.leaves(s)) for s in (spin, attitude, rigid)]
    assert numbers == [3, 7, 13]
    turning = _operations(AttitudeEquations(inertia), attitude)
    top = rj.torques.HeavyTop(1.0, [0.0, 0, 1], [0.0, 0, -9.81])
    assert turning < _operations(AttitudeEquations(inertia, top), attitude)
    # A body that moves freely pays nothing for forces; one in uniform gravity next to nothing.
    moving = _operations(NewtonEuler(body), rigid)
    assert moving == turning
    fall = rj.torques.UniformGravity([0.0, 0, -9.81])
    assert moving <= _operations(NewtonEuler(body, fall), rigid) < moving + 20
    field = NewtonEuler(body, damping)
    assert _operations(AttitudeEquations(inertia), attitude) < _operations(field, rigid)


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: rj.Spin([1.0, 2.0]), r"omega: wanted shape \(3,\), got \(2,\)"),
        (lambda: rj.Attitude([1.0, 0, 0], OMEGA), r"q: wanted shape \(4,\), got \(3,\); .*\(w, x, y, z\)"),
        (lambda: rj.Spin(jnp.ones(3, jnp.float16)), "float16.*half precision"),
        (lambda: rj.Spin("fast"), "omega: wanted"),
        (lambda: rj.Spin([1.0 + 2j, 0, 0]), "got complex128"),
        (lambda: rj.torques.Damping(1.0), r"coefficient: wanted shape \(3,\), got \(\)"),
    ],
)  # fmt: skip
def test_states_refuse_in_words(make, words):
    with pytest.raises((TypeError, ValueError), match=words):
        make()


def test_integers_become_floats():
    assert rj.Spin([1, 2, 3]).omega.dtype == jnp.float64
