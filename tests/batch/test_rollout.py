"""Equal steps for many bodies: the same steps as diffrax's, exact derivatives, bad bodies alone."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

import rigidjax as rj
from rigidjax.batch.sharding import divide_batch, map_bodies
from rigidjax.motion.equations import AttitudeEquations
from rigidjax.solve import fixed

KUTTA = rj.solvers.RungeKutta4()
TOP = rj.torques.HeavyTop(1.0, [0.1, 0.2, 1.0], [0.0, 0.0, -1.0])
GYROSTAT = rj.torques.Sum(
    rj.torques.Damping([0.01, 0.02, 0.03]), rj.torques.Flywheel([0.0, 0.1, 0.3])
)


def batch(count, seed=0, dtype=jnp.float64):
    """Bodies in any orientation, moments 1 to 1.9, |Ω| = 1."""
    rng = np.random.default_rng(seed)
    moments = rng.uniform(1.0, 1.9, (count, 3))
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    tensor = np.einsum("nij,nj,nkj->nik", axes, moments, axes)
    tensor = (tensor + tensor.transpose(0, 2, 1)) / 2
    omega, q = rng.normal(size=(count, 3)), rng.normal(size=(count, 4))
    omega /= np.linalg.norm(omega, axis=1)[:, None]
    q /= np.linalg.norm(q, axis=1)[:, None]
    array = lambda a: jnp.asarray(a, dtype)
    return rj.Inertia(array(tensor)), rj.Attitude(array(q), array(omega))


def far(a, b):
    parts = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(float(jnp.abs(x - y).max()) for x, y in parts)


@pytest.mark.parametrize(
    ("torque", "method"),
    [
        pytest.param(TOP, KUTTA, id="top"),
        pytest.param(GYROSTAT, rj.solvers.Magnus4(), id="gyrostat"),
        pytest.param(None, rj.solvers.Magnus4(), id="free", marks=pytest.mark.slow),
        pytest.param(TOP, rj.solvers.DormandPrince8(), id="top-8", marks=pytest.mark.slow),
        pytest.param(None, rj.solvers.Tsitouras5(), id="free-5", marks=pytest.mark.slow),
    ],
)
def test_steps_are_diffraxs(torque, method):
    bodies, states = batch(3)

    def one(body, state):
        field = AttitudeEquations(body, torque)
        return dfx.diffeqsolve(
            dfx.ODETerm(field), method, 0.0, 1.2, 0.1, state,
            stepsize_controller=dfx.ConstantStepSize(),
        ).ys  # fmt: skip

    theirs = jax.tree.map(lambda a: a[:, 0], jax.jit(jax.vmap(one))(bodies, states))
    ours = rj.batch.rollout(bodies, states, 0.1, 12, torque, solver=method)
    assert far(ours, theirs) < 2e-15  # measured 7e-16


def test_error_of_the_free_body_is_below_kuttas():
    # The bar of the issue: RK4's 4.8e-10 at T = 10, h = 0.01. Oracle: the closed form.
    bodies, states = batch(256)
    truth = once(jax.vmap(lambda b, s: rj.exact.free_body(b, s, 10.0)))(bodies, states)
    errors = []
    for count in (500, 1000):
        found = rj.batch.rollout(bodies, states, 10.0 / count, count)
        between = jax.vmap(lambda a, b: rj.quaternion.multiply(rj.quaternion.conjugate(a), b))
        off = 2 * jnp.linalg.norm(between(found.q, truth.q)[:, 1:], axis=1)
        errors.append(float(jnp.max(off)))
    assert errors[-1] < 4.8e-10
    assert errors[-1] < 3e-11
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.1)


def test_magnus_order_under_a_torque_and_length():
    bodies, states = batch(4)
    fine = rj.batch.rollout(bodies, states, 0.005, 400, GYROSTAT, solver=KUTTA)
    coarse = [far(rj.batch.rollout(bodies, states, 2.0 / n, n, GYROSTAT), fine) for n in (20, 40)]
    assert np.log2(coarse[0] / coarse[1]) == pytest.approx(4, abs=0.2)
    end = rj.batch.rollout(bodies, states, 0.5, 40, GYROSTAT)
    assert jnp.abs(jnp.linalg.norm(end.q, axis=1) - 1).max() < 1e-15


def weighed(states):
    a, b = jnp.arange(1.0, 5.0)[None], jnp.arange(1.0, 4.0)[None]
    return jnp.sum(a * states.q**2) + jnp.sum(b * states.omega)


@pytest.mark.oldest
def test_derivatives_are_those_of_the_steps():
    # Reverse mode in pieces against plain forward mode through the loop of `solve`, h included.
    bodies, states = batch(2)

    def ours(tensor, omega, com, h):
        law = eqx.tree_at(lambda law: law.com, TOP, com)
        start = rj.Attitude(states.q, omega)
        return weighed(rj.batch.rollout(rj.Inertia(tensor), start, h, 6, law, solver=KUTTA))

    def plain(tensor, omega, com, h):
        law = eqx.tree_at(lambda law: law.com, TOP, com)

        def one(tensor, q, omega):
            field = AttitudeEquations(rj.Inertia(tensor), law)
            ts = jnp.stack([0.0 * h, 6 * h])
            return jax.tree.map(lambda a: a[1], fixed(KUTTA, field, ts, rj.Attitude(q, omega), 6))

        return weighed(jax.vmap(one)(tensor, states.q, omega))

    at = (bodies.tensor, states.omega, TOP.com, jnp.asarray(0.2))
    found = once(jax.grad(ours, (0, 1, 2, 3)))(*at)
    truth = once(jax.jacfwd(plain, (0, 1, 2, 3)))(*at)
    # The half of the tensor that is read is nobody's business: symmetric parts are compared.
    found, truth = [(_symmetric(g[0]), *g[1:]) for g in (found, truth)]
    for a, b in zip(found, truth, strict=True):
        assert jnp.abs(a - b).max() < 1e-13 * max(1.0, jnp.abs(b).max())


@pytest.mark.oldest
@pytest.mark.parametrize(
    "moments",
    [
        (1.0, 1.0, 1.5),
        *(pytest.param(m, marks=pytest.mark.slow) for m in ((1.0,) * 3, (1.0, 1.3, 1.6))),
    ],
)
def test_free_derivative_by_the_whole_tensor(moments):
    # Also where principal axes have no derivative. Oracle: the closed form's.
    states = rj.Attitude(jnp.eye(4)[:1], jnp.array([[0.3, 0.5, 0.4]]))
    tensor = jnp.diag(jnp.array(moments))

    def ours(tensor):
        return weighed(rj.batch.rollout(rj.Inertia(tensor), states, 0.02, 100))

    def closed(tensor):
        start = jax.tree.map(lambda a: a[0], states)
        end = rj.exact.free_body(rj.Inertia(tensor), start, 2.0)
        return weighed(jax.tree.map(lambda a: a[None], end))

    forward, truth = once(lambda x: (jax.jacfwd(ours)(x), jax.jacfwd(closed)(x)))(tensor)
    assert jnp.abs(_symmetric(forward - truth)).max() < 1e-8


def _symmetric(g):
    return (g + jnp.swapaxes(g, -1, -2)) / 2


def test_derivatives_of_a_long_rollout():
    """Steps that carry what additions lose: derivatives in both modes are the closed form's."""
    body, start = rj.Inertia.from_principal(1.0, 2.0, 2.5), jnp.array([1.0, 0.2, 0.3])

    def stepped(omega):
        bodies, q = rj.Inertia(body.tensor[None]), jnp.eye(4)[:1]
        ys = rj.batch.rollout(bodies, rj.Attitude(q, omega[None]), 5e-4, 10_000)
        return jnp.concatenate([ys.q[0], ys.omega[0]])

    def exact(omega):
        ys = rj.simulate(body, rj.Attitude(jnp.eye(4)[0], omega), [0.0, 5.0]).ys
        return jnp.concatenate([ys.q[1], ys.omega[1]])

    wanted = jax.jacfwd(exact)(start)
    np.testing.assert_allclose(stepped(start), exact(start), atol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(stepped)(start), wanted, atol=1e-11)
    np.testing.assert_allclose(jax.jacrev(stepped)(start), wanted, atol=1e-11)


