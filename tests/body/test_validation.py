"""Every public function that takes an inertia refuses what is no body, known or traced."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import body as bodies, identify, lagrangian, torques
from rigidjax.body import validation
from rigidjax.frames.libration import libration, libration_integral
from rigidjax.plot import inertia_ellipsoid, phase_portrait, polhode, tumble
from rigidjax.workprecision import BenchmarkScene

SKEW = np.array([[2.0, 0.3, 0.0], [0.1, 2.4, -0.2], [0.0, -0.2, 2.9]])
LONG = np.diag([0.7, 0.9, 2.0])
GOOD = np.diag([1.9, 2.4, 2.9])
NO_BODY = {"skew": (SKEW, "symmetric matrix"), "long": (LONG, "triangle inequality")}
OMEGA = np.array([0.3, -0.8, 0.5])
SPIN, TURN = rj.Spin(OMEGA), rj.Attitude([1.0, 0.0, 0.0, 0.0], OMEGA)
TOP = torques.HeavyTop(1.0, [0.0, 0.0, 0.5], [0.0, 0.0, -9.81])
DAMPING = torques.Damping([0.1, 0.2, 0.1])
TIMES = [0.0, 0.5, 1.0]
MANY = rj.Attitude(jnp.tile(jnp.eye(4)[0], (2, 1)), jnp.tile(OMEGA, (2, 1)))
STATES = rj.Attitude(jnp.tile(jnp.eye(4)[0], (3, 1)), jnp.tile(OMEGA, (3, 1)))


def _many(body):
    """A good body, and this one."""
    return rj.Inertia(jnp.stack([jnp.asarray(GOOD), body.tensor]))


# Under a trace: functions of numbers give NaN, a run raises; the rest works with known bodies only.
NAN = {
    "kinetic_energy": lambda b: rj.kinetic_energy(b, SPIN),
    "angular_momentum": lambda b: rj.angular_momentum(b, SPIN),
    "spatial_angular_momentum": lambda b: rj.spatial_angular_momentum(b, TURN),
    "energy": lambda b: rj.energy(b, TURN, TOP),
    "conserved": lambda b: rj.conserved(b, SPIN)["momentum_squared"],
    "free_body": lambda b: rj.exact.free_body(b, SPIN, 2.0).omega,
    "FreeBody": lambda b: rj.exact.FreeBody(b, SPIN).at(jnp.array([1.0])).omega,
    "body_period": lambda b: rj.exact.body_period(b, OMEGA),
    "EulerAngleTop": lambda b: lagrangian.EulerAngleTop(b)(jnp.ones(3), jnp.ones(3)),
    "RotationalHamiltonian": lambda b: lagrangian.RotationalHamiltonian(b)(OMEGA),
    "libration_integral": lambda b: libration_integral(TURN, b, 0.1),
}
RAISED = {
    "simulate": lambda b: rj.simulate(b, SPIN, [0.0, 1.0], DAMPING).ys.omega,
    "simulate, free": lambda b: rj.simulate(b, SPIN, [0.0, 1.0]).ys.omega,
    "ellipsoid": lambda b: bodies.ellipsoid(b, "energy", 1.0)[0],
}
KNOWN = {
    "crossings": lambda b: rj.crossings(
        b, SPIN, 0.0, 20.0, lambda t, s, b: s.omega[0], max_crossings=2
    ),
    "equations_of_motion": lambda b: rj.equations_of_motion(b, SPIN),
    "Known": identify.Known,
    "Entropic": lambda b: identify.Entropic(b, 1.0),
    "Scene": lambda b: BenchmarkScene("x", "x", b, TURN, None, 1.0),
    "inertia_ellipsoid": inertia_ellipsoid,
    "tumble": lambda b: tumble(b, TIMES, STATES),
    "polhode": lambda b: polhode(b, STATES),
    "phase_portrait": lambda b: phase_portrait(b, TOP, STATES),
    "without_wheels": lambda b: torques.ReactionWheels([[0.0, 0, 1]], [0.1], [3.0]).without_wheels(
        b
    ),
    "start": lambda b: _problem().start(b),
}
BATCH = {
    "rollout": lambda b: rj.batch.rollout(_many(b), MANY, 0.1, 3).omega,
    "batch.simulate": lambda b: rj.batch.simulate(_many(b), MANY, [0.0, 1.0]).ys.omega[:, -1],
    "batch.simulate, forced": lambda b: rj.batch.simulate(
        _many(b), MANY, [0.0, 1.0], DAMPING
    ).ys.omega[:, -1],
}


def _problem():
    record = identify.Recording([0.0, 1.0], (identify.Gyro(0.1), np.tile(OMEGA, (2, 1))))
    return identify.Model(record, identify.Ratios())


@pytest.mark.parametrize("kind", NO_BODY)
@pytest.mark.parametrize("door", NAN | RAISED | KNOWN | BATCH)
def test_known_numbers_of_no_body_are_refused(door, kind, unhooked):
    tensor, words = NO_BODY[kind]
    call = (NAN | RAISED | KNOWN | BATCH)[door]
    with pytest.raises(ValueError, match=words + (".*this is body 1" if door in BATCH else "")):
        call(rj.Inertia(tensor))


@pytest.mark.parametrize("door", NAN)
def test_traced_numbers_of_no_body_are_nan(door):
    run = jax.jit(lambda tensor: NAN[door](rj.Inertia(tensor)))
    assert bool(jnp.isfinite(run(GOOD)).all())
    for tensor, _ in NO_BODY.values():
        assert bool(jnp.isnan(run(tensor)).all())


@pytest.mark.parametrize("door", RAISED)
def test_a_run_of_traced_numbers_of_no_body_raises(door):
    run = eqx.filter_jit(lambda tensor: RAISED[door](rj.Inertia(tensor)))
    assert bool(jnp.isfinite(run(jnp.asarray(GOOD))).all())
    for tensor, words in NO_BODY.values():
        with pytest.raises(RuntimeError, match=words):
            run(jnp.asarray(tensor))


@pytest.mark.parametrize("door", BATCH)
def test_in_a_traced_batch_the_others_keep_their_motion(door):
    run = jax.jit(lambda tensor: BATCH[door](rj.Inertia(tensor)))
    good = run(GOOD)
    assert bool(jnp.isfinite(good).all())
    for tensor, _ in NO_BODY.values():
        found = run(tensor)
        assert bool(jnp.isnan(found[1]).all())
        np.testing.assert_array_equal(found[0], good[0])


@pytest.mark.parametrize("function", [bodies.principal, lambda a: rj.Inertia(a).moments])
def test_a_matrix_that_is_not_symmetric_has_no_principal_axes(function, unhooked):
    with pytest.raises(ValueError, match=r"symmetric matrix.*largest difference 0\.2"):
        function(jnp.asarray(SKEW))
    assert bool(jnp.isnan(jax.jit(function)(SKEW)[0]).all())
    with pytest.raises(ValueError, match="symmetric matrix"):
        bodies.matrix_function(jnp.sqrt, SKEW)
    # The moments of what is no body are still numbers.
    np.testing.assert_allclose(rj.Inertia(LONG).moments, [0.7, 0.9, 2.0])


def test_faults_agree_with_eigenvalues():
    rng = np.random.default_rng(5)
    turns = np.linalg.qr(rng.normal(size=(5000, 3, 3)))[0]
    moments = rng.uniform(-0.1, 1.0, (5000, 3))
    size = 10.0 ** rng.uniform(-30, 30, 5000)
    tensors = np.einsum("nij,nj,nkj->nik", turns, moments, turns) * size[:, None, None]
    least, middle, largest = np.sort(moments).T
    broken = largest > least + middle
    flat, bad, skew = validation._faults(
        np, 0.5 * (tensors + tensors.swapaxes(1, 2)), allow_zero_moment=False
    )
    np.testing.assert_array_equal(bad | flat, broken)
    assert not skew.any()
    first = int(np.argmax(broken))
    assert validation.first_impossible_inertia(jnp.asarray(tensors)) == first
    assert validation.first_impossible_inertia(jnp.asarray(tensors[: first + 1])) == first
    assert validation.first_impossible_inertia(jnp.asarray(tensors[~broken])) == -1


def test_bodies_of_zero_moments_and_rounded_plates_have_energy():
    assert float(rj.kinetic_energy(rj.Inertia(jnp.zeros((3, 3))), SPIN)) == 0
    plate = rj.Inertia(jnp.diag(jnp.array([0.1, 0.2, 0.3], jnp.float32)))
    assert float(jax.jit(rj.kinetic_energy)(plate, rj.Spin(jnp.ones(3, jnp.float32)))) > 0


def test_a_plate_in_single_precision_moves_in_a_rollout_of_double_precision():
    plate = rj.Inertia(jnp.diag(jnp.array([0.1, 0.2, 0.3], jnp.float32)))
    wide = rj.Inertia(jnp.diag(jnp.array([0.1, 0.2, 0.3])))
    truth = rj.simulate(wide, rj.Attitude(MANY.q[0], MANY.omega[0]), [0.0, 1.0]).ys.omega[-1]
    for body in (plate, rj.Inertia(jnp.stack([plate.tensor] * 2))):
        found = rj.batch.rollout(body, MANY, 0.01, 100).omega
        np.testing.assert_allclose(found[1], truth, rtol=1e-6)


def test_a_derivative_by_a_tensor_passes_the_check():
    energy = lambda a: rj.kinetic_energy(rj.Inertia(a), OMEGA)
    wanted = 0.5 * np.outer(OMEGA, OMEGA)
    for gradient in (jax.grad(energy), jax.jit(jax.grad(energy)), jax.jacfwd(energy)):
        np.testing.assert_allclose(gradient(jnp.asarray(GOOD)), wanted, rtol=1e-15)


def test_libration_of_a_known_body_is_refused_once_for_all_steps():
    with pytest.raises(ValueError, match="symmetric matrix"):
        rj.simulate(rj.Inertia(SKEW), TURN, [0.0, 1.0], libration(0.1))
