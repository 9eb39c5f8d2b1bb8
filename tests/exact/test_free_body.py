import os
import sys
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import optimistix as optx
import pytest

import rigidjax.exact as exact
from rigidjax.body.inertia import Inertia
from rigidjax.motion import Attitude, AttitudeEquations, EulerEquations, Rigid, Spin
from rigidjax.motion.torques import ConstantTorque

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "systems")]
import classes
import free_body_mp
import twin

mp.mp.dps = 50
PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
Q0 = np.array([0.5, -0.1, 0.7, 0.5]) / np.linalg.norm([0.5, -0.1, 0.7, 0.5])


def attitude_and_rate(x):
    """(Ixx, Iyy, Izz, Ixy, Ixz, Iyz, Ω, q, t) → (q, Ω) at t."""
    a, b, c, d, e, f = x[:6]
    tensor = jnp.stack([jnp.stack(row) for row in ((a, d, e), (d, b, f), (e, f, c))])
    out = exact.free_body(Inertia(tensor), Attitude(x[9:13], x[6:9]), x[13])
    return jnp.concatenate([out.q, out.omega])


value = jax.jit(jax.vmap(attitude_and_rate))
jacobian = jax.jit(jax.vmap(jax.jacfwd(attitude_and_rate)))


@jax.jit
@jax.vmap
def gradient_and_curvature(x, direction, cotangent):
    return jax.jvp(jax.grad(lambda y: jnp.dot(attitude_and_rate(y), cotangent)), (x,), (direction,))


def inputs(name, count, ts, seed=0, scale=1.0):
    u, w = classes.bodies(name, count, seed)
    x = np.zeros((count, 14))
    x[:, :3], x[:, 6:9], x[:, 9:13] = u * scale, w, Q0
    x[:, 13] = np.resize(ts, count)
    return x


def truth(x):
    x = [c if isinstance(c, mp.mpf) else mp.mpf(float(c)) for c in x]
    tensor = [[mp.mpf(0)] * 3 for _ in range(3)]
    for (i, j), c in zip(PLACES, x[:6], strict=True):
        tensor[i][j] = tensor[j][i] = c
    length = mp.sqrt(sum(c * c for c in x[9:13]))
    q, omega = twin.free_body(tensor, [c / length for c in x[9:13]], x[6:9], x[13])
    return [*q, *omega]


def true_jacobian(x, columns=range(14), step="1e-15"):
    h, x = mp.mpf(step), [c if isinstance(c, mp.mpf) else mp.mpf(float(c)) for c in x]
    rows = []
    for k in columns:
        up, down = list(x), list(x)
        up[k], down[k] = up[k] + h, down[k] - h
        rows.append([(a - b) / (2 * h) for a, b in zip(truth(up), truth(down), strict=True)])
    return np.array(rows, dtype=object).T


def error_in_units(x, got, eps):
    """Error over (what rounding the inputs does + one unit in the result)."""
    ref = truth(x)
    j = true_jacobian(x, columns=(0, 1, 2, 6, 7, 8, 13), step="1e-25")
    moved = np.abs(j.astype(float)) @ np.abs(np.asarray(x, float)[[0, 1, 2, 6, 7, 8, 13]])
    error = np.array([float(abs(mp.mpf(float(a)) - b)) for a, b in zip(got, ref, strict=True)])
    size = np.linalg.norm([float(c) for c in ref[4:]])
    q, omega = eps * np.linalg.norm(moved[HEAD]), eps * np.linalg.norm(moved[TAIL])
    return in_units(error, q, omega, size, row=x, eps=eps)


HEAD, TAIL = slice(0, 4), slice(4, 7)


def in_units(error, q, omega, size, *, row, eps):
    """Error over how far rounding moves q and Ω, by a first derivative or, where that is too much
    of a straight line (within round-off of the separatrix), by rounding the inputs."""
    units = measure(error, q, omega, size, eps)
    if units > 5:
        moves = rounded(row, eps)
        q, omega = (max(np.linalg.norm(d[k]) for d in moves) for k in (HEAD, TAIL))
        units = min(units, measure(error, q, omega, size, eps))
    return units