def test_thinned_and_reduced():
    bodies, states = batch(3)
    kept = rj.batch.rollout(bodies, states, 0.1, 12, TOP, save_every=4)
    assert kept.q.shape == (3, 3, 4)
    last = rj.batch.rollout(bodies, states, 0.1, 12, TOP)
    assert far(jax.tree.map(lambda a: a[:, -1], kept), last) < 1e-15
    end, found = rj.batch.rollout(
        bodies, states, 0.1, 12, TOP, save_every=4, reduce=_largest, initial=(0.0, 0.0)
    )
    assert far(end, last) < 1e-15
    rates = jnp.linalg.norm(kept.omega, axis=-1)
    assert jnp.abs(found[0] - rates.max(axis=1)).max() < 1e-15
    np.testing.assert_allclose(found[1], 0.4 + 0.8 + 1.2, rtol=1e-15)


def _largest(carried, t, state):
    rate, times = carried
    return jnp.maximum(rate, jnp.linalg.norm(state.omega)), times + t


def test_bodies_are_alone():
    bodies, states = batch(5)
    whole = rj.batch.rollout(bodies, states, 0.1, 6, TOP)
    ill = rj.Attitude(states.q, states.omega.at[2].set(jnp.nan))
    found = rj.batch.rollout(bodies, ill, 0.1, 6, TOP)
    good = np.array([0, 1, 3, 4])
    assert np.array_equal(found.q[good], whole.q[good])
    assert np.isnan(found.omega[2]).all()
    # Chunks, and places that are left over.
    assert far(rj.batch.rollout(bodies, states, 0.1, 6, TOP, chunk=2), whole) < 1e-15


