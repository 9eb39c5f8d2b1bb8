"""Explicit Runge–Kutta methods: their order on attitudes, what diffrax asks of them, the lean loop."""

from typing import ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from once import filter_once, once
from systems import driven, free_body_mp

import rigidjax as rj
from rigidjax.motion.equations import AttitudeEquations, EulerEquations, NewtonEuler
from rigidjax.solve import adaptive, fixed
from rigidjax.solve.steps import tableaus
from rigidjax.solve.steps.explicit import DormandPrince8, RungeKutta4, Tsitouras5

# Steps over the span of the slope: errors between the round-off and what is not yet asymptotic.
LADDER = {RungeKutta4: (64, 128, 256), Tsitouras5: (120, 180, 270), DormandPrince8: (10, 14, 20)}
LEEWAY = {4: 0.1, 5: 0.1, 8: 0.2}
METHODS = pytest.mark.parametrize("method", list(LADDER), ids=lambda m: m.__name__)
BODY = rj.Inertia.from_principal(1.0, 1.7, 2.2)
OMEGA = np.array([1.3, 0.7, -1.6])
Q = np.array([0.8, -0.2, 0.4, 0.4]) / np.linalg.norm([0.8, -0.2, 0.4, 0.4])
FREE = AttitudeEquations(BODY)
START = rj.Attitude(Q, OMEGA)
LATE = 3.0


@eqx.filter_jit
def run(solver, field, y0, t0, t1, steps):
    ys = fixed(solver, field, jnp.stack([t0, t1]), y0, steps)
    return jax.tree.map(lambda leaf: leaf[-1], ys)


def slope(method, field, y0, right, t1=LATE):
    counts = np.array(LADDER[method])
    ends = [
        run(method(), field, y0, jnp.zeros(()), jnp.asarray(t1), jnp.asarray(n)) for n in counts
    ]
    gaps = [min(np.linalg.norm(e.q - right), np.linalg.norm(e.q + right)) for e in ends]
    assert 2e-14 < gaps[-1] < 1e-3
    return -np.polyfit(np.log(counts), np.log(gaps), 1)[0]


@METHODS
def test_order_of_the_attitude_of_a_free_tumble(method):
    q, _ = free_body_mp.attitude_and_rate(BODY.tensor.tolist(), Q.tolist(), OMEGA.tolist(), LATE)
    order = method.tableau.order
    found = slope(method, FREE, START, np.array([float(c) for c in q]))
    assert abs(found - order) < LEEWAY[order], found


@pytest.mark.oldest
@METHODS
def test_order_under_a_torque_that_depends_on_time(method):
    order = method.tableau.order
    y0 = driven.start(jnp.zeros(()))
    found = slope(method, driven.field(), y0, np.asarray(driven.attitude(jnp.asarray(LATE))))
    assert abs(found - order) < LEEWAY[order], found


class Broken(Tsitouras5):
    """One coefficient off by a thousandth."""

    tableau: ClassVar = tableaus.TSITOURAS5._replace(
        a=(*tableaus.TSITOURAS5.a[:2], tableaus.TSITOURAS5.a[2] | {1: -6.353}, *tableaus.TSITOURAS5.a[3:])
    )  # fmt: skip


def test_the_order_test_sees_a_wrong_coefficient():
    LADDER[Broken] = LADDER[Tsitouras5]
    y0 = driven.start(jnp.zeros(()))
    found = slope(Broken, driven.field(), y0, np.asarray(driven.attitude(jnp.asarray(LATE))))
    del LADDER[Broken]
    assert abs(found - 5) > 0.3


def trees(order, matrix, weights):
    """Σ b Φ(τ) − 1/γ(τ) for all rooted trees, by order (Butcher; Hairer, Nørsett, Wanner II.2)."""
    nodes = {1: [(np.ones(len(weights)), 1)]}  # (Φ of the stages, γ) by number of vertices
    for p in range(2, order + 1):
        found = []
        for branches in partitions(p - 1):
            options = [[]]
            for size, copies in branches:
                options = [
                    [*o, *pick]
                    for o in options
                    for pick in multisets(range(len(nodes[size])), copies, size)
                ]
            for option in options:
                phi, gamma = np.ones(len(weights)), p
                for size, index in option:
                    phi, gamma = (
                        phi * (matrix @ nodes[size][index][0]),
                        gamma * nodes[size][index][1],
                    )
                found.append((phi, gamma))
        nodes[p] = found
    return {p: [weights @ phi - 1 / gamma for phi, gamma in nodes[p]] for p in nodes}


