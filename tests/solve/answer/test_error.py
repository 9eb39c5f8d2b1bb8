"""The error that a run states beside its true one: known motions, both dtypes, every kind of run."""

import warnings

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once
from systems import driven, free_body_mp

import rigidjax as rj

BODY = rj.Inertia.from_principal(0.7, 1.2, 1.6)
OMEGA = (0.4, 1.1, 3.0)
TOP = rj.torques.HeavyTop(1.0, [0.1, 0.2, 0.9], [0.0, 0.0, -9.81])
TS = jnp.linspace(0.0, 20.0, 5)
STEPS = rj.solvers.DormandPrince8()


def cast(tree, dtype):
    return jax.tree.map(lambda a: a.astype(dtype), tree)


def start(dtype=jnp.float64, omega=OMEGA):
    return rj.Attitude(jnp.array([0.5, 0.5, -0.5, 0.5], dtype), jnp.array(omega, dtype))


def truly(ys, truth):
    """Angle and distance of rates at each time."""
    q, right = np.asarray(ys.q, float), np.asarray(truth.q, float)
    sides = [np.linalg.norm(q - sign * right, axis=1) for sign in (1, -1)]
    angle = 4 * np.arcsin(np.minimum(*sides) / 2)
    return {
        "q": angle,
        "omega": np.linalg.norm(
            np.asarray(ys.omega, float) - np.asarray(truth.omega, float), axis=1
        ),
    }


def free_run(rtol, dtype=jnp.float64, **how):
    return rj.simulate(
        cast(BODY, dtype),
        start(dtype),
        TS.astype(dtype),
        solver=STEPS,
        rtol=rtol,
        atol=1e-3 * rtol,
        **how,
    )


@pytest.mark.parametrize("rtol", [1e-4, 1e-7, 1e-10])
def test_steps_of_a_free_body_beside_the_closed_form(rtol):
    sol = free_run(rtol)
    error, true = sol.error, truly(sol.ys, rj.simulate(BODY, start(), TS).ys)
    for name, right in true.items():
        ratio = np.asarray(error.total[name])[1:] / right[1:]
        assert np.all((ratio > 0.5) & (ratio < 2.0)), (name, ratio)
    assert not np.any(error.lost) and float(error.known_until) == 20.0
    np.testing.assert_allclose(
        error.relative, np.maximum(error.total["q"], error.total["omega"] / error.sizes["omega"])
    )


@pytest.mark.parametrize(
    ("rtol", "dtype"), [(3e-14, jnp.float64), (2e-5, jnp.float32), (1e-3, jnp.float32)]
)
def test_round_off_is_not_stated_too_small(rtol, dtype):
    sol = free_run(rtol, dtype)
    state, body = cast(start(dtype), jnp.float64), cast(cast(BODY, dtype), jnp.float64)
    true = truly(sol.ys, rj.simulate(body, state, TS).ys)
    for name, right in true.items():
        stated = np.asarray(sol.error.total[name], float)
        assert np.all(stated[1:] > 0.5 * right[1:]), (name, stated, right)
        assert stated.max() < 15 * right.max(), (name, stated, right)


@pytest.mark.parametrize("rtol", [1e-7, 1e-9, 1e-11])
@pytest.mark.parametrize("deviation", [3e-6, -7e-6])
def test_round_off_beside_the_middle_axis(rtol, deviation):
    # The errors of the steps vanish near the middle axis and the rounding errors do not: after some
    # turns of the axis all tolerances give the same error, about a millionth of a radian or more.
    body = rj.Inertia.from_principal(0.34, 0.7, 0.98)
    state = start(omega=(17.0 * deviation, 17.0, 7.0 * deviation))
    ts = jnp.array([0.0, 60.0, 120.0])
    sol = rj.simulate(body, state, ts, solver=STEPS, rtol=rtol, atol=1e-3 * rtol)
    true = truly(sol.ys, rj.simulate(body, state, ts).ys)
    for name, right in true.items():
        stated = np.asarray(sol.error.total[name])[1:]
        assert np.all(stated > 0.5 * right[1:]), (name, stated, right)


