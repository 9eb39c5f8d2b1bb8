"""The lecture notes, eqs 1–53: each holds as `equations.md` says, and each slip fails as printed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rigidjax.rotation import euler, quaternion, so3

PHI, THETA, PSI = 0.4, 1.1, -0.7
C, S = np.cos, np.sin
# Eq 16 as printed, and its cyclic permutations: the passive generators.
PRINTED = -np.asarray(so3.basis())
J = np.asarray(so3.basis())
M = np.asarray(so3.exp(jnp.array([0.3, -0.8, 1.2])))
W = np.array([0.5, -1.0, 2.0])
R1, R2 = np.array([1.0, 2.0, -0.5]), np.array([0.3, -0.7, 1.1])


def close(a, b, atol=1e-15):
    np.testing.assert_allclose(a, b, atol=atol)


def differs(a, b):
    assert abs(np.asarray(a) - b).max() > 0.1


def passive3(angle):
    """Eq 13 as printed."""
    return np.array([[C(angle), S(angle), 0], [-S(angle), C(angle), 0], [0, 0, 1]])


def passive1(angle):
    """Eq 19 as printed."""
    return np.array([[1, 0, 0], [0, C(angle), S(angle)], [0, -S(angle), C(angle)]])


def active(i, angle):
    return np.asarray(so3.exp(angle * jnp.eye(3)[i]))


def test_eqs_1_to_8_a_body_point_is_placed_and_its_shape_kept():
    """x = X + M r'; lengths, angles and linear combinations stay; y' = Mᵀ y undoes y = M y'."""
    turned = [np.asarray(so3.to_world(M, r)) for r in (R1, R2)]
    close(turned[0] @ turned[1], R1 @ R2, 1e-14)
    close(turned[0] @ turned[0], R1 @ R1, 1e-14)
    close(so3.to_world(M, 2 * R1 - R2), 2 * turned[0] - turned[1], 1e-14)
    close(so3.to_body(M, so3.to_world(M, R1)), R1)


def test_eqs_9_to_11_orthogonal_closed_and_det_plus_one():
    close(M.T @ M, np.eye(3))
    N = np.asarray(so3.product(M, active(1, 0.3)))
    close(N.T @ N, np.eye(3))
    close(so3.determinant(M), 1.0)


def test_slip_eq_10_a_reflection_is_orthogonal_but_no_rotation():
    with pytest.raises(ValueError, match="left-handed"):
        so3.check(np.diag([1.0, 1.0, -1.0]))


def test_slip_eqs_13_to_16_the_printed_matrices_are_transposed():
    """With eq 16's J_3 the rotation of eq 13 follows, but eq 33 and eq 43 contradict both."""
    close(jax.scipy.linalg.expm(PHI * PRINTED[2]), passive3(PHI), 1e-15)
    e3 = np.eye(3)[2]
    differs(PRINTED[2] @ R1, np.cross(e3, R1))
    close(J[2] @ R1, np.cross(e3, R1))
    differs(active(2, PHI), passive3(PHI))
    close(active(2, PHI), passive3(PHI).T)
    close(active(2, PHI), [[C(PHI), -S(PHI), 0], [S(PHI), C(PHI), 0], [0, 0, 1]])


def test_slip_eqs_19_20_the_printed_turn_about_axis_1_is_transposed():
    differs(active(0, THETA), passive1(THETA))
    close(active(0, THETA), passive1(THETA).T)


def test_eq_14_the_series_of_the_exponential():
    total, term = np.eye(3), np.eye(3)
    for n in range(1, 30):
        term = term @ (PHI * J[2]) / n
        total = total + term
    close(so3.exp(PHI * jnp.eye(3)[2]), total)


def test_eqs_17_18_rotation_about_any_axis():
    y = np.array([2.0, -1.0, 2.0]) / 3
    general = jax.scipy.linalg.expm(0.9 * np.einsum("i,ijk->jk", y, J))
    close(so3.about_axis(3 * y, 0.9), general, 1e-15)
    close(quaternion.to_matrix(quaternion.about_axis(y, 0.9)), general, 1e-15)


def test_eqs_21_to_29_moving_axes_reverse_the_order():
    """Eq 26, missing in the notes, is M_1' = M_3 exp(θJ1) M_3ᵀ; with it eqs 27–29 follow."""
    m3 = active(2, PHI)
    moved = np.asarray(so3.conjugate(active(0, THETA), m3))
    # It turns about the axis e_1' = M_3 e_1, and leaves that axis alone.
    close(moved @ m3[:, 0], m3[:, 0])
    close(moved, so3.exp(THETA * m3[:, 0]))
    close(m3.T @ moved @ m3, active(0, THETA))
    close(moved @ m3, m3 @ active(0, THETA))
    # The other reading of the gap, M_3ᵀ exp(θJ1) M_3, is a turn about another axis.
    differs(m3.T @ active(0, THETA) @ m3, moved)