def test_own_laws_and_shared_bodies():
    _, states = batch(3)
    body = rj.Inertia.from_principal(1.0, 1.3, 1.7)
    coms = jnp.array([[0.0, 0, 1], [0.1, 0, 0.5], [0, 0.2, -1]])
    laws = jax.vmap(lambda c: rj.torques.HeavyTop(1.0, c, jnp.array([0.0, 0, -1])))(coms)
    found = rj.batch.rollout(body, states, 0.1, 6, laws, torque_axes=0)
    axes = eqx.tree_at(
        lambda law: law.com, jax.tree.map(lambda _: None, TOP), 0, is_leaf=lambda x: x is None
    )
    mixed = eqx.tree_at(lambda law: law.com, TOP, coms)
    again = rj.batch.rollout(body, states, 0.1, 6, mixed, torque_axes=axes)
    assert far(found, again) < 1e-15
    for i in range(3):
        law = rj.torques.HeavyTop(1.0, coms[i], [0.0, 0, -1])
        alone = rj.batch.rollout(body, jax.tree.map(lambda a: a[i : i + 1], states), 0.1, 6, law)
        assert far(alone, jax.tree.map(lambda a: a[i : i + 1], found)) < 1e-15


def test_other_rungs():
    bodies, states = batch(2)
    spin = rj.batch.rollout(bodies, rj.Spin(states.omega), 0.05, 20, solver=KUTTA)
    turned = rj.batch.rollout(bodies, states, 0.05, 20, solver=KUTTA)
    assert jnp.abs(spin.omega - turned.omega).max() < 1e-15
    matter = rj.MassProperties(
        jnp.ones(2), jnp.zeros((2, 3)), jax.vmap(lambda b: b.second_moment)(bodies)
    )
    start = rj.Rigid(jnp.zeros((2, 3)), jnp.ones((2, 3)), states.q, states.omega)
    fall = rj.batch.rollout(matter, start, 0.05, 20, rj.torques.UniformGravity([0.0, 0, -2.0]))
    assert jnp.abs(fall.x - jnp.array([[1.0, 1, 0]])).max() < 1e-14
    assert jnp.abs(fall.omega - turned.omega).max() < 1e-14


