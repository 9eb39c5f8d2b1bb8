"""The front door: values and derivatives against oracles, refusals, no needless compilation."""

import sys

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once
from systems import free_body_mp

import rigidjax as rj
from rigidjax.solve.answer import run

TENSOR = np.array([[1.0, 0.1, -0.05], [0.1, 1.6, 0.2], [-0.05, 0.2, 2.1]])
OMEGA = np.array([0.9, -1.1, 0.4])
Q = np.array([0.8, -0.2, 0.4, 0.4])
Q = Q / np.linalg.norm(Q)


class Nothing(rj.torques.AbstractTorque):
    """A torque of zero: the same motion, but through the solver."""

    feels = rj.motion.HasSpin
    rate_free = True

    def __call__(self, t, state, body):
        return jnp.zeros_like(state.omega)


WAYS = pytest.mark.parametrize("torque", [None, Nothing()], ids=["free", "solver"])


@WAYS
def test_detest_b5(torque):
    # y_i = c_i Ω_i with I = (2, 3, 1) turns Euler's equations into problem B5
    # (Hull et al. 1972); the reference value is Enright and Pryce's.
    c2 = (1 / 0.51) ** 0.5
    c1 = c2 / 3**0.5
    c = np.array([c1, c2, c1 / c2])
    start = rj.Spin(np.array([0.0, 1.0, 1.0]) / c)
    body = rj.Inertia.from_principal(2.0, 3.0, 1.0)
    out = rj.simulate(body, start, [0.0, 10.0, 20.0], torque, rtol=1e-13, atol=1e-15)
    wanted = [-0.93965707987292039619, -0.34211777540007490653, 0.74141265961999530078]
    np.testing.assert_allclose(c * out.ys.omega[-1], wanted, rtol=0, atol=5e-13)


@WAYS
def test_basilisk_hub(torque):
    # Basilisk's regression values for a free hub: MRP and body rate after 10 s.
    body = rj.Inertia.from_principal(500.0, 200.0, 300.0)
    start = rj.Attitude([1.0, 0, 0, 0], [0.5, -0.4, 0.7])
    end = rj.simulate(body, start, [0.0, 10.0], torque, rtol=1e-12, atol=1e-14).ys
    q = end.q[-1] * jnp.sign(end.q[-1, 0])
    mrp = q[1:] / (1 + q[0])
    np.testing.assert_allclose(mrp, [0.373034285, -0.00239564413, 0.208570797], atol=1e-9)
    omega = [0.48764727536, 0.31464158314, 0.74229419650]
    np.testing.assert_allclose(end.omega[-1], omega, atol=1e-9)


@pytest.mark.oldest
@pytest.mark.parametrize(
    "torque",
    # The closed form's have a test of their own in tests/exact.
    [pytest.param(None, id="free", marks=pytest.mark.slow), pytest.param(Nothing(), id="solver")],
)
@pytest.mark.parametrize("mode", ["forward", "along", "reverse"])
def test_derivatives_against_fifty_digits(torque, mode):
    adjoint, jac = {
        "forward": (None, jax.jacfwd),
        "along": (dfx.ForwardMode(), jax.jacfwd),
        "reverse": (dfx.RecursiveCheckpointAdjoint(), jax.jacrev),
    }[mode]
    places = (np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2]))

    def end(numbers):
        upper = jnp.zeros((3, 3)).at[places].set(numbers[:6])
        tensor = upper + upper.T - jnp.diag(jnp.diag(upper))
        # q0 of any length: what the oracle does, too.
        q0 = numbers[9:] / jnp.linalg.norm(numbers[9:])
        start = rj.Attitude(q0, numbers[6:9])
        ys = rj.simulate(
            rj.Inertia(tensor), start, [0.0, 1.5], torque, rtol=1e-12, atol=1e-14, adjoint=adjoint
        ).ys
        return jnp.concatenate([ys.q[-1], ys.omega[-1]])

    numbers = jnp.concatenate([TENSOR[places], OMEGA, Q])
    found = np.asarray(once(jac(end))(numbers))
    scene = (tuple(map(tuple, TENSOR.tolist())), tuple(Q.tolist()), tuple(OMEGA.tolist()), 1.5)
    wanted = np.array(free_body_mp.jacobian(*scene))
    # q and −q are one attitude.
    wanted[:4] *= np.sign(np.sum(found[:4] * wanted[:4]))
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())


