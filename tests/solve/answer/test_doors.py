"""Doors of `simulate`: what a first mistake is answered, and what other programs do with a run."""

import math

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jax import export
from once import once

import rigidjax as rj
from rigidjax import solvers, torques

BODY = rj.Inertia.from_principal(1.0, 1.6, 2.2)
START = rj.Attitude([1.0, 0, 0, 0], [3.0, 4.0, -3.0])
DRAG = torques.Damping([0.1, 0.2, 0.3])


def late(t, state, body):
    if t > 0.25:
        return jnp.ones(3)
    return jnp.zeros(3)


class Waving(eqx.Module):
    def __call__(self, t, state, body):
        return jnp.ones(3) * math.sin(t)


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (late, r"torque late, line \d+ of test_doors.py \(if t > 0\.25:\)"),
        (torques.Sum(DRAG, late), "torque late, line"),
        (Waving(), r"torque Waving, line \d+ .*math\.sin\(t\)"),
        (lambda t, s, b: jnp.ones(3) * float(s.omega[0]), "torque <lambda>, line"),
        (lambda t, s, b: jnp.ones(3) * np.sin(t), "torque <lambda>, line"),
        (lambda t, s, b: jnp.eye(3)[int(t)], "torque <lambda>, line"),
    ],
)
def test_python_that_reads_the_time_is_answered_with_where(law, words):
    with pytest.raises(TypeError, match=words) as caught:
        rj.simulate(BODY, START, [0.0, 1.0], law)
    message = str(caught.value)
    assert "jnp.where" in message and "\n" not in message


def test_conditions_and_forces_say_it_too():
    with pytest.raises(TypeError, match=r"condition late, line .*jnp\.where"):
        rj.simulate(BODY, START, [0.0, 1.0], DRAG, event=late)
    with pytest.raises(TypeError, match=r"force late, line .*jnp\.where"):
        rj.simulate(None, rj.Point([1.0, 0, 0], [0.0, 0, 0]), [0.0, 1.0], late)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"solver": dfx.Tsit5()}, "with solver=Tsit5, a run"),
        ({"solver": solvers.Splitting4(), "dt0": 0.1}, "with solver=Splitting4, a run"),
        ({"max_steps": None}, "with max_steps=None, a run"),
        ({"adjoint": dfx.DirectAdjoint()}, "with adjoint=DirectAdjoint, a run"),
        (
            {"progress_meter": dfx.TextProgressMeter(), "solver": dfx.Dopri5()},
            "with solver=Dopri5 and progress_meter=TextProgressMeter, a run",
        ),
    ],
)
@pytest.mark.parametrize("asked", ["accuracy", "event"])
def test_the_argument_that_does_not_fit_is_named(asked, given, words):
    value = {"accuracy": 1e-6, "event": lambda t, s, b: s.omega[0] - 1.0}[asked]
    with pytest.raises(ValueError, match=f"simulate: {asked} does not go {words}"):
        rj.simulate(BODY, START, [0.0, 1.0], DRAG, **{asked: value}, **given)


@pytest.mark.parametrize(
    "law", [None, DRAG, lambda t, s, b: jnp.where(t < 0.7, 1.0, 0.0) * s.omega]
)
def test_a_run_without_errors_can_be_exported(law):
    def rates(omega):
        ts = jnp.array([0.0, 0.5, 2.0])
        return rj.simulate(BODY, rj.Attitude(START.q, omega), ts, law, throw=False).ys.omega

    exported = export.export(jax.jit(rates))(START.omega)
    np.testing.assert_allclose(exported.call(START.omega), rates(START.omega), rtol=1e-12)


def test_saved_times_have_derivatives_backwards_too():
    def late_rate(ts):
        ys = rj.simulate(BODY, START, ts, DRAG, throw=False).ys
        return ys.omega[1], ys

    for ts in (jnp.array([0.0, 0.5, 1.0]), jnp.array([0.0, -0.5, -1.0])):
        slope, state = jax.jacfwd(late_rate, has_aux=True)(ts)
        there = jax.tree.map(lambda a: a[1], state)
        field = rj.equations_of_motion(BODY, START, DRAG)
        np.testing.assert_allclose(slope[:, 1], field(ts[1], there).omega, rtol=1e-6)


@pytest.mark.parametrize(
    "solver", [solvers.Tsitouras5(), solvers.RungeKutta4(), solvers.DormandPrince8()]
)
def test_newton_finds_the_largest_of_many_numbers(solver):
    # The condition is a maximum, whose derivative is lost where XLA rounds twice.
    event = dfx.Event(lambda t, y, args, **_: jnp.max(y - 1.0), optx.Newton(1e-5, 1e-5))
    start = jnp.arange(10.0) + 2.0
    for control in (dfx.ConstantStepSize(), dfx.PIDController(rtol=1e-3, atol=1e-6)):
        found = dfx.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: -y), solver, 0.0, jnp.inf, 1.0, start, event=event,
            stepsize_controller=control,
        )  # fmt: skip
        np.testing.assert_allclose(found.ys[-1].max(), 1.0, atol=1e-5)


@pytest.mark.parametrize(
    "solver",
    [
        solvers.Tsitouras5(),
        solvers.Magnus4(),
        pytest.param(solvers.FreeSolver(), marks=pytest.mark.long),
    ],
)
def test_a_run_goes_on_from_its_solver_state(solver):
    term = dfx.ODETerm(rj.equations_of_motion(BODY, START))
    saved = dfx.SaveAt(t1=True, solver_state=True)

    @once
    def rates_at_the_end(start):
        first = dfx.diffeqsolve(term, solver, 0.0, 0.5, 0.01, start, saveat=saved)
        assert first.solver_state is not None
        there = jax.tree.map(lambda a: a[-1], first.ys)
        second = dfx.diffeqsolve(
            term, solver, 0.5, 1.0, 0.01, there, solver_state=first.solver_state, saveat=saved
        )
        return second.ys.omega, dfx.diffeqsolve(term, solver, 0.0, 1.0, 0.01, start).ys.omega

    in_two, at_once = rates_at_the_end(START)
    np.testing.assert_allclose(in_two, at_once, rtol=1e-9)
