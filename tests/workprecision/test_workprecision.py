"""The tool: references against other oracles, errors, the front, the table, files, the command."""

import dataclasses
import math
import sys
import types

import diffrax as dfx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from orbits.three_body_series import solve
from systems import free_body_mp, tops_mp

import rigidjax as rj
from rigidjax.cli.command import main
from rigidjax.workprecision import (
    BenchmarkScene,
    choose,
    diffrax_method,
    draw,
    measure,
    methods,
    scenes,
    table,
)
from rigidjax.workprecision.measurement import compute_reference, long_drift, to_float32
from rigidjax.workprecision.pareto import pareto_front, time_to
from rigidjax.workprecision.record import Measurement, changes, read_csv, write_csv
from rigidjax.workprecision.scene import PreparedMethod, TimedMethod, state_errors

NAMES = list(scenes())


def line(method="a", error=1e-6, time=1.0, **more):
    words = dict(scene="s", group="ours", kind="value", adjoint="", setting=1e-6) | more
    return Measurement(method=method, error=error, time=time, **words)


@pytest.mark.parametrize("name", NAMES)
def test_the_plain_equations_are_those_of_the_library(name):
    scene = scenes()[name]()
    numbers = [float(x) for x in scene.numbers]
    plain = scene.plain(numbers, math.sin, math.cos, math.sqrt)
    field = rj.equations_of_motion(scene.body, scene.state0, scene.torque)
    start = np.asarray(scene.flatten(scene.state0))
    for t in (0.0, 1.3):
        ours = scene.flatten(field(jnp.asarray(t), scene.state0, None))
        np.testing.assert_allclose(ours, plain(t, start), rtol=1e-13, atol=1e-14)


def test_references_against_other_oracles():
    """Taylor series of the free body, quadrature of Lagrange's top, Taylor series of three bodies."""
    top = scenes()["middle-axis"]()
    q, omega = free_body_mp.attitude_and_rate(
        np.asarray(top.body.tensor).tolist(), np.asarray(top.state0.q).tolist(),
        np.asarray(top.state0.omega).tolist(), top.end, digits=30, order=24, longest=0.4,
    )  # fmt: skip
    right = np.array([float(x) for x in [*q, *omega]])
    np.testing.assert_allclose(top.reference.end, right, atol=1e-15)
    for name in ("spinning-top-1e2", "spinning-top-1e4"):
        spun = scenes()[name]()
        rates = (0.0, 0.0, float(spun.state0.omega[2]))
        cosine = tops_mp.lagrange_cosine(1, "0.7", 1, "0.3", rates, 1)
        _, x, y, _ = spun.reference.end[:4]
        assert abs(1 - 2 * (x * x + y * y) - float(cosine)) < 1e-14
    orbit = scenes()["arenstorf"]()
    with mp.workdps(30):
        start = [mp.mpf(float(x)) for x in orbit.numbers]
        end = solve(0.012277471, start, orbit.end)
    np.testing.assert_allclose(orbit.reference.end, [float(x) for x in end], atol=1e-13)


def test_each_reference_states_its_error():
    for name in NAMES:
        reference = scenes()[name]().reference
        assert 0 < reference.error < 1e-15 and "40 digits" in reference.source
        if reference.gradient:
            size = np.linalg.norm(reference.gradient)
            assert reference.gradient_error < 1e-10 * size, name


# What the table "choosing a method" promises of `simulate` as it stands, rtol 1e-9: an error, rad.
PROMISED = {
    "free-top": 1e-13,
    "middle-axis": 1e-13,
    "heavy-top": 5e-8,
    "asymmetric-top": 5e-8,
    "gravity-gradient": 2e-8,
    "damped-gyrostat": 2e-8,
    "foucault": 1e-9,
    "arenstorf": 1e-7,
    "spinning-top-1e2": 1e-9,
    "spinning-top-1e3": 2e-8,
    "spinning-top-1e4": 1e-6,
}


USUAL = ("free-top", "heavy-top", "gravity-gradient", "damped-gyrostat")