def test_where_forward_mode_is_all_that_is_asked_diffrax_runs_its_own_method():
    start, law, ts = rj.Attitude(Q, OMEGA), rj.torques.Damping([0.1, 0.2, 0.3]), [0.0, 1.0, 2.0]
    forward = dict(adjoint=dfx.ForwardMode())
    found = rj.simulate(rj.Inertia(TENSOR), start, ts, law, **forward)
    by_diffrax = rj.simulate(rj.Inertia(TENSOR), start, ts, law, solver=dfx.Dopri8(), **forward)
    np.testing.assert_array_equal(found.ys.q, by_diffrax.ys.q)
    # An event is found with methods of ours only; and a method that was chosen is taken.
    event = dict(event=lambda t, state, body: t - 1.5, **forward)
    assert (
        abs(float(rj.simulate(rj.Inertia(TENSOR), start, ts, law, **event).event_time) - 1.5) < 1e-9
    )
    ours = dict(solver=rj.solvers.DormandPrince8(), **forward)
    chosen = rj.simulate(rj.Inertia(TENSOR), start, ts, law, **ours).ys
    default = rj.simulate(rj.Inertia(TENSOR), start, ts, law).ys
    np.testing.assert_array_equal(chosen.q, default.q)


@WAYS
def test_from_rest_the_attitude_follows_the_rate(torque):
    # d(rotation vector)/dΩ0 at rest is T·1; MJX and jaxsim say 0 there, brax NaN.
    body, late = rj.Inertia(TENSOR), 3.0

    def turn(omega):
        start = rj.Attitude([1.0, 0, 0, 0], omega)
        ys = rj.simulate(body, start, [0.0, late], torque, adjoint=dfx.ForwardMode()).ys
        return rj.quaternion.log(ys.q[-1])

    slope = once(jax.jacfwd(turn))(jnp.zeros(3))
    np.testing.assert_allclose(slope, late * np.eye(3), rtol=0, atol=1e-12)


@pytest.mark.parametrize("solver", [dfx.Tsit5(), dfx.Dopri8()], ids=["Tsit5", "Dopri8"])
def test_attitudes_are_unit_at_every_saved_time(solver):
    start = rj.Attitude(Q, 3 * OMEGA)
    ts = jnp.linspace(0.0, 50.0, 997)

    @jax.jit
    def run(rtol):
        how = dict(solver=solver, rtol=rtol, atol=1e-3 * rtol)
        return rj.simulate(rj.Inertia(TENSOR), start, ts, Nothing(), **how).ys.q

    for rtol in (1e-3, 1e-6, 1e-9):
        q = np.asarray(run(jnp.asarray(rtol)))
        assert np.abs(np.linalg.norm(q, axis=1) - 1).max() < 1e-14


@pytest.mark.parametrize(
    "make",
    [
        lambda w: rj.Spin(w),
        lambda w: rj.Attitude(Q, w),
        lambda w: rj.Rigid([0.0, 1, 2], [3.0, 0, -1], Q, w),
    ],
    ids=["Spin", "Attitude", "Rigid"],
)
@WAYS
def test_rungs_agree_and_conserve(make, torque):
    inertia = rj.Inertia(TENSOR)
    start, ts = make(OMEGA), jnp.linspace(0.0, 20.0, 41)
    body = inertia
    if isinstance(start, rj.Rigid):
        body = rj.MassProperties(2.0, jnp.zeros(3), inertia.second_moment)
    out = rj.simulate(body, start, ts, torque, rtol=1e-12, atol=1e-14)
    assert type(out.ys) is type(start)
    energy = once(jax.vmap(lambda w: rj.kinetic_energy(inertia, rj.Spin(w))))(out.ys.omega)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-10)
    if not isinstance(start, rj.Spin):
        world = once(jax.vmap(
            lambda q, w: rj.spatial_angular_momentum(inertia, rj.Attitude(q, w))
        ))(out.ys.q, out.ys.omega)  # fmt: skip
        np.testing.assert_allclose(world, np.broadcast_to(world[0], world.shape), atol=1e-10)
    if isinstance(start, rj.Rigid):
        np.testing.assert_allclose(out.ys.x[-1], [60.0, 1, -18], rtol=1e-13)