def test_closed_form_beside_mpmath():
    sol = rj.simulate(BODY, start(), jnp.array([0.0, 3.0, 30.0]))
    error = sol.error
    assert not np.any(error.steps["q"])
    for i in (1, 2):
        q, omega = free_body_mp.attitude_and_rate(
            np.asarray(BODY.tensor).tolist(),
            [0.5, 0.5, -0.5, 0.5],
            OMEGA,
            float(sol.ts[i]),
            digits=30,
        )
        right = rj.Attitude(np.array([q], float), np.array([omega], float))
        true = truly(jax.tree.map(lambda a: a[i : i + 1], sol.ys), right)
        for name in true:
            # An end in doubles has a rounding of its own.
            assert error.total[name][i] > 0.5 * true[name][0] - 2e-16
            assert error.total[name][i] < 1e-12


def test_a_driven_body_whose_motion_is_known():
    ts = jnp.linspace(0.0, 30.0, 4)
    field = driven.field()
    body, law = field.euler.inertia, field.euler.torque
    sol = rj.simulate(body, driven.start(0.0), ts, law, rtol=1e-7, atol=1e-10)
    true = truly(sol.ys, rj.Attitude(jax.vmap(driven.attitude)(ts), jax.vmap(driven.omega)(ts)))
    for name, right in true.items():
        ratio = np.asarray(sol.error.total[name])[1:] / right[1:]
        assert np.all((ratio > 0.5) & (ratio < 2.0)), (name, ratio)


def test_equal_steps_beside_half_of_them():
    for solver, h in ((rj.solvers.Splitting2(), 0.01), (rj.solvers.RungeKutta4(), 0.02)):
        steps = dict(solver=solver, dt0=h, stepsize_controller=dfx.ConstantStepSize())
        sol = rj.simulate(BODY, start(), TS, TOP, **steps)
        right = rj.simulate(BODY, start(), TS, TOP, rtol=1e-12, atol=1e-14)
        ratio = np.asarray(sol.error.total["q"])[1:] / truly(sol.ys, right.ys)["q"][1:]
        assert np.all((ratio > 0.9) & (ratio < 1.5)), ratio


def test_steps_of_diffrax():
    sol = rj.simulate(BODY, start(), TS, TOP, solver=dfx.Tsit5(), rtol=1e-6, atol=1e-9)
    right = rj.simulate(BODY, start(), TS, TOP, rtol=1e-12, atol=1e-14)
    ratio = np.asarray(sol.error.total["q"])[1:] / truly(sol.ys, right.ys)["q"][1:]
    assert np.all((ratio > 0.5) & (ratio < 2.0)), ratio
    steps = dfx.StepTo(jnp.linspace(0.0, 20.0, 2001))
    sol = rj.simulate(BODY, start(), TS, TOP, solver=dfx.Tsit5(), stepsize_controller=steps)
    with pytest.raises(TypeError, match="PIDController or ConstantStepSize"):
        _ = sol.error


def test_in_a_batch_under_jit_and_backwards():
    def total(omega, ts):
        return rj.simulate(BODY, rj.Attitude(start().q, omega), ts, TOP, throw=False).error.total[
            "q"
        ]

    omegas = jnp.array([[0.4, 1.1, 3.0], [0.1, 0.2, 9.0], [jnp.nan, 0.0, 0.0]])
    back = -TS
    many = jax.jit(jax.vmap(total, (0, None)))(omegas, back)
    one = total(omegas[0], back)
    np.testing.assert_allclose(many[0], one, rtol=1e-2, atol=1e-14)
    assert np.all(many[:2, 1:] > 0) and np.all(many[:2] < 1e-5)
    assert np.all(np.isnan(many[2]))


def test_a_run_of_three_steps_is_not_compared_with_itself():
    # The second run at a fiftieth of the tolerance would take the same steps: nothing limits them.
    scene = rj.orbits.cr3bp(0.0017093877946129851)
    point = rj.Point([1.14934308, 0.35553803, -0.10433587], [-0.05262428, 0.0004922, 0.01500983])
    short = rj.simulate(None, point, [0.0, 0.32], scene, rtol=6e-6, atol=6e-9)
    right = rj.simulate(None, point, [0.0, 0.32], scene, rtol=1e-13, atol=1e-16)
    assert int(short.stats["num_steps"]) < 6
    true = float(jnp.linalg.norm(short.ys.v[-1] - right.ys.v[-1]))
    assert 0.5 * true < float(short.error.total["v"][-1]) < 2 * true