@pytest.mark.parametrize(
    "name", [n if n in USUAL else pytest.param(n, marks=pytest.mark.slow) for n in NAMES]
)
def test_the_defaults_of_simulate_keep_what_the_table_promises(name):
    scene = scenes()[name]()
    ts = jnp.array([0.0, scene.end])
    out = rj.simulate(scene.body, scene.state0, ts, scene.torque)
    end = scene.flatten(jax.tree.map(lambda leaf: leaf[-1], out.ys))
    error, _ = state_errors(scene, end, scene.reference.end)
    print(f"{name}: {error:.1e}")
    assert error < PROMISED[name]


def test_a_scene_and_a_method_of_ones_own():
    """A ball slowed by damping, whose rate is exp(−ct/I): reference worked out, a peer given."""
    scene = BenchmarkScene(
        "ball", "a ball slowed down", rj.Inertia.from_principal(2.0, 2.0, 2.0),
        rj.Attitude([1.0, 0, 0, 0], [0.3, -0.4, 0.5]), rj.torques.Damping([0.1] * 3), 6.0,
    )  # fmt: skip
    right = compute_reference(scene, gradients=False)
    scene = dataclasses.replace(scene, reference=right)
    slowed = np.exp(-0.05 * 6.0) * np.array([0.3, -0.4, 0.5])
    np.testing.assert_allclose(right.end[4:], slowed, rtol=1e-13)
    turn = (1 - np.exp(-0.3)) / 0.05 * np.array([0.3, -0.4, 0.5])
    exact = np.concatenate([np.asarray(rj.quaternion.exp(jnp.asarray(turn))), slowed])
    # The angle is told to 1e-13 of a radian, whatever the sign of the quaternion.
    assert state_errors(scene, -exact, right.end)[0] < 1e-13
    off = np.concatenate(
        [rj.quaternion.multiply(exact[:4], rj.quaternion.exp(jnp.array([3e-9, 0, 0]))), slowed]
    )
    np.testing.assert_allclose(state_errors(scene, off, exact)[0], 3e-9, rtol=1e-6)
    guess = TimedMethod(
        "a guess", "peer", (1e-3,), lambda scene: PreparedMethod(lambda setting: (off, 1.0))
    )
    chosen = [m for m in methods("jax") if m.name == "diffrax Tsit5"]
    found = measure(scene, chosen, peers=[guess], gradients=False, thin=5, rounds=1)
    assert {r.method for r in found} == {"diffrax Tsit5", "a guess"}
    (guessed,) = (r for r in found if r.method == "a guess")
    np.testing.assert_allclose(guessed.error, 3e-9, rtol=1e-4)
    solved = [r for r in found if r.method == "diffrax Tsit5"]
    assert len(solved) == 3 and solved[-1].error < 1e-11 < solved[0].error
    assert all(r.time_low <= r.time <= r.time_high and r.steps > 0 for r in solved)
    assert all(r.memory >= 0 and r.compile > 0 for r in solved)


def test_the_gradient_is_compared_with_the_reference():
    scene = scenes()["spinning-top-1e2"]()
    method = diffrax_method(dfx.Tsit5(), gradients=True)
    forward = {"forward": method.gradients["forward"]}
    chosen = [method._replace(gradients=forward, settings=(1e-6, 1e-12))]
    found = [r for r in measure(scene, chosen, rounds=1) if r.kind == "gradient"]
    assert [r.adjoint for r in found] == ["forward"]
    assert found[0].error < 1e-9
    assert max(found[0].by_inertia, found[0].by_rate, found[0].by_attitude) < 1e-8