@WAYS
def test_evaluate_between_saved_times(torque):
    out = rj.simulate(rj.Inertia(TENSOR), rj.Attitude(Q, OMEGA), [0.0, 3.0, 9.0], torque)
    q, omega = free_body_mp.attitude_and_rate(TENSOR.tolist(), Q.tolist(), OMEGA.tolist(), 5.0)
    found = out.evaluate(5.0)
    np.testing.assert_allclose(found.omega, [float(c) for c in omega], atol=1e-8)
    assert abs(abs(float(found.q @ np.array([float(c) for c in q]))) - 1) < 1e-8
    np.testing.assert_allclose(out.evaluate(9.0).omega, out.ys.omega[-1], atol=1e-14)
    with pytest.raises(ValueError, match="outside the times"):
        out.evaluate(9.5)


@WAYS
def test_second_call_with_other_numbers_compiles_nothing(torque):
    compiled = []

    def listen(event, duration, **kwargs):
        if event.endswith("backend_compile_duration"):
            compiled.append(event)

    def call(scale):
        body = rj.Inertia(scale * TENSOR)
        ts = scale * np.linspace(0.0, 1.0, 7)
        return rj.simulate(body, rj.Attitude(Q, scale * OMEGA), ts, torque).ys.q

    jax.monitoring.register_event_duration_secs_listener(listen)
    call(1.0)
    first = len(compiled)
    assert first > 0
    call(1.5)
    call(0.5)
    assert len(compiled) == first


def test_a_traced_tolerance_compiles_once():
    # ω = ω0 exp(−c t / I), from ω0 = 2, c = 0.5, I = 2, for each tolerance as far off as it says.
    body, law = rj.Inertia.from_principal(2.0, 2.0, 2.0), rj.torques.Damping([0.5, 0.5, 0.5])

    @jax.jit
    def end(rtol):
        return rj.simulate(body, rj.Spin([0.0, 0.0, 2.0]), [0.0, 8.0], law, rtol=rtol).ys.omega[-1]

    errors = [abs(float(end(jnp.asarray(rtol))[2]) - 2 * np.exp(-2.0)) for rtol in (1e-4, 1e-10)]
    assert 1e-10 < errors[0] < 1e-4 and errors[1] < 1e-10
    assert end._cache_size() == 1


def test_vmap_over_bodies_states_and_torques():
    scales = jnp.linspace(0.5, 2.0, 5)

    def end(scale):
        torque = rj.torques.Damping(0.1 * scale * jnp.ones(3))
        return rj.simulate(
            rj.Inertia(scale * TENSOR), rj.Spin(scale * OMEGA), [0.0, 4.0], torque
        ).ys.omega[-1]

    one = jax.jit(end)
    together = jax.jit(jax.vmap(end))(scales)
    alone = jnp.stack([one(scale) for scale in scales])
    np.testing.assert_allclose(together, alone, atol=1e-8)


def test_damping_of_a_sphere_is_exponential():
    body, rate = rj.Inertia.from_principal(2.0, 2.0, 2.0), 0.3
    out = rj.simulate(body, rj.Spin(OMEGA), [0.0, 5.0], rj.torques.Damping(jnp.full(3, rate)))
    np.testing.assert_allclose(out.ys.omega[-1], OMEGA * np.exp(-rate / 2 * 5), rtol=1e-8)


def test_float32_stays_float32_and_says_what_it_cannot_reach():
    single = lambda x: jnp.asarray(x, jnp.float32)
    body = rj.Inertia(single(TENSOR))
    start = rj.Attitude(single(Q), single(OMEGA))
    ts = single([0.0, 1.0, 2.5])
    out = rj.simulate(body, start, ts, Nothing())
    assert out.ys.q.dtype == jnp.float32
    q, _ = free_body_mp.attitude_and_rate(TENSOR.tolist(), Q.tolist(), OMEGA.tolist(), 2.5)
    assert abs(abs(float(out.ys.q[-1] @ single([float(c) for c in q]))) - 1) < 1e-5
    with pytest.warns(UserWarning, match="float32 cannot reach rtol=1e-10"):
        rj.simulate(body, start, ts, Nothing(), rtol=1e-10)