def test_chaos_is_said_to_be_lost():
    body = rj.Inertia.from_principal(1.0, 1.6, 2.2)
    law = rj.torques.HeavyTop(1.0, [1.0, 0.4, 0.7], [0.0, 0.0, -1.0])
    q = np.array([0.29457358, 0.51677653, 0.16788989, 0.78611794])
    state = rj.Attitude(q / np.linalg.norm(q), [1.40904798, 2.72002574, -1.26857553])
    ts = jnp.linspace(0.0, 200.0, 21)
    sol = rj.simulate(body, state, ts, law, rtol=1e-7, atol=1e-10)
    with pytest.warns(UserWarning, match="nothing is known of the states from t = "):
        error = sol.error
    assert np.all(np.diff(np.asarray(error.lost).astype(int)) >= 0) and bool(error.lost[-1])
    assert 30.0 < float(error.known_until) < 120.0
    assert np.all(np.isinf(error.total["q"][np.asarray(error.lost)]))
    with pytest.warns(UserWarning, match="accuracy cannot be had from t = "):
        sol = rj.simulate(body, state, ts, law, accuracy=1e-6)
    reached = np.asarray(sol.error.relative) <= 1e-6
    assert reached[0] and not reached[-1]


def test_states_not_reached_are_nan():
    sol = rj.simulate(BODY, start(), TS, TOP, event=lambda t, state, body: t - 12.0)
    assert np.all(np.isfinite(sol.error.total["q"][:3])) and np.all(
        np.isnan(sol.error.total["q"][3:])
    )


def test_states_of_laws_have_errors_of_their_own():
    wheels = rj.torques.ReactionWheels([[0.0, 0, 1]], [0.1], [30.0], motor=jnp.array([0.02]))
    error = rj.simulate(BODY, start(), TS, wheels, rtol=1e-6, atol=1e-9).error
    assert set(error.total) == {"q", "omega", "own.0"}
    # A constant motor is right to round-off.
    assert float(error.total["own.0"].max()) < 1e-13 < float(error.total["q"].max())


@pytest.mark.parametrize("accuracy", [1e-3, 1e-7, 1e-11])
def test_an_accuracy_is_reached(accuracy):
    sol = rj.simulate(BODY, start(), TS, solver=STEPS, accuracy=accuracy)
    true = truly(sol.ys, rj.simulate(BODY, start(), TS).ys)
    size = float(jnp.linalg.norm(sol.ys.omega, axis=1).max())
    worst = max(true["q"].max(), true["omega"].max() / size)
    assert worst <= accuracy and worst <= float(sol.error.relative.max()) <= accuracy
    # No more steps than a tolerance a hundred times smaller than needed would take.
    assert worst > 2e-4 * accuracy


def test_another_accuracy_does_not_compile_again():
    count = []

    @jax.jit
    def run(accuracy):
        count.append(1)
        sol = rj.simulate(BODY, start(), TS, TOP, accuracy=accuracy)
        return sol.ys.q, sol.error.relative[-1], sol.stats["num_steps"]

    found = [run(accuracy) for accuracy in (1e-4, 1e-9)]
    assert len(count) == 1 and int(found[1][2]) > int(found[0][2])
    assert float(found[0][1]) < 1e-4 and float(found[1][1]) < 1e-9