def test_the_oracle_solves_the_differential_equation():
    # Another method altogether: the Taylor series of Euler's equations, 40 digits.
    inertia = [[1.0, 0.125, 0.0625], [0.125, 1.75, -0.25], [0.0625, -0.25, 2.25]]
    omega = [0.25, -0.5, 0.5]
    a = twin.free_body(inertia, [1, 0, 0, 0], omega, 1.5)
    b = free_body_mp.attitude_and_rate(inertia, [1, 0, 0, 0], omega, 1.5)
    for x, y in zip(a[0] + a[1], b[0] + b[1], strict=True):
        assert abs(x - y) < mp.mpf("1e-33")


@pytest.mark.parametrize("name", classes.NAMES)
def test_right_in_every_class(name):
    # On an unstable axis e^{λt} beats any number of digits, the oracle's too.
    x = inputs(name, 8, [1.0, 3.0, 10.0, 20.0] if name in UNSTABLE else [1.0, 30.0, 1e3, 1e6])
    got = np.asarray(value(jnp.asarray(x)))
    assert np.abs(np.linalg.norm(got[:, :4], axis=1) - 1).max() <= 4e-15
    for row, out in zip(x, got, strict=True):
        # Once the rounding of the input decides the result (an unstable axis), anything goes.
        units = error_in_units(row, out, 2.0**-53)
        assert units < 5, (row, units)


def measure(error, moved_q, moved_omega, size, eps):
    q = np.linalg.norm(error[HEAD]) / (moved_q + eps)
    return max(q, np.linalg.norm(error[TAIL]) / (moved_omega + eps * size + 1e-300))


def rounded(row, eps, count=8):
    """How the result moves when each input is off by up to one rounding."""
    r, there = np.random.default_rng(5), truth(row)
    moves = []
    for signs in r.choice([-1.0, 1.0], (count, 14)):
        off = [mp.mpf(a) * (1 + mp.mpf(eps) * mp.mpf(b)) for a, b in zip(row, signs, strict=True)]
        off[9:13] = [mp.mpf(a) for a in row[9:13]]
        moves.append(np.array([float(a - b) for a, b in zip(truth(off), there, strict=True)]))
    return moves


UNSTABLE = ("axis 2", "near axis 2", "on separatrix")


@pytest.mark.slow
@pytest.mark.parametrize("name", classes.NAMES)
def test_many_bodies_of_every_class(name):
    count = int(os.environ.get("RIGIDJAX_BODIES", "10000"))
    ts = [1.0, 3.0, 10.0, 20.0] if name in UNSTABLE else [1.0, 30.0, 1e3, 1e6]
    x = inputs(name, count, ts, seed=1)
    for dtype, eps in ((np.float64, 2.0**-53), (np.float32, 2.0**-24)):
        rows = x.astype(dtype)
        got = np.asarray(value(jnp.asarray(rows)), float)
        assert np.isfinite(got).all()
        moved = np.abs(np.asarray(jacobian(jnp.asarray(rows.astype(float))))) * np.abs(
            rows[:, None]
        )
        moved = moved.astype(float).sum(2)
        assert np.isfinite(moved).all()
        units = []
        for row, out, m in zip(rows.astype(float), got, moved, strict=True):
            ref = np.array([float(a - mp.mpf(b)) for a, b in zip(truth(row), out, strict=True)])
            # What rounding the input moves beyond a radian is not information any more.
            if eps * np.linalg.norm(m[:4]) > 0.1:
                continue
            size = np.linalg.norm(out[4:])
            q, omega = eps * np.linalg.norm(m[HEAD]), eps * np.linalg.norm(m[TAIL])
            units.append(in_units(ref, q, omega, size, row=row, eps=eps))
        orthogonal = np.abs(np.linalg.norm(got[:, :4], axis=1) - 1).max() / eps
        print(
            f"{name:18} {dtype.__name__} {len(units):6} median {np.median(units or [0]):.2f} "
            f"max {np.max(units or [0]):.1f} |q|-1 {orthogonal:.1f} eps"
        )
        assert not units or np.max(units) <= 5