# What constructors refuse, but `tree_at` lets pass.
MATTER = rj.MassProperties(1.0, np.zeros(3), np.eye(3))
WIDE = eqx.tree_at(lambda body: body.mass, MATTER, jnp.array([1.0, 2.0, 4.0]))
TALL = eqx.tree_at(lambda state: state.q, rj.Attitude(Q, OMEGA), jnp.stack([jnp.asarray(Q)] * 2))
BAD = [
    (dict(ts=[0.0, 1.0, 1.0]), ValueError, r"increasing times; ts\[2\]"),
    (dict(ts=[0.0, np.nan, 1.0]), ValueError, r"ts: contains NaN or infinity at index \(1,\)"),
    (dict(ts=[0.0]), ValueError, "at least two times"),
    (dict(state0=rj.Attitude([0.0, 0, 0, 0], OMEGA)), ValueError, "unit quaternion .* scalar comes first"),
    (dict(state0=rj.Attitude(2 * Q, OMEGA)), ValueError, "length is not 1"),
    (dict(state0=rj.Spin([0.0, np.nan, 1.0])), ValueError, r"omega: contains NaN or infinity at index \(1,\)"),
    (dict(state0=rj.Spin(np.ones((5, 3)))), ValueError, "one body.*jax.vmap"),
    (dict(state0=np.ones(3)), TypeError, "wanted Spin, Attitude or Rigid.* got ndarray"),
    (dict(body=np.eye(3)), TypeError, "only turns: wanted Inertia, got ndarray"),
    (dict(body=rj.MassProperties(1.0, np.zeros(3), np.eye(3))), TypeError, "pass body.inertia"),
    (dict(state0=rj.Rigid(OMEGA, OMEGA, Q, OMEGA)), TypeError, "wanted MassProperties, got Inertia"),
    (dict(body=rj.Inertia(TENSOR * np.nan)), ValueError, r"inertia tensor: contains NaN or infinity at index \(0, 0\)"),
    (dict(body=rj.Inertia(np.stack([TENSOR] * 2))), ValueError, r"tensor: wanted shape \(3, 3\), got \(2, 3, 3\).* one body; batch"),
    (dict(body=WIDE, state0=rj.Rigid(OMEGA, OMEGA, Q, OMEGA)), ValueError, r"body\.mass: wanted shape \(\), got \(3,\).* one body; batch with jax.vmap"),
    (dict(state0=TALL), ValueError, r"q: wanted shape \(4,\), got \(2, 4\).* one body; batch"),
    (dict(rtol=0.0), ValueError, "wanted rtol > 0"),
    (dict(rtol=np.array([1e-6, 1e-6])), ValueError, r"rtol: wanted one number, got shape \(2,\)"),
    (dict(rtol=1e-9, stepsize_controller=dfx.ConstantStepSize()), ValueError, "not both"),
    (dict(torque=lambda t, state, body: jnp.zeros(2)), ValueError, r"wanted shape \(3,\), got \(2,\); body-frame"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "error", "words"), BAD)
@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_named(change, error, words):
    given = dict(body=rj.Inertia(TENSOR), state0=rj.Attitude(Q, OMEGA), ts=[0.0, 1.0]) | change
    with pytest.raises(error, match=words):
        rj.simulate(**given)


@pytest.mark.usefixtures("unhooked")
def test_states_and_masses_of_several_shapes_are_refused():
    five, shape = np.ones((5, 3)), r"wanted one of each.*q \(4,\), omega \(5, 3\)"
    for make in (lambda: rj.Attitude(Q, five), lambda: rj.Rigid(OMEGA, OMEGA, Q, five)):
        with pytest.raises(ValueError, match=shape):
            make()
    with pytest.raises(ValueError, match=r"x, v: wanted one of each.*x \(3,\), v \(5, 3\)"):
        rj.Point(OMEGA, five)
    with pytest.raises(ValueError, match=r"mass \(\).*got shapes mass \(3,\)"):
        rj.MassProperties([1.0, 2.0, 4.0], np.zeros(3), np.eye(3))