def test_eqs_12_30_31_33_the_3_1_3_matrix():
    printed_33 = [
        [C(PHI) * C(PSI) - C(THETA) * S(PHI) * S(PSI), -S(PSI) * C(PHI) - C(THETA) * S(PHI) * C(PSI), S(THETA) * S(PHI)],
        [C(PSI) * S(PHI) + C(THETA) * C(PHI) * S(PSI), -S(PSI) * S(PHI) + C(THETA) * C(PHI) * C(PSI), -S(THETA) * C(PHI)],
        [S(THETA) * S(PSI), S(THETA) * C(PSI), C(THETA)],
    ]  # fmt: skip
    ours = euler.to_matrix(jnp.array([PHI, THETA, PSI]), "ZXZ")
    close(ours, printed_33)
    close(active(2, PHI) @ active(0, THETA) @ active(2, PSI), printed_33)
    # Eq 12, in the order in which the turns are made, each about its axis as already turned.
    first = active(2, PHI)
    second = np.asarray(so3.about_axis(first[:, 0], THETA)) @ first
    third = np.asarray(so3.about_axis(second[:, 2], PSI)) @ second
    close(third, printed_33)


def test_slip_eq_32_the_printed_product_is_not_eq_33():
    ours = np.asarray(euler.to_matrix(jnp.array([PHI, THETA, PSI]), "ZXZ"))
    differs(passive3(PHI) @ passive1(THETA) @ passive3(PSI), ours)
    close(passive3(PHI).T @ passive1(THETA).T @ passive3(PSI).T, ours)


def test_eqs_34_to_36_infinitesimal_rotations_in_the_limit():
    for dt in (1e-3, 1e-4):
        moved = so3.product(so3.exp(dt * W), M)
        assert abs(np.asarray(moved) - (np.eye(3) + dt * so3.hat(W)) @ M).max() < 3 * dt**2


def test_slip_eq_37_the_left_side_is_the_derivative_of_MtM():
    """Printed dI/dt: what vanishes is d(MᵀM)/dt, along a motion that stays on the group."""
    dm = np.asarray(so3.hat(W)) @ M
    close(dm.T @ M + M.T @ dm, np.zeros((3, 3)))
    off = dm + 0.3 * M
    differs(off.T @ M + M.T @ off, np.zeros((3, 3)))


def test_eqs_38_to_44_the_generator_is_antisymmetric_and_w_cross_y():
    hat = np.asarray(so3.hat(W))
    close(hat.T, -hat)
    close(hat, np.einsum("i,ijk->jk", W, J))
    close(hat, [[0, -W[2], W[1]], [W[2], 0, -W[0]], [-W[1], W[0], 0]])
    close(hat @ R1, np.cross(W, R1))
    close(so3.cross(W, R1), np.cross(W, R1))


def test_eqs_45_to_50_rates_in_space_and_body():
    body = M.T @ W
    close(M.T @ so3.hat(W) @ M, so3.hat(body))
    dm = so3.hat(W) @ M
    close(so3.rate(M, body), dm)
    close(so3.world_rate(M, dm), W)
    close(so3.body_rate(M, dm), body)


def test_eq_51_the_cross_product_in_either_frame():
    body = so3.to_body(M, W)
    close(so3.cross(W, so3.to_world(M, R1)), so3.to_world(M, so3.cross(body, R1)))


def test_eqs_52_53_the_basis_is_orthonormal():
    close(0.5 * np.einsum("ikl,jkl->ij", J, J), np.eye(3))
    close([0.5 * np.trace(np.asarray(so3.hat(W)) @ j.T) for j in J], W)
    close(so3.vee(so3.hat(W) + np.diag([1.0, 2.0, 3.0])), W)


def test_eqs_80_to_83_body_rates_of_the_euler_angles():
    """Ω as printed in eqs 81–83, and eq 80 with Ṁ by automatic differentiation."""
    rates = np.array([0.7, -0.3, 1.9])
    a = jnp.array([PHI, THETA, PSI])
    printed = [
        S(THETA) * S(PSI) * rates[0] + C(PSI) * rates[1],
        S(THETA) * C(PSI) * rates[0] - S(PSI) * rates[1],
        C(THETA) * rates[0] + rates[2],
    ]
    close(euler.rates_to_omega(a, rates), printed)
    m, dm = jax.jvp(euler.to_matrix, (a,), (jnp.asarray(rates),))
    close([0.5 * np.trace(m.T @ dm @ j.T) for j in J], printed)
    close(euler.omega_to_rates(a, jnp.asarray(printed)), rates)