def partitions(n, largest=None):
    largest = n if largest is None else largest
    if n == 0:
        yield []
    for size in range(min(n, largest), 0, -1):
        for copies in range(n // size, 0, -1):
            for rest in partitions(n - size * copies, size - 1):
                yield [(size, copies), *rest]


def multisets(items, copies, size, first=0):
    items = list(items)
    if copies == 0:
        yield []
        return
    for i in range(first, len(items)):
        for rest in multisets(items, copies - 1, size, i):
            yield [(size, items[i]), *rest]


def dense_matrix(tableau):
    stages = len(tableau.a) + 2 + len(tableau.extra_a)
    a = np.zeros((stages, stages))
    for i, row in enumerate([*tableau.a, tableau.b, *tableau.extra_a], start=1):
        for j, w in row.items():
            a[i, j] = w
    return a


def row(sparse, stages):
    out = np.zeros(stages)
    for i, w in sparse.items():
        out[i] = w
    return out


@METHODS
def test_order_conditions_of_solution_estimates_and_dense_output(method):
    t = method.tableau
    a = dense_matrix(t)
    n = len(a)
    b = row(t.b, n)
    conditions = trees(t.order + 1, a, b)
    assert sum(len(v) for p, v in conditions.items() if p <= 8) == {4: 17, 5: 37, 8: 200}[t.order]
    for p in range(1, t.order + 1):
        np.testing.assert_allclose(conditions[p], 0, atol=2e-14)
    assert np.max(np.abs(conditions[t.order + 1])) > 1e-7
    estimates = {4: (3,), 5: (4,), 8: (5, 3)}[t.order]
    for sparse, order in zip(t.errors, estimates, strict=True):
        low = trees(order + 1, a, b - row(sparse, n))
        for p in range(1, order + 1):
            np.testing.assert_allclose(low[p], 0, atol=2e-14)
        assert np.max(np.abs(low[order + 1])) > 1e-7
    # Dense output at θ: the same conditions with 1/γ scaled by θ^p, one order below the method.
    theta = 0.37
    rise, left, right = b, row({0: 1.0}, n), row({len(t.a) + 1: 1.0}, n)
    rows = [rise, left - rise, 2 * rise - left - right, *(row(d, n) for d in t.dense)]
    weights = np.zeros(n)
    for i in reversed(range(len(rows))):
        weights = (weights + rows[i]) * (theta if i % 2 == 0 else 1 - theta)
    within = trees(t.order - 1, a, np.zeros(n))
    ready = trees(t.order - 1, a, weights)
    for p in range(1, t.order):
        wanted = -np.array(within[p]) * theta**p
        found = np.array(ready[p]) - np.array(within[p])
        np.testing.assert_allclose(found, wanted, atol=3e-13)


@METHODS
def test_plain_diffrax_takes_the_same_steps_and_saves_on_the_group(method):
    term, y0 = dfx.ODETerm(driven.field()), driven.start(jnp.zeros(()))
    ts = jnp.linspace(0.0, LATE, 41)
    steps = LADDER[method][-1]

    @once
    def solve(t1, dt):
        return dfx.diffeqsolve(
            term, method(), 0.0, t1, dt, y0,
            saveat=dfx.SaveAt(subs=[dfx.SubSaveAt(ts=ts), dfx.SubSaveAt(t1=True)]),
        ).ys  # fmt: skip

    inside, end = solve(jnp.asarray(LATE), jnp.asarray(LATE / steps))
    same = run(method(), driven.field(), y0, jnp.zeros(()), jnp.asarray(LATE), jnp.asarray(steps))
    np.testing.assert_allclose(end.q[-1], same.q, atol=1e-13)
    assert float(jnp.abs(jnp.linalg.norm(inside.q, axis=1) - 1).max()) < 1e-15 * 2
    # In between, no worse than a few times the error at the steps themselves.
    reached = float(driven.error(end.q[-1], jnp.asarray(LATE)))
    assert float(driven.error(inside.q, ts).max()) < 20 * reached + 1e-14


def test_adaptive_loops_and_diffrax_controllers_agree():
    y0, ts = driven.start(jnp.zeros(())), jnp.array([0.0, 1.0, LATE])

    @filter_once
    def both(tol):
        ours = adaptive(Tsitouras5(), driven.field(), ts, y0, rtol=tol, atol=tol)
        theirs = dfx.diffeqsolve(
            dfx.ODETerm(driven.field()), Tsitouras5(), ts[0], ts[-1], None, y0,
            stepsize_controller=dfx.PIDController(rtol=tol, atol=tol), saveat=dfx.SaveAt(ts=ts),
        )  # fmt: skip
        return ours.ys, theirs.ys, ours.result, ours.num_steps, theirs.stats["num_steps"]

    for tolerance in (1e-5, 1e-9):
        ours, theirs, result, count, other = both(jnp.asarray(tolerance))
        assert result == dfx.RESULTS.successful
        assert float(driven.error(ours.q, ts).max()) < 20 * tolerance
        assert float(driven.error(theirs.q, ts).max()) < 20 * tolerance
        assert int(count) < 2 * int(other) + 10


@pytest.mark.slow
def test_every_derivative_agrees():
    # d(attitude)/d(Ω0), in both modes of both loops, and against 50 digits.
    @eqx.filter_jit
    def ways(omega):
        def plain(adjoint):
            def end(w):
                return dfx.diffeqsolve(
                    dfx.ODETerm(FREE), Tsitouras5(), 0.0, 1.0, None, rj.Attitude(Q, w),
                    stepsize_controller=dfx.PIDController(rtol=1e-11, atol=1e-11), adjoint=adjoint,
                ).ys.q[-1]  # fmt: skip

            return end

        def equal_steps(w):
            return fixed(RungeKutta4(), FREE, jnp.array([0.0, 1.0]), rj.Attitude(Q, w), 400).q[-1]

        def long_steps(w):
            y0, ts = rj.Attitude(Q, w), jnp.array([0.0, 1.0])
            return adaptive(Tsitouras5(), FREE, ts, y0, rtol=1e-11, atol=1e-11).ys.q[-1]

        return [
            jax.jacfwd(plain(dfx.ForwardMode()))(omega),
            jax.jacrev(plain(dfx.RecursiveCheckpointAdjoint()))(omega),
            jax.jacrev(equal_steps)(omega),
            jax.jacfwd(long_steps)(omega),
        ]

    scene = (tuple(map(tuple, BODY.tensor.tolist())), tuple(Q.tolist()), tuple(OMEGA.tolist()), 1.0)
    wanted = np.array(free_body_mp.jacobian(*scene))[:4, 6:9]
    for found in ways(jnp.asarray(OMEGA)):
        sign = np.sign(np.sum(np.asarray(found) * wanted))
        np.testing.assert_allclose(sign * found, wanted, atol=2e-9)


@pytest.mark.oldest
def test_events_and_the_gradient_of_their_time():
    # The first zero of Ω2 (notes' flip); its time by differences of diffrax's own Dopri8.
    def flip(solver):
        def when(omega):
            return dfx.diffeqsolve(
                dfx.ODETerm(FREE), solver, 0.0, 20.0, None, rj.Attitude(Q, omega),
                stepsize_controller=dfx.PIDController(rtol=1e-11, atol=1e-11),
                event=dfx.Event(lambda t, y, args, **k: y.omega[1], optx.Newton(1e-11, 1e-11)),
            ).ts[-1]  # fmt: skip

        return when

    ours = once(jax.value_and_grad(flip(Tsitouras5())))(jnp.asarray(OMEGA))
    reference = once(flip(dfx.Dopri8()))
    np.testing.assert_allclose(ours[0], reference(jnp.asarray(OMEGA)), atol=1e-8)
    step = 1e-4
    differences = [
        (reference(OMEGA + step * e) - reference(OMEGA - step * e)) / (2 * step) for e in np.eye(3)
    ]
    np.testing.assert_allclose(ours[1], differences, rtol=1e-5, atol=1e-5)


def test_backwards_rigid_spin_and_batches():
    body = rj.MassProperties(2.0, jnp.zeros(3), BODY.second_moment)
    field = NewtonEuler(body, rj.torques.Damping(jnp.full(3, 0.1)))
    y0 = rj.Rigid([0.0, 1, 2], [3.0, 0, -1], Q, OMEGA)

    @once
    def go(y, t0, t1):
        return jax.tree.map(
            lambda leaf: leaf[-1],
            dfx.diffeqsolve(
                dfx.ODETerm(field), Tsitouras5(), t0, t1, None, y,
                stepsize_controller=dfx.PIDController(rtol=1e-10, atol=1e-10),
            ).ys,
        )  # fmt: skip

    zero, late = jnp.zeros(()), jnp.asarray(LATE)
    back = go(go(y0, zero, late), late, zero)
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(y0), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)
    rates = jnp.stack([jnp.asarray(OMEGA), 2.0 * OMEGA, jnp.zeros(3)])
    ts = jnp.array([0.0, 1.0])
    euler = EulerEquations(BODY)

    def end(w):
        return adaptive(Tsitouras5(), euler, ts, rj.Spin(w), rtol=1e-9, atol=1e-9).ys.omega[-1]

    together = once(jax.vmap(end))(rates)
    wanted = [rj.exact.free_body(BODY, rj.Spin(w), 1.0).omega for w in rates]
    np.testing.assert_allclose(together, jnp.stack(wanted), atol=1e-8)