@pytest.mark.parametrize("scale", [1e-20, 1e37])
def test_any_size_of_body_in_both_precisions(scale):
    x = inputs("triaxial", 8, [1.0, 10.0])
    reference = np.asarray(value(jnp.asarray(x.astype(np.float32).astype(float))))
    big = x.astype(np.float32)
    big[:, :3] *= np.float32(scale)
    out = value(jnp.asarray(big))
    assert out.dtype == jnp.float32
    np.testing.assert_allclose(np.asarray(out), reference, atol=2e-5)
    x[:, :3] *= scale
    np.testing.assert_allclose(
        np.asarray(value(jnp.asarray(x))),
        np.asarray(value(jnp.asarray(inputs("triaxial", 8, [1.0, 10.0])))),
        atol=1e-13,
    )


def test_momentum_in_space_stays():
    x = inputs("triaxial", 64, [1e3])
    out = np.asarray(value(jnp.asarray(x)))

    def momentum(q, body):
        w, v = q[:, :1], q[:, 1:]
        return body + 2 * (w * np.cross(v, body) + np.cross(v, np.cross(v, body)))

    before = momentum(x[:, 9:13], x[:, :3] * x[:, 6:9])
    after = momentum(out[:, :4], x[:, :3] * out[:, 4:])
    assert np.abs(after - before).max() < 4e-15


@pytest.mark.parametrize(
    ("delta", "time"),
    [
        (1e-2, "9.4255178968436496622"),
        (1e-4, "17.402483478546878418"),
        (1e-6, "25.378872335690177766"),
        (1e-8, "33.355261075340701009"),
        (1e-10, "41.331649814973493878"),
        (1e-12, "49.308038554606284377"),
        (1e-14, "57.284427294239074875"),
    ],
)
def test_published_flip_times(delta, time):
    motion = exact.FreeBody(Inertia.from_principal(1.0, 2.0, 3.0), Spin([0.0, 1.0, delta]))
    middle = jax.jit(lambda t: motion(t).omega[1])
    t = float(time)
    t = t - float(middle(t) / jax.jacfwd(middle)(t))
    assert abs(t / float(time) - 1) < 1e-12
    # A quarter of the period, too.
    period = exact.body_period(Inertia.from_principal(1.0, 2.0, 3.0), jnp.array([0.0, 1.0, delta]))
    assert abs(float(period) / 4 / float(time) - 1) < 1e-12


def test_published_detest_b5():
    # y₁' = y₂y₃, y₂' = −y₁y₃, y₃' = −0.51 y₁y₂ with y = (Ω₂/s₂, Ω₁/s₁, Ω₃/s₃).
    i1, i2, i3 = 1.0, 2.0, 2.5
    A, B, C = (i3 - i2) / i1, (i3 - i1) / i2, (i2 - i1) / i3
    s = np.sqrt([0.51 / (B * C), 0.51 / (A * C), 1 / (A * B)])
    start = jnp.asarray(s * np.array([1.0, 0.0, 1.0]))
    omega = exact.free_body(Inertia.from_principal(i1, i2, i3), Spin(start), 20.0).omega
    ref = (-0.34211777540007490653, -0.93965707987292039619, 0.74141265961999530078)
    np.testing.assert_allclose(omega / s, ref, atol=2e-14)


def test_the_quaternion_does_not_jump():
    motion = exact.FreeBody(
        Inertia.from_principal(1.0, 2.0, 3.0), Attitude([1.0, 0, 0, 0], [0.1, 1.0, 0.2])
    )
    q = np.asarray(jax.jit(jax.vmap(motion))(jnp.linspace(-40.0, 40.0, 2001)).q)
    assert (np.sum(q[1:] * q[:-1], axis=1) > 0.99).all()


GRADED = [
    ("triaxial", 1.3),
    ("triaxial", 100.0),
    ("oblate", 5.0),
    ("prolate", 5.0),
    ("sphere", 3.0),
    ("plate", 5.0),
    ("nearly equal", 5.0),
    ("nearly symmetric", 50.0),
    ("axis 1", 3.0),
    ("axis 2", 3.0),
    ("axis 3", 3.0),
    ("near axis 2", 1.0),
    ("on separatrix", 3.0),
    ("rest", 3.0),
    ("slow", 3.0),
]