@pytest.mark.usefixtures("unhooked")
def test_times_without_end_are_refused():
    start = rj.Attitude(Q, OMEGA)
    body, many = rj.Inertia(TENSOR), jax.tree.map(lambda leaf: leaf[None], start)
    run = rj.simulate(body, start, [0.0, 1.0])
    for t in (-np.inf, np.inf, np.nan):
        with pytest.raises(ValueError, match="t: contains NaN or infinity"):
            rj.exact.free_body(body, start, t)
        with pytest.raises(ValueError, match="t: contains NaN or infinity"):
            rj.exact.FreeBody(body, start)(t)
        with pytest.raises(ValueError, match="t0: contains NaN or infinity"):
            rj.batch.rollout(body, many, 0.01, 2, t0=t)
        with pytest.raises(ValueError, match="evaluate: t lies outside"):
            run.evaluate(t)


class NeedsAttitude(rj.torques.AbstractTorque):
    feels = rj.motion.HasAttitude

    def __call__(self, t, state, body):
        return state.q[1:]


@pytest.mark.usefixtures("unhooked")
def test_a_torque_says_which_rung_it_needs():
    with pytest.raises(TypeError, match="NeedsAttitude needs a state with HasAttitude"):
        rj.simulate(rj.Inertia(TENSOR), rj.Spin(OMEGA), [0.0, 1.0], NeedsAttitude())


def test_values_are_refused_under_jit_too():
    @eqx.filter_jit
    def run(q, ts):
        return rj.simulate(rj.Inertia(TENSOR), rj.Attitude(q, OMEGA), ts).ys.q

    with pytest.raises(Exception, match="wanted a unit quaternion"):
        run(jnp.asarray(2 * Q), jnp.array([0.0, 1.0])).block_until_ready()
    with pytest.raises(Exception, match="wanted increasing times"):
        run(jnp.asarray(Q), jnp.array([1.0, 1.0])).block_until_ready()


@pytest.mark.oldest
def test_implicit_solvers_keep_their_root_finder():
    out = rj.simulate(
        rj.Inertia(TENSOR), rj.Attitude(Q, OMEGA), [0.0, 1.0], Nothing(), solver=dfx.Kvaerno5()
    )
    exact = rj.simulate(rj.Inertia(TENSOR), rj.Attitude(Q, OMEGA), [0.0, 1.0], Nothing())
    np.testing.assert_allclose(out.ys.omega, exact.ys.omega, atol=1e-7)


def test_a_short_pulse_is_not_stepped_over():
    # Row D9: impulse 10 N m s in 10 ms on a sphere; plain diffrax and SciPy return 0 here.
    pulse = rj.torques.Pulses([5.0, 5.01], [[0.0, 0.0, 1000.0]])
    body = rj.Inertia.from_principal(2.0, 2.0, 2.0)
    end = rj.simulate(body, rj.Spin(jnp.zeros(3)), [0.0, 20.0], pulse).ys.omega[-1]
    np.testing.assert_allclose(end, [0.0, 0.0, 5.0], atol=1e-8)


def test_drift_is_reported():
    start, ts = rj.Attitude(Q, OMEGA), jnp.linspace(0.0, 10.0, 50)
    top = rj.torques.HeavyTop(mass=1.0, com=[0.0, 0.1, 0.4], gravity=[0.0, 0.0, -9.81])
    close = rj.simulate(rj.Inertia(TENSOR), start, ts, top, rtol=1e-12, atol=1e-14).drift
    loose = rj.simulate(rj.Inertia(TENSOR), start, ts, top, rtol=1e-4, atol=1e-6).drift
    assert float(close["energy"]) < 1e-10
    assert 1e-8 < float(loose["energy"]) < 1e-2
    free = rj.simulate(rj.Inertia(TENSOR), start, ts).drift
    assert max(float(value) for value in free.values()) < 1e-13


@pytest.mark.slow
def test_a_solver_that_is_projected_already_takes_every_adjoint():
    body, law = rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.torques.Damping([0.1, 0.1, 0.1])

    def last(rate, solver):
        start = rj.Attitude([1.0, 0, 0, 0], jnp.array([0.3, 1.0, 0.2]) * rate)
        how = dict(solver=solver, adjoint=dfx.ForwardMode())
        return rj.simulate(body, start, [0.0, 2.0], law, **how).ys.q[-1]

    twice = jax.jacfwd(last)(1.0, rj.solvers.Projected(dfx.Dopri8()))
    np.testing.assert_allclose(twice, jax.jacfwd(last)(1.0, dfx.Dopri8()), rtol=1e-12)