def test_a_scene_in_single_precision():
    """Its truth is that of the rounded numbers."""
    double = scenes()["heavy-top"]()
    scene = to_float32(double, gradients=False)
    assert {leaf.dtype for leaf in jax.tree.leaves(scene.torque)} == {jnp.dtype("float32")}
    rounded, _ = state_errors(double, scene.reference.end, double.reference.end)
    chosen = [m for m in methods() if m.name in ("RungeKutta4, equal steps", "simulate, accuracy")]
    records = measure(scene, chosen, gradients=False, thin=3, rounds=1)
    stepped = [r.error for r in records if r.method.startswith("Runge")]
    assert 1e-8 < rounded < 1e-5
    assert min(stepped) < 2e-5
    assert all(r.error <= r.setting for r in records if r.setting == 1e-3)
    assert all(r.setting > 1e-6 for r in records)


@pytest.mark.long
def test_gradients_of_diffrax_in_single_precision():
    """Its adjoint equation, too, which takes no times of another precision than the state's."""
    scene = to_float32(scenes()["free-top"](), gradients=False)
    for compiled in diffrax_method(dfx.Dopri8(), gradients=True).gradients.values():
        gradient, _ = compiled(scene).run(1e-3)
        assert gradient.dtype == jnp.float32 and np.isfinite(gradient).all()


def test_the_front_and_the_table():
    ladder = [line("a", 1e-2, 1.0), line("a", 1e-6, 2.0), line("a", 1e-12, 8.0)]
    other = [line("b", 1e-4, 1.2, group="jax"), line("b", 1e-8, 9.0, group="jax")]
    best = pareto_front(ladder + other)
    assert [(r.method, r.error) for r in best] == [
        ("a", 1e-2), ("b", 1e-4), ("a", 1e-6), ("a", 1e-12),
    ]  # fmt: skip
    # The curve of a passes 1e-9 at 4 s: what takes longer is not on the front, nor what is worse.
    late, soon = line("c", 1e-9, 4.5, group="jax"), line("c", 1e-9, 3.9, group="jax")
    assert "c" not in {r.method for r in pareto_front([*ladder, late])}
    assert "c" in {r.method for r in pareto_front([*ladder, soon])}
    assert time_to(ladder, 1e-9) == pytest.approx(4.0)
    assert math.isnan(time_to(ladder, 1e-13))
    (choice,) = choose(ladder + other, [1e-4])
    assert (choice.method, choice.peer) == ("a", "b")
    assert (choice.time, choice.peer_time) == pytest.approx((math.sqrt(2), 1.2))
    assert "| s | 1e-04 | a |" in table([choice])
    with pytest.raises(ValueError, match="pareto_front: wanted records of one scene and one kind"):
        pareto_front([*ladder, line(scene="elsewhere")])


def test_what_moved_is_said():
    was = [line(time=2.0, steps=100.0), line("diffrax Dopri8", group="jax", time=1.0)]
    assert changes(was, was) == ([], [])
    worse = [dataclasses.replace(was[0], error=1e-4, steps=150.0, time=9.0), was[1]]
    wrong, paced = changes(worse, was)
    assert wrong == [
        "s, value, a at 1e-06: error was 1e-06, is 0.0001",
        "s, value, a at 1e-06: steps were 100, are 150",
    ]
    assert paced == ["s, value, a: time over diffrax Dopri8's was 2, is 9"]
    assert changes([was[1]], was)[0] == ["s, value, a at 1e-06: not there any more"]


def test_files_and_charts(tmp_path):
    records = [line(), line("b", 1e-9, 3.0, group="peer"), line(kind="gradient", adjoint="forward")]
    path = tmp_path / "records.csv"
    write_csv(records, path)
    again = read_csv(path)
    assert [(r.label, r.error, r.time) for r in again] == [
        (r.label, r.error, r.time) for r in records
    ]
    assert math.isnan(again[0].energy)
    (tmp_path / "other.csv").write_text("t,wx\n1,2\n")
    with pytest.raises(ValueError, match=r"other.csv: wanted the columns .* lacks adjoint"):
        read_csv(tmp_path / "other.csv")
    pytest.importorskip("matplotlib").use("Agg")
    figure = draw([*records, line(scene="elsewhere")], title="two scenes")
    # Of each scene values and gradients, and what was reached of what was asked.
    assert len(figure.axes) == 6
    assert figure.axes[0].get_xscale() == "log"
    with pytest.raises(ValueError, match="draw: wanted records"):
        draw([])