def test_numbers_do_not_compile_anew():
    traced = []

    class Law(eqx.Module):
        strength: jax.Array

        def __call__(self, t, state, body):
            traced.append(1)
            return -self.strength * state.omega

    bodies, states = batch(2)
    rj.batch.rollout(bodies, states, 0.1, 4, Law(jnp.asarray(0.1)))
    many = len(traced)
    for start in (0.0, 0.4, 0.8):
        states = rj.batch.rollout(bodies, states, 0.2, 4, Law(jnp.asarray(0.3)), t0=start)
    assert len(traced) == many


@pytest.mark.slow
def test_single_precision():
    bodies, states = batch(64, dtype=jnp.float32)
    found = rj.batch.rollout(bodies, states, jnp.float32(0.01), 1000)
    assert found.q.dtype == jnp.float32
    wide = jax.tree.map(lambda a: a.astype(jnp.float64), (bodies, states))
    truth = jax.vmap(lambda b, s: rj.exact.free_body(b, s, 10.0))(
        wide[0], rj.Attitude(jax.vmap(rj.quaternion.normalise)(wide[1].q), wide[1].omega)
    )
    assert far(jax.tree.map(lambda a: a.astype(jnp.float64), found), truth) < 2e-5  # 5e-6 typical


def test_words(unhooked):
    bodies, states = batch(3)
    run = rj.batch.rollout
    one = jax.tree.map(lambda a: a[0], states)
    with pytest.raises(ValueError, match=r"for one body use rigidjax.simulate"):
        run(bodies, one, 0.1, 4)
    half = jax.tree.map(lambda a: a.astype(jnp.float16), states)
    with pytest.raises(TypeError, match="states0: wanted float32 or float64, got float16"):
        run(bodies, half, 0.1, 4)
    with pytest.raises(
        ValueError, match=r"wanted one body \(3, 3\), or one for each of the 3 states"
    ):
        run(batch(2)[0], states, 0.1, 4)
    with pytest.raises(ValueError, match="positive step"):
        run(bodies, states, -0.1, 4)
    with pytest.raises(TypeError, match="whole number"):
        run(bodies, states, 0.1, 4.0)
    with pytest.raises(ValueError, match=r"a divisor of num_steps = 10"):
        run(bodies, states, 0.1, 10, save_every=3)
    with pytest.raises(ValueError, match=r"moments that are not negative.*this is body 1"):
        run(rj.Inertia(bodies.tensor.at[1, 0, 0].set(-1.0)), states, 0.1, 4)
    with pytest.raises(ValueError, match="length 2 for body 2"):
        run(bodies, rj.Attitude(states.q.at[2].mul(2.0), states.omega), 0.1, 4)
    with pytest.raises(TypeError, match="depends on the attitude"):
        run(bodies, states, 0.1, 4, TOP, solver=rj.solvers.Magnus4())
    with pytest.raises(TypeError, match="no fixed steps of Dopri8"):
        run(bodies, states, 0.1, 4, TOP, solver=dfx.Dopri8())
    with pytest.raises(TypeError, match="HasAttitude"):
        run(bodies, rj.Spin(states.omega), 0.1, 4, TOP)
    with pytest.raises(ValueError, match="3 rows in torque"):
        run(bodies, states, 0.1, 4, TOP, torque_axes=0)
    with pytest.raises(ValueError, match="chunk"):
        run(bodies, states, 0.1, 4, chunk=0)
    with pytest.raises(ValueError, match="devices"):
        run(bodies, states, 0.1, 4, devices="both")
    with pytest.raises(TypeError, match="reduce"):
        run(bodies, states, 0.1, 4, reduce=3, initial=0.0)
    with pytest.raises(ValueError, match="no reduce was given"):
        run(bodies, states, 0.1, 4, initial=0.0)