@pytest.mark.oldest
def test_derivatives_go_through_an_accuracy():
    def end(omega, **how):
        return rj.simulate(BODY, rj.Attitude(start().q, omega), TS[:2], TOP, **how).ys.omega[-1, 0]

    omega, right = jnp.array(OMEGA), dict(rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(
        jax.grad(end)(omega, accuracy=1e-9), jax.grad(end)(omega, **right), rtol=1e-7, atol=1e-7
    )
    np.testing.assert_allclose(
        jax.jacfwd(end)(omega, accuracy=1e-9), jax.grad(end)(omega, **right), rtol=1e-7, atol=1e-7
    )


@pytest.mark.long
def test_second_derivatives_go_through_an_accuracy():
    def energy(rate, **how):
        law = rj.torques.Damping([0.1, 0.1, 0.1])
        sol = rj.simulate(BODY, rj.Spin(rate * jnp.array([0.2, 1.0, 0.3])), [0.0, 2.0], law, **how)
        return jnp.sum(sol.ys.omega[-1] ** 2)

    bend = once(jax.hessian(lambda rate: energy(rate, accuracy=1e-9)))(1.0)
    ends, middle = [energy(rate, rtol=1e-12) for rate in (0.98, 1.02)], energy(1.0, rtol=1e-12)
    np.testing.assert_allclose(bend, (sum(ends) - 2 * middle) / 0.02**2, rtol=1e-3)


def test_a_law_that_holds_the_state_says_the_same_with_an_accuracy():
    def stop(t, state, body):
        return jnp.where(state.omega > 0, -0.6, 0.4)

    said = []
    for how in ({}, dict(accuracy=1e-6)):
        with pytest.raises(RuntimeError, match="all at one place") as error:
            rj.simulate(BODY, rj.Spin(OMEGA), [0.0, 9.0], stop, max_steps=3000, **how)
        said.append(str(error.value))
    assert said[0] == said[1]


def test_an_accuracy_of_the_closed_form_and_what_is_refused():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rj.simulate(BODY, start(), TS, accuracy=1e-12)
    with pytest.warns(UserWarning, match="or take float64"):
        rj.simulate(
            cast(BODY, jnp.float32), start(jnp.float32), TS.astype(jnp.float32), accuracy=1e-9
        )
    for how in (
        dict(rtol=1e-6),
        dict(stepsize_controller=dfx.ConstantStepSize(), dt0=0.1),
        dict(solver=dfx.Tsit5()),
    ):
        with pytest.raises(ValueError, match=r"accuracy|stepsize_controller"):
            rj.simulate(BODY, start(), TS, TOP, accuracy=1e-6, **how)
    with pytest.raises(ValueError, match="accuracy"):
        rj.simulate(BODY, start(), TS, TOP, accuracy=-1.0)


@pytest.mark.parametrize("rtol", [1e-5, 1e-9])
def test_a_value_and_its_gradient_beside_the_closed_form(rtol):
    def f(x, solver=STEPS, **tolerances):
        body = rj.Inertia(0.5 * (x["tensor"] + x["tensor"].T))
        ys = rj.simulate(
            body, rj.Attitude(start().q, x["omega"]), TS[:2], solver=solver, **tolerances
        ).ys
        return ys.omega[-1, 0] + ys.q[-1, 1]

    x = {"tensor": BODY.tensor, "omega": jnp.array(OMEGA)}
    found = rj.error_of(f, x, rtol=rtol, atol=1e-3 * rtol)
    value, gradient = jax.value_and_grad(lambda x: f(x, None))(x)
    assert 0.5 < float(found.value_error / abs(found.value - value)) < 2
    for name, right in gradient.items():
        true = np.linalg.norm(found.derivative[name] - right)
        assert 0.5 < np.linalg.norm(found.derivative_error[name]) / true < 2, name
    assert bool(found.known)


def test_an_array_of_values_in_a_batch():
    def f(omega, **tolerances):
        return rj.simulate(BODY, rj.Attitude(start().q, omega), TS[:2], TOP, **tolerances).ys.omega[
            -1
        ]

    found = jax.vmap(lambda omega: rj.error_of(f, omega))(jnp.array([OMEGA, (0.1, 0.2, 9.0)]))
    assert found.derivative.shape == found.derivative_error.shape == (2, 3, 3)
    assert (
        np.all(found.known) and np.all(found.value_error > 0) and np.all(found.value_error < 1e-7)
    )


def test_errors_print_their_numbers():
    from rigidjax.solve.answer.error import Error, FunctionError

    ts, off = jnp.array([0.0, 2.0]), {"omega": jnp.array([0.0, 3e-9])}
    error = Error(ts, off, {"omega": jnp.zeros(2)}, {"omega": jnp.asarray(1.0)})
    assert repr(error) == "Error(at 2 s: omega 3.0e-09; known until 2 s)"
    late = Error(ts + 1.7e9, off, {"omega": jnp.zeros(2)}, {"omega": jnp.asarray(1.0)})
    assert repr(late).startswith("Error(at 1700000002 s: ")
    one = jnp.asarray(1.5)
    assert repr(FunctionError(one, one, one, one)) == (
        "FunctionError(value=1.5, value_error=1.5, derivative=1.5, derivative_error=1.5)"
    )