def test_single_precision_stays_single():
    single = lambda x: jnp.asarray(x, jnp.float32)
    field, y0 = driven.field(jnp.float32), driven.start(single(0.0))
    ts = single([0.0, LATE])
    end = fixed(Tsitouras5(), field, ts, y0, 1000).q[-1]
    assert end.dtype == jnp.float32
    assert float(driven.error(end, ts[1])) < 1e-5


@pytest.mark.oldest
@pytest.mark.parametrize("method", [Tsitouras5, DormandPrince8], ids=lambda m: m.__name__)
def test_single_precision_is_neither_fast_nor_slow(method):
    """Ω of a symmetric body circles its axis at 1 rad/s: the phase after 600 rad, by each loop.

    The weights of Dormand and Prince, each rounded by itself, sum to 1 + 4.2e-7: 2.5e-4 rad.
    """
    field = EulerEquations(rj.Inertia(jnp.diag(jnp.array([1.0, 1.0, 2.0], jnp.float32))))
    start = rj.Spin(jnp.array([1.0, 0.0, 1.0], jnp.float32))
    here, there = np.float32(0.0), np.float32(600.0)
    by_equal_steps = run(method(), field, start, jnp.asarray(here), jnp.asarray(there), 2400)
    by_diffrax = dfx.diffeqsolve(
        dfx.ODETerm(field), method(), here, there, np.float32(0.25), start,
        max_steps=2400, adjoint=rj.solvers.ReplayAdjoint(),
    ).ys.omega[-1]  # fmt: skip
    for omega in (by_equal_steps.omega, by_diffrax):
        assert omega.dtype == jnp.float32
        phase = np.arctan2(float(omega[1]), float(omega[0]))
        assert abs(np.remainder(phase - 600.0 + np.pi, 2 * np.pi) - np.pi) < 6e-5