def test_chunks_cover_all():
    each = jnp.arange(7.0)
    division = divide_batch(3, None, None, each.dtype, 7)
    found = map_bodies(lambda s, x: s * x, jnp.asarray(2.0), each, division)
    assert np.array_equal(found, 2 * np.arange(7.0))


class Recorder(dfx.AbstractProgressMeter):
    """Append each progress to a list."""

    seen: list = eqx.field(static=True)

    def init(self):
        return jnp.zeros(())

    def step(self, state, progress):
        jax.debug.callback(lambda p: self.seen.append(float(p)), progress, ordered=True)
        return progress

    def close(self, state):
        jax.debug.callback(lambda p: self.seen.append("closed"), state, ordered=True)


class Log(list):
    __hash__ = object.__hash__


@pytest.mark.parametrize("how", ["steps", "times"])
def test_a_meter_moves_after_each_chunk(how):
    bodies, states = batch(7)
    meter = Recorder(Log())

    def run(**more):
        if how == "steps":
            return rj.batch.rollout(bodies, states, 0.1, 4, TOP, chunk=2, **more)
        return rj.batch.simulate(bodies, states, [0.0, 0.4], TOP, chunk=2, **more).ys

    with_meter = run(progress_meter=meter)
    jax.effects_barrier()
    assert meter.seen == [0.25, 0.5, 0.75, 1.0, "closed"]
    assert np.array_equal(with_meter.q, run().q)
    with pytest.raises(ValueError, match="progress_meter: wanted devices=None"):
        run(progress_meter=meter, devices="all")
    with pytest.raises(TypeError, match="progress_meter"):
        run(progress_meter=True)


def _temporary(count, steps):
    bodies, states = batch(count)

    def loss(tensor, states):
        return weighed(rj.batch.rollout(rj.Inertia(tensor), states, 0.01, steps))

    run = jax.jit(jax.value_and_grad(loss, (0, 1)), compiler_options=rj.batch.compiler_options())
    return run.lower(bodies.tensor, states).compile().memory_analysis().temp_size_in_bytes


@pytest.mark.slow
def test_memory_of_a_gradient():
    assert _temporary(1024, 1000) < 20e6  # measured 2.9e6
    few, many = _temporary(20_000, 1000), _temporary(100_000, 1000)
    # Beyond what goes in and out (7 + 9 numbers a body and as many cotangents), nothing grows.
    assert many - few < 80_000 * 8 * 16 * 5


@pytest.mark.slow
def test_memory_of_a_million_bodies():
    body = rj.Inertia.from_tensor(jnp.diag(jnp.array([1.0, 1.3, 1.7], jnp.float32)))
    shape = lambda n: jax.ShapeDtypeStruct((1_000_000, n), jnp.float32)
    run = jax.jit(lambda q, omega: rj.batch.rollout(body, rj.Attitude(q, omega), 0.01, 100))
    used = run.lower(shape(4), shape(3)).compile().memory_analysis()
    assert used.output_size_in_bytes < 30e6 and used.temp_size_in_bytes < 150e6


@pytest.mark.slow
def test_ten_million_steps():
    bodies, states = batch(8)
    start = jax.tree.map(lambda a: a[:8], states)
    end = rj.batch.rollout(bodies, start, 1e-3, 10_000_000)
    truth = jax.vmap(lambda b, s: rj.exact.free_body(b, s, 1e4))(bodies, start)
    assert jnp.abs(jnp.linalg.norm(end.q, axis=1) - 1).max() < 1e-14
    assert far(end, truth) < 1e-7
