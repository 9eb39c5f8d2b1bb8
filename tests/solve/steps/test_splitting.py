"""Splittings on the exact free flow: order on attitudes, invariants over long runs, refusals."""

from typing import ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import filter_once, once
from systems import driven

import rigidjax as rj
from rigidjax.motion.equations import AttitudeEquations, EulerEquations
from rigidjax.solve import fixed
from rigidjax.solve.solvers import DormandPrince8, Splitting2, Splitting4, Splitting6
from rigidjax.solve.steps import splitting

LADDER = {Splitting2: (40, 80, 160), Splitting4: (40, 80, 160), Splitting6: (10, 16, 24)}
METHODS = pytest.mark.parametrize("method", list(LADDER), ids=lambda m: m.__name__)
TENSOR = np.array([[1.0, 0.1, -0.05], [0.1, 1.6, 0.2], [-0.05, 0.2, 2.1]])
BODY = rj.Inertia(TENSOR)
TOP = rj.torques.HeavyTop(1.0, [0.05, -0.1, 0.4], [0.0, 0.0, -2.0])
Q = np.array([0.8, -0.2, 0.4, 0.4]) / np.linalg.norm([0.8, -0.2, 0.4, 0.4])
START = rj.Attitude(Q, [1.3, 0.7, -1.6])
LATE = 2.0


class Swaying(rj.torques.AbstractTorque):
    """A top whose pivot is shaken: a torque of time and attitude."""

    feels = rj.motion.HasAttitude
    rate_free = True

    def __call__(self, t, state, body):
        return (1 + 0.5 * jnp.sin(3 * t)) * TOP(t, state, body)


FIELDS = {
    "top": AttitudeEquations(BODY, TOP),
    "swaying": AttitudeEquations(BODY, Swaying()),
}


@filter_once
def run(solver, field, y0, t1, steps):
    return fixed(solver, field, jnp.stack([jnp.zeros_like(t1), t1]), y0, steps)


@pytest.fixture(scope="module")
def reference():
    late, count = jnp.asarray(LATE), jnp.asarray(400)
    return {
        name: np.asarray(run(DormandPrince8(), field, START, late, count).q[-1])
        for name, field in FIELDS.items()
    }


def slope(method, field, right):
    counts = np.array(LADDER[method])
    ends = [run(method(), field, START, jnp.asarray(LATE), jnp.asarray(n)).q[-1] for n in counts]
    gaps = [min(np.linalg.norm(q - right), np.linalg.norm(q + right)) for q in ends]
    assert 1e-13 < gaps[-1] < 1e-2
    return -np.polyfit(np.log(counts), np.log(gaps), 1)[0]


@pytest.mark.oldest
@pytest.mark.parametrize("name", list(FIELDS))
@METHODS
def test_order_of_the_attitude(method, name, reference):
    found = slope(method, FIELDS[name], reference[name])
    order = method.composition.order
    assert abs(found - order) < (0.1 if order < 6 else 0.2), found


class Broken(Splitting4):
    composition: ClassVar = splitting.SRKN6._replace(
        kicks=(0.083, 0.396309801498368 - 1.56e-5, *splitting.SRKN6.kicks[2:-2], 0.396309801498368 - 1.56e-5, 0.083)
    )  # fmt: skip


def test_the_order_test_sees_a_wrong_coefficient(reference):
    LADDER[Broken] = (40, 80, 160)
    found = slope(Broken, FIELDS["top"], reference["top"])
    del LADDER[Broken]
    assert abs(found - 4) > 0.2, found


def energy(y):
    return rj.kinetic_energy(BODY, rj.Spin(y.omega)) + TOP.energy(0.0, y, BODY)


def test_invariants_over_a_hundred_thousand_steps():
    # 1e5 flows of a free body: momentum in space, energy, |q| to round-off.
    free = AttitudeEquations(BODY)
    ts = jnp.linspace(0.0, 1e4, 11)

    @eqx.filter_jit
    def long(n):
        return fixed(Splitting2(), free, ts, START, n)

    ys = long(jnp.asarray(10_000))
    assert float(jnp.abs(jnp.linalg.norm(ys.q, axis=1) - 1).max()) < 1e-15
    world = jax.vmap(lambda q, w: rj.spatial_angular_momentum(BODY, rj.Attitude(q, w)))(
        ys.q, ys.omega
    )
    size = np.linalg.norm(world, axis=1)
    np.testing.assert_allclose(size, size[0], rtol=1e-12)
    np.testing.assert_allclose(world, np.broadcast_to(world[0], world.shape), atol=1e-11)


def test_energy_of_a_top_is_bounded_without_trend():
    ts = jnp.linspace(0.0, 3000.0, 301)

    @eqx.filter_jit
    def long(n):
        ys = fixed(Splitting4(), FIELDS["top"], ts, START, n)
        return jax.vmap(energy)(ys)

    drift = np.abs(np.asarray(long(jnp.asarray(50))) / float(energy(START)) - 1)
    early, late = drift[1:51].max(), drift[-50:].max()
    assert late < 3 * early < 1e-4


# Each method's order is tested above; one has what all share here, the others take their turn.
ONE = pytest.mark.parametrize(
    "method",
    [
        pytest.param(Splitting2, marks=pytest.mark.slow),
        Splitting4,
        pytest.param(Splitting6, marks=pytest.mark.slow),
    ],
    ids=lambda m: m.__name__,
)