def test_a_time_of_more_turns_than_the_dtype_counts_is_refused():
    body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([1.0, 1.0, 1.0])
    with pytest.raises(Exception, match="after more turns than the dtype can count"):
        rj.simulate(body, start, [0.0, 1e75])
    kept = rj.simulate(body, start, [0.0, 1.0, 1e75], throw=False)
    np.testing.assert_array_equal(np.isfinite(kept.ys.omega).all(-1), [True, True, False])


def test_a_torque_of_nan_is_told_in_one_sentence_outside_of_jit():
    law = lambda t, state, body: jnp.log(0.5 - t) * state.omega
    body = rj.Inertia.from_principal(1.0, 1.6, 2.2)
    with pytest.raises(RuntimeError) as caught:
        rj.simulate(body, rj.Spin([1.0, 0.0, 0.0]), [0.0, 1.0], law)
    words = str(caught.value)
    assert words.startswith("simulate: the motion became NaN or infinite.")
    assert "\n" not in words and caught.value.__suppress_context__


@pytest.mark.oldest
@WAYS
def test_a_run_raises_once_whether_its_numbers_are_known_or_traced(torque, monkeypatch):
    """Known: on the host, so that the program has no callback. Traced: in the program."""
    raised_in_program = []
    module = sys.modules["rigidjax.solve.answer.simulate"]

    def solve(setup, state0, ts):
        raised_in_program.append(setup.throw)
        return run.solve(setup, state0, ts)

    monkeypatch.setattr(module, "solve", solve)

    def last(ts):
        body = rj.Inertia.from_principal(1.0, 2.0, 3.0)
        return rj.simulate(body, rj.Spin([1.0, 1.0, 1.0]), ts, torque, max_steps=3).ys.omega

    late, words = (1e75, "more turns than") if torque is None else (50.0, "maximum number of")
    early, late = jnp.array([0.0, 1e-3]), jnp.array([0.0, late])
    wanted = last(early)
    for function in (last, eqx.filter_jit(last)):
        np.testing.assert_allclose(function(early), wanted, rtol=1e-14)
        with pytest.raises(Exception, match=words):
            jax.block_until_ready(function(late))
    assert raised_in_program == [False, False, False, True]


def last_rate_under_a_law_with_a_number(drag, **how):
    body = rj.Inertia.from_principal(2.0, 2.0, 2.0)
    law = lambda t, state, body: -drag * state.omega
    return rj.simulate(body, rj.Spin([0.0, 0.0, 1.5]), [0.0, 4.0], law, **how).ys.omega[-1, 2]


def test_a_law_that_holds_a_traced_number_raises_the_message_of_its_run():
    end = lambda drag: last_rate_under_a_law_with_a_number(drag, max_steps=1)
    for function in (jax.grad(end), lambda drag: jax.vmap(end)(jnp.array([drag, 2 * drag]))):
        with pytest.raises(RuntimeError, match="the maximum number of solver steps, max_steps"):
            function(0.3)


class PlainLaw:
    """A law as a class of plain Python, which JAX does not look into."""

    def __init__(self, drag):
        self.drag = drag

    def __call__(self, t, state, body):
        return -self.drag * state.omega


@pytest.mark.parametrize("kind", ["function", "class in a sum"])
def test_an_accuracy_sees_the_traced_number_that_a_law_holds(kind):
    # ω = ω₀ exp(−drag t / I); its derivative by the drag.
    def last(drag):
        if kind == "function":
            return last_rate_under_a_law_with_a_number(drag, accuracy=1e-9)
        law = rj.torques.Sum(rj.torques.Damping([0.1, 0.1, 0.1]), PlainLaw(drag - 0.1))
        body, start = rj.Inertia.from_principal(2.0, 2.0, 2.0), rj.Spin([0.0, 0.0, 1.5])
        return rj.simulate(body, start, [0.0, 4.0], law, accuracy=1e-9).ys.omega[-1, 2]

    assert abs(float(jax.grad(last)(0.3)) + 1.5 * 2.0 * np.exp(-0.6)) < 1e-8