def test_first_derivatives_in_every_class():
    x = np.concatenate([inputs(name, 2, [t]) for name, t in GRADED])
    got = np.asarray(jacobian(jnp.asarray(x)))
    for k, (row, j) in enumerate(zip(x, got, strict=True)):
        ref = true_jacobian(row, step="1e-22").astype(float)
        error = np.abs(j - ref).max() / np.abs(ref).max()
        assert error < 1e-12, (GRADED[k // 2], error)


@pytest.mark.slow
def test_second_derivatives_in_every_class():
    r = np.random.default_rng(3)
    x = np.concatenate([inputs(name, 1, [t]) for name, t in GRADED])
    v, c = r.normal(size=x.shape), r.normal(size=(len(x), 7))
    gradient, curvature = gradient_and_curvature(*(jnp.asarray(a) for a in (x, v, c)))
    for k, row in enumerate(x):
        h = mp.mpf("1e-10")
        up, down = (
            true_jacobian(
                [mp.mpf(a) + s * h * mp.mpf(b) for a, b in zip(row, v[k], strict=True)],
                step="1e-22",
            )
            for s in (1, -1)
        )
        ref = c[k] @ ((up - down) / (2 * h)).astype(float)
        first = c[k] @ true_jacobian(row, step="1e-22").astype(float)
        assert np.abs(gradient[k] - first).max() < 1e-12 * np.abs(first).max(), GRADED[k]
        error = np.abs(curvature[k] - ref).max() / np.abs(ref).max()
        print(GRADED[k], error)
        assert error < 1e-10, (GRADED[k], error)


def test_float32_derivatives():
    x = np.concatenate([inputs(n, 2, [3.0]) for n in ("triaxial", "oblate", "sphere", "rest")])
    x = x.astype(np.float32)
    ref = np.asarray(jacobian(jnp.asarray(x.astype(float))))
    got = np.asarray(jacobian(jnp.asarray(x)))
    assert got.dtype == np.float32
    assert (np.abs(got - ref).max((1, 2)) / np.abs(ref).max((1, 2))).max() < 1e-4


def _mean_precession(i, omega):
    """2π over the mean rate of the circulated axis about the momentum, by the trapezium rule."""
    momentum = np.diag(i.tensor) * omega
    a, h = 1 / np.diag(i.tensor), np.linalg.norm(momentum)
    circled = 0 if a @ momentum**2 > a[1] * h**2 else 2
    ts = jnp.linspace(0.0, exact.body_period(i, omega), 801)[:-1]
    m = np.asarray(jax.vmap(exact.FreeBody(i, Spin(omega)))(ts).omega) * np.diag(i.tensor)
    others = [k for k in range(3) if k != circled]
    m2 = m[:, others] ** 2
    return 2 * np.pi / (h * (m2 @ a[others] / m2.sum(1)).mean())


@pytest.mark.parametrize("omega", [(1.0, 0.5, 0.2), (0.3, 0.2, 0.9), (0.7, -0.3, 0.2)])
def test_periods(omega):
    i = Inertia.from_principal(1.0, 3.0836, 3.235)
    omega = jnp.asarray(omega)
    period = exact.body_period(i, omega)
    again = exact.free_body(i, Spin(omega), period).omega
    np.testing.assert_allclose(again, omega, atol=1e-14)
    np.testing.assert_allclose(
        exact.precession_period(i, omega), _mean_precession(i, omega), rtol=1e-13
    )
    for function in (exact.body_period, exact.precession_period):
        turn = jnp.array([[0.1, 0.2, -0.1], [0.2, 0.3, 0.15], [-0.1, 0.15, -0.2]])

        def along(e, function=function, turn=turn):
            return function(Inertia(i.tensor + e * turn), omega + e * jnp.array([0.3, -0.2, 0.5]))

        e = 1e-4
        d1 = (8 * (along(e) - along(-e)) - (along(2 * e) - along(-2 * e))) / (12 * e)
        np.testing.assert_allclose(jax.jacfwd(along)(0.0), d1, rtol=1e-8)


def test_periods_where_there_is_none():
    sphere, body = Inertia.from_principal(2.0, 2.0, 2.0), Inertia.from_principal(1.0, 2.0, 2.5)
    still, middle = jnp.zeros(3), jnp.array([0.0, 1.0, 0.0])
    assert exact.body_period(sphere, middle) == jnp.inf == exact.body_period(body, middle)
    assert exact.body_period(body, still) == jnp.inf == exact.precession_period(body, still)
    np.testing.assert_allclose(exact.precession_period(sphere, middle), 2 * np.pi, rtol=1e-15)
    top = Inertia.from_principal(1.0, 2.0, 2.0)
    grad = jax.grad(lambda w: exact.body_period(top, w))(jnp.array([1.0, 0.5, 0.0]))
    np.testing.assert_allclose(grad, [-4 * np.pi, 0.0, 0.0], atol=1e-13)


BODY = Inertia.from_principal(1.0, 2.0, 3.0)
START = Attitude([1.0, 0, 0, 0], [0.0, 1.0, 1e-4])
TERM = diffrax.ODETerm(AttitudeEquations(BODY))


def test_solver_is_exact_at_any_step_both_ways():
    ts = jnp.linspace(0.0, 20.0, 5)
    ref = jax.vmap(exact.FreeBody(BODY, START))(ts)
    sol = diffrax.diffeqsolve(
        TERM, exact.FreeSolver(), 0.0, 20.0, 20.0, START, saveat=diffrax.SaveAt(ts=ts, dense=True)
    )
    np.testing.assert_allclose(sol.ys.omega, ref.omega, atol=1e-14)
    np.testing.assert_allclose(sol.ys.q, ref.q, atol=1e-14)
    np.testing.assert_allclose(sol.evaluate(ts[1]).q, ref.q[1], atol=1e-14)
    end = jax.tree.map(lambda leaf: leaf[-1], ref)
    back = diffrax.diffeqsolve(
        TERM, exact.FreeSolver(), 20.0, 0.0, -6.0, end, saveat=diffrax.SaveAt(ts=ts[::-1])
    )
    np.testing.assert_allclose(back.ys.omega[::-1], ref.omega, atol=1e-10)


def test_solver_finds_an_event():
    event = diffrax.Event(lambda t, y, args, **_: y.omega[1], optx.Newton(1e-9, 1e-9))
    sol = diffrax.diffeqsolve(TERM, exact.FreeSolver(), 0.0, 30.0, 1.0, START, event=event)
    assert abs(float(sol.ts[0]) / 17.402483478546878418 - 1) < 1e-12


def test_solver_adjoints_agree():
    def final(omega, adjoint):
        term = diffrax.ODETerm(EulerEquations(BODY))
        sol = diffrax.diffeqsolve(
            term, exact.FreeSolver(), 0.0, 3.0, 1.0, Spin(omega), adjoint=adjoint
        )
        return sol.ys.omega[0, 0]

    omega = jnp.array([0.2, 1.0, 0.3])
    ref = jax.grad(lambda w: exact.free_body(BODY, Spin(w), 3.0).omega[0])(omega)
    reverse = jax.grad(final)(omega, diffrax.RecursiveCheckpointAdjoint())
    forward = jax.jacfwd(final)(omega, diffrax.ForwardMode())
    np.testing.assert_allclose(reverse, ref, rtol=1e-12)
    np.testing.assert_allclose(forward, ref, rtol=1e-12)


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda: exact.free_body(Inertia(jnp.diag(jnp.array([1.0, 2, -3]))), START, 1.0),
            "positive",
        ),
        (
            lambda: exact.free_body(BODY, Attitude([2.0, 0, 0, 0], [0.0, 1, 0]), 1.0),
            "unit quaternion",
        ),
        (lambda: exact.free_body(BODY, Spin([0.0, jnp.nan, 0]), 1.0), "NaN"),
        (lambda: exact.free_body(BODY, Spin(jnp.ones(3, jnp.float32)), 1.0), "float32"),
        (
            lambda: exact.free_body(
                BODY, Rigid([0.0] * 3, [0.0] * 3, [1.0, 0, 0, 0], [0.0] * 3), 1.0
            ),
            "Rigid",
        ),
        (lambda: exact.free_body(BODY, START, [1.0, 2.0]), "vmap"),
        (
            lambda: exact.FreeSolver().init(
                diffrax.ODETerm(EulerEquations(BODY, ConstantTorque([0.0, 0, 1]))),
                0,
                1,
                START,
                None,
            ),
            "not free",
        ),
    ],
)
def test_mistakes_are_named(call, words):
    with pytest.raises((TypeError, ValueError), match=words):
        call()