@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_named(capsys, tmp_path):
    body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 0, 1])
    with pytest.raises(TypeError, match="wanted an Attitude or a Point, got Spin"):
        BenchmarkScene("x", "x", body, start, None, 1.0)
    with pytest.raises(TypeError, match="an Inertia with an Attitude, or None with a Point"):
        BenchmarkScene("x", "x", None, rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1]), None, 1.0)
    with pytest.raises(ValueError, match="wanted an end > 0"):
        BenchmarkScene("x", "x", body, rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1]), None, 0.0)
    with pytest.raises(TypeError, match=r'scenes\(\)\["heavy-top"\]\(\)'):
        measure("heavy-top")
    with pytest.raises(TypeError, match=r"wanted methods of workprecision.methods\(\), got str"):
        measure(scenes()["free-top"](), ["Tsit5"])
    assert main(["workprecision", "heavy top"]) == 2
    error = capsys.readouterr().err
    assert "scene: wanted one of free-top" in error and "got 'heavy top'" in error
    assert main(["workprecision", "--check", str(tmp_path / "none.csv")]) == 2
    assert "none.csv" in capsys.readouterr().err
    assert main(["workprecision", "--thin", "0"]) == 2
    assert "wanted 1 or more" in capsys.readouterr().err


def test_the_command_reads_what_was_measured(capsys, tmp_path):
    path = tmp_path / "records.csv"
    write_csv([line(), line("diffrax Dopri8", 1e-9, 2.0, group="jax")], path)
    assert main(["workprecision", "--from", str(path), "--choose", "--check", str(path)]) == 0
    told = capsys.readouterr().out
    assert "nothing moved" in told and "| s | 1e-04 | a |" in told
    kept = tmp_path / "kept.csv"
    assert main(["workprecision", "--from", str(path), "--keep", str(kept)]) == 0
    # Times as multiples of the base's: of this machine nothing is left.
    assert [r.time for r in read_csv(kept)] == [0.5, 1.0]
    assert main(["workprecision", "--from", str(path), "--check", str(kept)]) == 0
    capsys.readouterr()
    write_csv([line(error=1e-3)], tmp_path / "worse.csv")
    assert main(["workprecision", "--from", str(path), "--check", str(tmp_path / "worse.csv")]) == 1
    assert "moved: s, value, a at 1e-06: error was 0.001, is 1e-06" in capsys.readouterr().out


@pytest.mark.slow
def test_nothing_moved_since_the_stored_table():
    """Errors and steps only: times are of no interest to a test."""
    assert main(["workprecision", "--check"]) == 0


@pytest.mark.slow
def test_a_drift_that_is_bounded_and_one_that_grows():
    found = long_drift(100_000)
    drift = {(r.method, r.scene): r.energy for r in found}
    early, late = "long-drift, first hundredth", "long-drift"
    assert drift["Splitting4, equal steps", late] < 5 * drift["Splitting4, equal steps", early]
    assert drift["RungeKutta4, equal steps", late] > 10 * drift["RungeKutta4, equal steps", early]


def test_a_peer_that_gives_up_leaves_no_record_and_stops_nothing(monkeypatch):
    from rigidjax.workprecision.peers import _prepare_gradsolve

    def solve(*_, **__):
        raise RuntimeError("record: trajectory 0 exhausted max_steps=50000 before t1=1.0")

    (ours,) = [m for m in methods("ours") if m.name == "simulate"]
    fake = types.ModuleType("gradsolve")
    fake.solve = solve
    monkeypatch.setitem(sys.modules, "gradsolve", fake)
    scene = scenes()["heavy-top"]()
    gives_up = TimedMethod("gives up", "peer", (1e-3, 1e-6), _prepare_gradsolve)
    records = measure(scene, [gives_up, ours], gradients=False, thin=8, rounds=1)
    assert {r.method for r in records} == {"simulate"}
