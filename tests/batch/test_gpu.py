"""What runs on a GPU, on a CPU: steps in pieces, places of bodies, checks of many rows, fits."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from batch.test_rollout import batch, far
from benchmarks.batch.bench_gpu import main, written
from once import once

import rigidjax as rj
from rigidjax import _checks
from rigidjax.batch import sharding
from rigidjax.identify.answer import fit as fits
from rigidjax.rotation.barrier import platform
from rigidjax.solve.engine import loop as adaptive_loop
from rigidjax.solve.programs import batching
from rigidjax.solve.steps import fixed as fixed_loop, pieces

CHANGES = jnp.asarray([1.0, -0.5, 0.25])


def steps_of(size, start, h, count, run):
    """`count` steps of a small system with a constant of whole numbers, from number 2 on."""
    order = jnp.asarray([2, 0, 1])

    def step(y, i):
        a, b = y
        t = i.astype(h.dtype) * h
        return a + h * jnp.sin(size * size * b) * CHANGES[order], b * (1 - h * a[0]) + h * t

    return run(step, jnp.asarray(2, jnp.int32), count, start)


def plain(step, first, count, y):
    return jax.lax.scan(
        lambda y, i: (step(y, i), None), y, first + jnp.arange(count, dtype=first.dtype)
    )[0]


START = jnp.asarray([0.3, -0.2, 0.5]), jnp.asarray(0.7)


@pytest.mark.oldest
@pytest.mark.parametrize(("count", "most"), [(7, 4), (12, 1), (1, 4)], ids=["rest", "whole", "one"])
def test_steps_in_pieces(monkeypatch, count, most):
    """Values, and derivatives in both modes, of one and of a batch: those of a plain loop.

    In pieces and a rest, in whole pieces of one step a turn, and one step.
    """
    monkeypatch.setattr(pieces, "_MOST", most)

    def all_of(run):
        def last(size, start, h):
            a, b = steps_of(size, start, h, count, run)
            return jnp.sum(a * a) * b

        at = jnp.asarray(0.8), START, jnp.asarray(0.1)
        sizes = jnp.asarray([0.8, 0.1])
        return (
            last(*at),
            jax.grad(last, (0, 1, 2))(*at),
            jax.grad(last, 1)(*at),
            jax.jacfwd(last, (0, 2))(*at),
            jax.vmap(jax.grad(last, (0, 1)), (0, None, None))(sizes, *at[1:]),
            jax.jacfwd(jax.grad(last, (0, 2)))(*at),
        )

    here, there = jax.jit(lambda: (all_of(plain), all_of(pieces.march_on_gpu)))()
    for a, b in zip(jax.tree.leaves(here), jax.tree.leaves(there), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-13, atol=1e-14)


def test_reverse_over_reverse_is_refused():
    def last(size):
        return steps_of(size, START, jnp.asarray(0.1), 3, pieces.march_on_gpu)[1]

    with pytest.raises(TypeError, match="forward over reverse"):
        jax.grad(jax.grad(last))(jnp.asarray(0.8))


def test_a_gpu_takes_steps_in_pieces(monkeypatch):
    """A rollout with that loop; with its barriers, without which XLA compiles for minutes on a
    CPU.
    """
    taken = []

    def march_on_gpu(*args):
        taken.append(args[2])
        return pieces.march_on_gpu(*args)

    bodies, states = batch(2)
    law = rj.torques.Damping([0.1, 0.2, 0.3])
    here = rj.batch.rollout(bodies, states, 0.1, 5, law)
    monkeypatch.setattr(fixed_loop, "platform", lambda: "gpu")
    monkeypatch.setattr(fixed_loop, "march_on_gpu", march_on_gpu)
    monkeypatch.setattr(pieces, "_MOST", 1)
    # Another number of steps a piece of results, so that no trace of the first call is taken.
    there = rj.batch.rollout(bodies, states, 0.1, 5, law, save_every=5)
    assert taken == [5]
    assert far(here, jax.tree.map(lambda a: a[:, 0], there)) < 1e-15


def test_bodies_of_an_odd_number(monkeypatch):
    monkeypatch.setattr(sharding, "platform", lambda: "gpu")
    division = sharding.divide_batch(4, None, None, np.dtype(float), 4)

    def doubled(x):
        return sharding.map_bodies(lambda s, x: s * x, jnp.asarray(2.0), x, division)

    np.testing.assert_array_equal(doubled(jnp.arange(4.0)), 2 * np.arange(4.0))
    # One chunk of five bodies, of which the last one fills it up.
    assert "f64[1,5]" in str(jax.make_jaxpr(doubled)(jnp.arange(4.0)))


@pytest.mark.parametrize(
    "in_chunks", [False, pytest.param(True, marks=pytest.mark.long)], ids=["whole", "in chunks"]
)
def test_a_record_on_a_gpu_follows_the_largest_number_of_steps(in_chunks, monkeypatch):
    """The steps of each body are kept in segments of the root of that number: the same gradient.

    The run takes more steps than one segment has, so that segments are run again. Bodies whose
    records do not fit the memory together go in chunks.
    """
    bodies, states = batch(3)
    law = rj.torques.HeavyTop(1.0, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])

    def compiled(max_steps):
        def loss(omega):
            start = rj.Attitude(states.q, omega)
            sol = rj.batch.simulate(
                bodies, start, [0.0, 20.0], law, solver=rj.solvers.Tsitouras5(), rtol=1e-6,
                atol=1e-8, max_steps=max_steps,
            )  # fmt: skip
            return jnp.sum(sol.ys.omega[:, -1] ** 2), sol.num_steps

        return once(jax.grad(loss, has_aux=True)).lower(states.omega).compile()

    here = compiled(400)
    slope, steps = here(states.omega)
    assert int(steps.max()) > 2 * 21
    module, chunks = sys.modules["rigidjax.batch.simulate"], []
    for one in (sharding, batching, adaptive_loop, module):
        monkeypatch.setattr(one, "platform", lambda: "gpu")

    def fit_chunk(*args):
        division = sharding.fit_chunk(*args)
        chunks.append(division.chunk)
        return division

    monkeypatch.setattr(module, "fit_chunk", fit_chunk)
    monkeypatch.setattr(sharding, "memory_of", lambda mesh: 1e4)
    # Other numbers, so that no trace of an earlier call is taken, nor that of the other case.
    there = [compiled(403 if in_chunks else 401)]
    if in_chunks:
        monkeypatch.setattr(sharding, "_FEW", 2)
        there.append(compiled(402))
    assert chunks == [3, 1][: len(there)]
    for one in there:
        np.testing.assert_allclose(one(states.omega)[0], slope, rtol=1e-11, atol=1e-12)
    large, small, *least = (f.memory_analysis().temp_size_in_bytes for f in (here, *there))
    assert small < 0.2 * large and all(size < 0.5 * small for size in least)


def test_chunks_that_fit_a_memory_have_an_odd_length(monkeypatch):
    """They are as long as a quarter of the memory allows; a memory that holds all needs none."""
    monkeypatch.setattr(sharding, "platform", lambda: "gpu")
    rows = jnp.arange(20_000.0)
    division = sharding.divide_batch(None, None, None, rows.dtype, rows.size)
    assert division.chunk == rows.size == sharding.share_of(division, rows)

    def chunk(memory):
        monkeypatch.setattr(sharding, "memory_of", lambda mesh: memory)
        fit = sharding.fit_chunk
        return fit(division, lambda scale, row: jnp.sin(scale * row), jnp.asarray(2.0), rows).chunk

    found = [chunk(memory) for memory in (1.0, 2e5, 4e5, np.inf)]
    assert found[0] == 1 and found[3] == rows.size
    assert found[1] % 2 == found[2] % 2 == 1
    assert abs(found[2] - 2 * found[1]) <= 3 and found[2] * 8 <= 1e5


def test_memory_of_a_device_is_what_jax_says(monkeypatch):
    class Card:
        memory_stats = staticmethod(lambda: {"bytes_limit": 5.0})

    assert sharding.memory_of(None) == np.inf  # a CPU
    monkeypatch.setattr(jax, "devices", lambda: [Card()])
    assert sharding.memory_of(None) == 5.0


def test_many_rows_are_checked_where_they_are():
    """The same words as for a few; the first of several is named."""
    count = 5000
    q = jnp.tile(jnp.eye(4)[0], (count, 1))
    bodies = rj.Inertia(jnp.tile(jnp.diag(jnp.array([1.0, 1.3, 1.7])), (count, 1, 1)))
    start = rj.Attitude(q, jnp.ones((count, 3)))
    bad = q.at[4321].mul(2.0).at[4999].mul(3.0)
    with pytest.raises(ValueError, match="got length 2 for body 4321"):
        rj.batch.rollout(bodies, rj.Attitude(bad, start.omega), 0.1, 1)
    tensor = bodies.tensor.at[17, 0, 0].set(-1.0)
    with pytest.raises(ValueError, match="this is body 17"):
        rj.batch.rollout(rj.Inertia(tensor), start, 0.1, 1)
    # Known numbers within a trace of others.
    with pytest.raises(ValueError, match="for body 4321"):
        jax.jit(lambda h: rj.batch.rollout(bodies, rj.Attitude(bad, start.omega), h, 1))(0.1)
    for rows in (jnp.ones((count, 3)), jnp.ones((5, 3))):
        assert _checks.require_finite(rows, "rows") is rows
        with pytest.raises(ValueError, match=r"rows: contains NaN or infinity at index \(4, 1\)"):
            _checks.require_finite(rows.at[4, 1].set(jnp.nan), "rows")


def test_a_small_fit_on_a_machine_with_a_gpu(monkeypatch):
    """It runs on the CPU and says so, unless a device was chosen."""
    ts = jnp.linspace(0.0, 2.0, 9)
    record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), jnp.ones((9, 3))))
    model = rj.identify.Model(record, rj.identify.PrincipalRatios())
    cpu = jax.devices("cpu")[0]
    assert fits._cpu_if_faster(model) is None
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert platform() == "gpu"
    assert fits._cpu_if_faster(model) == cpu
    with jax.default_device(cpu):
        assert platform() == "cpu"
        assert fits._cpu_if_faster(model) is None
    monkeypatch.setattr(fits, "_FEW", 10)
    assert fits._cpu_if_faster(model) is None


def test_the_benchmark_in_small():
    table = main(["--small"])
    assert len(table.rows) == 25
    page = written("a\n<!-- bench_gpu -->\nold\n<!-- /bench_gpu -->\nb\n", "new")
    assert page == "a\n<!-- bench_gpu -->\n\nnew\n<!-- /bench_gpu -->\nb\n"