@ONE
def test_runs_back_onto_itself(method):
    field = FIELDS["top"]
    out = dfx.diffeqsolve(dfx.ODETerm(field), method(), 0.0, 2.0, 0.1, START)
    there = jax.tree.map(lambda leaf: leaf[-1], out.ys)
    out = dfx.diffeqsolve(dfx.ODETerm(field), method(), 2.0, 0.0, -0.1, there)
    np.testing.assert_allclose(out.ys.q[-1], START.q, atol=1e-13)
    np.testing.assert_allclose(out.ys.omega[-1], START.omega, atol=1e-12)


@ONE
def test_diffrax_saves_on_the_group_with_the_methods_error(method):
    steps, ts = LADDER[method][-1], jnp.linspace(0.0, LATE, 33)

    @eqx.filter_jit
    def solve(dt):
        return dfx.diffeqsolve(
            dfx.ODETerm(FIELDS["top"]), method(), 0.0, LATE, dt, START, saveat=dfx.SaveAt(ts=ts)
        ).ys.q  # fmt: skip

    exact = fixed(DormandPrince8(), FIELDS["top"], ts, START, 12).q
    gaps = []
    for n in (steps // 2, steps):
        inside = solve(jnp.asarray(LATE / n))
        assert float(jnp.abs(jnp.linalg.norm(inside, axis=1) - 1).max()) < 2e-15
        gaps.append(np.linalg.norm(inside - exact, axis=1).max())
    # The order of the method, in between steps too.
    assert np.log2(gaps[0] / gaps[1]) > method.composition.order - 0.4


@pytest.mark.slow
def test_derivatives_of_a_run():
    def end(w):
        ys = fixed(Splitting6(), FIELDS["top"], jnp.array([0.0, 0.5]), rj.Attitude(Q, w), 8)
        return ys.q[-1]

    def right(w):
        ts = jnp.array([0.0, 0.5])
        return fixed(DormandPrince8(), FIELDS["top"], ts, rj.Attitude(Q, w), 8).q[-1]

    w = jnp.asarray(START.omega)
    np.testing.assert_allclose(
        eqx.filter_jit(jax.jacfwd(end))(w), eqx.filter_jit(jax.jacfwd(right))(w), atol=1e-7
    )


@pytest.mark.long
@pytest.mark.oldest
def test_derivatives_by_the_whole_tensor():
    """A change that turns the principal axes, too: beside central differences of the same steps."""
    change = jnp.array([[0.3, -1.0, 0.7], [-1.0, 0.2, 0.4], [0.7, 0.4, -0.5]])

    def end(s):
        field = AttitudeEquations(rj.Inertia(TENSOR + s * change), TOP)
        out = fixed(Splitting2(), field, jnp.array([0.0, 0.3]), START, 2)
        return jnp.concatenate([out.q[-1], out.omega[-1]])

    value = once(end)
    low, high = (value(jnp.asarray(s)) for s in (-1e-5, 1e-5))
    found = once(jax.jacfwd(end))(jnp.asarray(0.0))
    np.testing.assert_allclose(found, (high - low) / 2e-5, rtol=0, atol=1e-8)


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize(
    ("field", "start", "words"),
    [
        (AttitudeEquations(BODY, rj.torques.Damping(jnp.ones(3))), START, "Damping depends on the body rate"),
        (EulerEquations(BODY), rj.Spin(START.omega), "wanted AttitudeEquations .* got EulerEquations and Spin"),
    ],
)  # fmt: skip
def test_what_it_cannot_do_is_refused(field, start, words):
    with pytest.raises(TypeError, match=words):
        dfx.diffeqsolve(dfx.ODETerm(field), Splitting4(), 0.0, 1.0, 0.1, start)


def test_driven_body_in_single_precision():
    y0 = driven.start(jnp.zeros((), jnp.float32))
    ts = jnp.asarray([0.0, 1.0], jnp.float32)
    q = fixed(Splitting4(), driven.field(jnp.float32), ts, y0, 50).q[-1]
    assert q.dtype == jnp.float32
    assert float(driven.error(q, ts[1])) < 2e-5


@pytest.mark.slow
def test_a_million_steps_of_a_top():
    # Momentum about gravity is kept exactly by each part, the energy within a bound.
    ts = jnp.linspace(0.0, 1e5, 201)

    @eqx.filter_jit
    def long(n):
        ys = fixed(Splitting4(), FIELDS["top"], ts, START, n)
        world = jax.vmap(lambda q, w: rj.spatial_angular_momentum(BODY, rj.Attitude(q, w)))(
            ys.q, ys.omega
        )
        return jax.vmap(energy)(ys), world[:, 2]

    found, along = map(np.asarray, long(jnp.asarray(5000)))
    drift = np.abs(found / found[0] - 1)
    assert drift[-50:].max() < 3 * drift[1:51].max() < 1e-2
    np.testing.assert_allclose(along, along[0], rtol=1e-10)


@pytest.mark.parametrize("method", [Splitting2, Splitting4], ids=lambda m: m.__name__)
def test_momentum_does_not_drift_by_the_way_to_rates_and_back(method):
    # In diffrax each step begins and ends at Ω: a factor of I I⁻¹ in each would add up as n.
    n, body = 20_000, rj.Inertia(0.7 * TENSOR)
    steps = dict(dt0=1e-3, stepsize_controller=dfx.ConstantStepSize(), max_steps=n + 1)
    start = rj.Attitude(Q, [0.3, -0.2, 7.0])
    ys = rj.simulate(body, start, jnp.array([0.0, 1e-3 * n]), solver=method(), **steps).ys
    sizes = np.linalg.norm(np.asarray(ys.omega) @ np.asarray(body.tensor), axis=1)
    assert abs(sizes[1] / sizes[0] - 1) < 5 * np.finfo(float).eps * np.sqrt(n)