@pytest.mark.parametrize("name", ["KUTTA4", "TSITOURAS5", "DORMAND_PRINCE8"])
def test_rounded_weights_keep_their_sums(name):
    """The sums of a long row move by a small part of the round-off of its largest weight."""
    exact, dtype = getattr(tableaus, name), np.float32
    rounded = tableaus.round_weights(exact, dtype)
    nodes = np.array([0.0, *exact.c, 1.0, *exact.extra_c])
    for old, new in zip(
        [*exact.a, exact.b, *exact.extra_a], [*rounded.a, rounded.b, *rounded.extra_a], strict=True
    ):
        weights = np.array(list(new.values()))
        assert list(old) == list(new)
        np.testing.assert_array_equal(weights.astype(dtype).astype(float), weights)
        change = weights - np.array(list(old.values()))
        assert (np.abs(change) <= np.spacing(np.abs(weights).astype(dtype))).all()
        if len(new) >= 7:
            least = 0.1 * np.finfo(dtype).eps * np.abs(weights).max()
            assert abs(change.sum()) < least
            assert abs(change @ nodes[list(new)]) < least
    assert tableaus.round_weights(exact, float) is exact


def test_a_long_row_is_rounded_soon():
    """25 weights, as in a method of order 12: their sums move less than by the nearest numbers."""
    weights = np.random.default_rng(3).normal(size=25) * 10.0 ** np.linspace(-3, 1, 25)
    row, times = dict(enumerate(weights)), np.linspace(0.0, 1.0, 25)
    long = tableaus.Tableau(
        order=12, c=tuple(times[1:-1]), a=({0: 0.5},) * 23, b=row, errors=({0: 1.0},)
    )
    rounded = np.array(list(tableaus.round_weights(long, np.float32).b.values()))
    nearest = weights.astype(np.float32).astype(float)
    for sums in (np.ones(25), times):
        assert abs((rounded - weights) @ sums) < 0.1 * abs((nearest - weights) @ sums)


def test_failures_are_results_not_numbers():
    ts = jnp.array([0.0, 1.0, 20.0])
    out = adaptive(Tsitouras5(), FREE, ts, START, rtol=1e-9, atol=1e-9, max_steps=60)
    assert out.result == dfx.RESULTS.max_steps_reached
    assert np.all(np.isfinite(out.ys.q[1])) and np.all(np.isnan(out.ys.q[2]))
    bad = rj.Attitude(Q, [jnp.nan, 0.0, 1.0])
    out = adaptive(Tsitouras5(), FREE, ts, bad, rtol=1e-9, atol=1e-9)
    assert out.result != dfx.RESULTS.successful
    assert int(out.num_steps) <= 2
