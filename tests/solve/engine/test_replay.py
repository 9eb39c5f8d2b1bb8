"""`ReplayAdjoint` beside diffrax's own adjoint and closed forms: any field, controller and batch."""

import functools
import itertools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

from rigidjax.solve.solvers import DormandPrince8, ReplayAdjoint, RungeKutta4, Tsitouras5

REPLAY, PLAIN = ReplayAdjoint(), dfx.RecursiveCheckpointAdjoint()
PID = dfx.PIDController(rtol=1e-9, atol=1e-11)
K = jnp.array([1.0, 0.05, 0.3])
TS = jnp.array([0.0, 0.3, 0.31, 1.1, 2.0])


def pendulum(t, y, k):
    return {"v": -k[0] * jnp.sin(y["x"]) - k[1] * y["v"] + k[2] * jnp.cos(t), "x": y["v"]}


def solved(adjoint, k, x0, ts, solver=None, control=PID, dt0=None, **how):
    """All states at `ts` of a driven pendulum, a field of a user of diffrax."""
    how = dict(saveat=dfx.SaveAt(ts=ts)) | how
    return dfx.diffeqsolve(
        dfx.ODETerm(pendulum), solver or Tsitouras5(), ts[0], ts[-1], dt0,
        {"x": x0, "v": jnp.zeros_like(x0)}, k, stepsize_controller=control, adjoint=adjoint, **how,
    )  # fmt: skip


def number(ys):
    parts = (
        jnp.sum(jnp.cos(i + jnp.arange(a.size, dtype=a.dtype)) * a.ravel())
        for i, a in enumerate(ys)
    )
    return sum(parts)


def both_ways(value, *args):
    """Value, gradient, and the gradient along a direction in forward mode."""
    along = tuple(jnp.cos(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape) for a in args)

    def run(*args):
        every = tuple(range(len(args)))
        return jax.value_and_grad(value, every)(*args), jax.jvp(value, args, along)[1]

    (found, slopes), forward = once(run)(*args)
    reverse = sum(jnp.sum(a * b) for a, b in zip(slopes, along, strict=True))
    np.testing.assert_allclose(forward, reverse, rtol=1e-11 if found.dtype == float else 1e-4)
    return found, slopes


@pytest.mark.oldest
@pytest.mark.parametrize(
    ("solver", "control", "dt0", "backwards"),
    [
        (Tsitouras5(), PID, None, False),
        pytest.param(
            DormandPrince8(), dfx.PIDController(1e-8, 1e-10, pcoeff=0.3, icoeff=0.4, dtmax=0.3),
            None, True, marks=pytest.mark.long,
        ),
        pytest.param(Tsitouras5(), dfx.ConstantStepSize(), 0.03, True, marks=pytest.mark.long),
        pytest.param(
            RungeKutta4(), dfx.StepTo(ts=jnp.linspace(0.0, 2.0, 40)), None, False,
            marks=pytest.mark.long,
        ),
    ],
    ids=["PID", "PID of all terms, backwards", "equal steps, backwards", "given steps"],
)  # fmt: skip
def test_derivatives_are_those_of_diffrax_by_every_number(solver, control, dt0, backwards):
    ts = TS[::-1] if backwards else TS
    dt0 = -dt0 if dt0 and backwards else dt0

    def value(adjoint):
        def run(k, x0, ts):
            ys = solved(adjoint, k, x0, ts, solver, control, dt0).ys
            return number((ys["x"], ys["v"]))

        return run

    given = isinstance(control, dfx.StepTo)
    args = (K, jnp.asarray(1.0)) if given else (K, jnp.asarray(1.0), ts)
    more = (ts,) if given else ()
    ours, by_ours = both_ways(lambda *a: value(REPLAY)(*a, *more), *args)
    run = jax.value_and_grad(lambda *a: value(PLAIN)(*a, *more), tuple(range(len(args))))
    theirs, by_theirs = once(run)(*args)
    np.testing.assert_allclose(ours, theirs, rtol=1e-13)
    if isinstance(control, dfx.ConstantStepSize):
        # diffrax moves its equal steps with t0 and t1: a difference as small as their error.
        np.testing.assert_allclose(by_ours[2], by_theirs[2], atol=1e-9)
        by_ours, by_theirs = ((*by[:2], by[2][1:-1]) for by in (by_ours, by_theirs))
    for a, b in zip(by_ours, by_theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11 * np.abs(b).max())


def test_single_precision_stays_single():
    k, ts, x0 = (jnp.asarray(a, jnp.float32) for a in (K, TS, 1.0))
    coarse = dfx.PIDController(rtol=1e-5, atol=1e-6)

    def value(k, x0, ts=ts, control=coarse):
        ys = solved(REPLAY, k, x0, ts, control=control).ys
        return number((ys["x"], ys["v"]))

    found, slopes = both_ways(value, k, x0)
    assert found.dtype == slopes[0].dtype == jnp.float32
    double = once(jax.grad(lambda k: value(k, jnp.asarray(1.0), TS, PID)))(K)
    np.testing.assert_allclose(slopes[0], double, rtol=1e-3)


class Levels:
    """dy/dt is `heights[i]` between `edges[i − 1]` and `edges[i]`: y is known, with derivatives."""

    heights = (0.7, -1.3, 2.1, 5.0)

    @staticmethod
    def field(t, y, edges):
        return jnp.full_like(y, Levels.heights[0]) + sum(
            jnp.where(t >= edge, new - old, 0.0)
            for old, new, edge in zip(Levels.heights, Levels.heights[1:], edges, strict=False)
        )

    @staticmethod
    def exact(edges, t0, t1):
        """y(t1) − y(t0), where a jump at t0 is over and one at t1 has not been."""
        stops = [min(max(e, t0), t1) for e in edges]
        lengths = np.diff([t0, *stops, t1])
        return sum(h * d for h, d in zip(Levels.heights, lengths, strict=False))


@functools.cache
def end_of_levels(batched):
    """The compiled value at 1.5 s and its derivatives by the three edges; of one body or of many."""

    def end(edges):
        control = dfx.ClipStepSizeController(PID, jump_ts=edges)
        sol = dfx.diffeqsolve(
            dfx.ODETerm(Levels.field), DormandPrince8(), 0.0, 1.5, None, jnp.zeros(1), edges,
            stepsize_controller=control, adjoint=REPLAY,
        )  # fmt: skip
        return sol.ys[-1, 0]

    run = jax.value_and_grad(end)
    return once(jax.vmap(run) if batched else run)


@pytest.mark.parametrize(
    "edges",
    [(0.3, 0.6, 1.5), (0.3, 0.6, 0.6), (0.0, 0.3, 1.5), (0.3, 0.6, 1.5 - 1e-14), (0.3, 0.6, 9.0)],
    ids=["at the end", "two at once", "at the start", "a rounding before the end", "beyond it"],
)
@pytest.mark.parametrize("batched", [False, pytest.param(True, marks=pytest.mark.long)])
def test_jumps_are_differentiated_wherever_they_are(edges, batched):
    # A step whose last stage saw the other side of a jump was wrong by a percent, in silence.
    given, run = jnp.array(edges), end_of_levels(batched)
    if batched:
        found = jax.tree.map(lambda a: a[1], run(jnp.stack([given + 0.01, given])))
    else:
        found = run(given)
    np.testing.assert_allclose(found[0], Levels.exact(edges, 0.0, 1.5), rtol=1e-12)
    heights = Levels.heights
    wanted = np.array([old - new for old, new in itertools.pairwise(heights)])
    # One at the start, at the end or beyond it has one-sided derivatives, or none. Two at once have
    # no step between them: they move together.
    for edge in set(edges):
        same = np.array(edges) == edge
        if 0.0 < edge < 1.5:
            np.testing.assert_allclose(found[1][same].sum(), wanted[same].sum(), rtol=1e-11)


def test_a_body_of_nan_and_one_of_too_many_steps_change_no_bit_of_the_others():
    x0 = jnp.linspace(0.5, 1.5, 20)
    k = jnp.broadcast_to(K, (20, 3))

    def one(k, x0):
        sol = solved(REPLAY, k, x0, TS, max_steps=40, throw=False)
        return sol.ys["x"], sol.stats["num_steps"], sol.result

    def slope(k, x0):
        return jax.grad(lambda k: one(k, x0)[0].sum())(k)

    both = once(lambda k, x0: (jax.vmap(one)(k, x0), jax.vmap(slope)(k, x0)))
    (ys, steps, result), slopes = both(k, x0)
    assert np.all(np.asarray(result == dfx.RESULTS.successful))
    alone = once(one)(k[9], x0[9])
    np.testing.assert_allclose(ys[9], alone[0], rtol=1e-13)
    assert int(steps[9]) == int(alone[1])
    bad = k.at[3, 0].set(jnp.nan).at[17, 0].set(1e9)
    (others, _, result), moved = both(bad, x0)
    good = np.delete(np.arange(20), [3, 17])
    np.testing.assert_array_equal(others[good], ys[good])
    np.testing.assert_array_equal(moved[good], slopes[good])
    # `PIDController` goes on with NaN, in ever shorter steps, until they are spent.
    spent = np.asarray(result == dfx.RESULTS.max_steps_reached)
    np.testing.assert_array_equal(np.flatnonzero(spent), [3, 17])


def test_sets_of_saved_times_their_functions_an_event_and_a_meter_are_those_of_diffrax():
    subs = {
        "a": dfx.SubSaveAt(t1=True, fn=lambda t, y, k: t * y["x"] + k[0]),
        "b": dfx.SubSaveAt(t0=True, ts=jnp.array([0.2, 1.9]), t1=True),
    }
    event = dfx.Event(lambda t, y, args, **_: y["x"] < 0.2)
    meter = dfx.TextProgressMeter(minimum_increase=0.9)

    def run(adjoint, event=None, **how):
        def all_of(k):
            sol = solved(
                adjoint, k, jnp.asarray(1.0), TS, saveat=dfx.SaveAt(subs=subs), event=event, **how
            )
            x = sol.ys["b"]["x"]
            value = jnp.sum(sol.ys["a"]) + jnp.sum(jnp.where(jnp.isfinite(x), x, 0) ** 2)
            if event is not None:
                value = x[-1] * jnp.sum(jnp.where(jnp.isfinite(sol.ys["a"]), sol.ys["a"], 1))
            return value, (sol.ts, sol.ys, sol.event_mask, sol.result)

        return once(jax.value_and_grad(all_of, has_aux=True))(K)

    ours = [run(REPLAY), run(REPLAY, event=event)]
    for found, how in zip(ours, (dict(), dict(event=event)), strict=True):
        theirs = run(PLAIN, **how)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11), found, theirs)
    # Another program rounds in another way.
    same = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12)
    jax.tree.map(same, run(REPLAY, progress_meter=meter), ours[0])


def test_a_run_without_a_step_and_saved_times_at_the_start():
    still = solved(REPLAY, K, jnp.asarray(1.0), jnp.zeros(3))
    np.testing.assert_array_equal(still.ys["x"], np.ones(3))
    ts = jnp.array([0.0, 0.0, 1.0])
    ours, theirs = (
        once(jax.jacfwd(lambda ts, a=a: solved(a, K, jnp.asarray(1.0), ts).ys["v"]))(ts)
        for a in (REPLAY, dfx.ForwardMode())
    )
    np.testing.assert_allclose(ours, theirs, atol=1e-11)


class Own(dfx.StepTo):
    """A step controller of a user."""


class Spy(dfx.AbstractAdjoint):
    """Says that it was asked."""

    def loop(self, **_):
        raise NotImplementedError("the other adjoint")


@pytest.mark.parametrize(
    "how",
    [
        dict(solver=dfx.Tsit5()),
        dict(max_steps=None),
        dict(saveat=dfx.SaveAt(dense=True)),
        dict(saveat=dfx.SaveAt(steps=True)),
        dict(saveat=dfx.SaveAt(subs=[dfx.SubSaveAt(ts=TS), dfx.SubSaveAt(ts=TS[1:])])),
        dict(control=Own(ts=jnp.array([0.0, 1.0, 2.0]))),
        dict(event=dfx.Event(lambda t, y, args, **_: y["x"])),
        dict(event=dfx.Event([lambda t, y, args, **_: y["x"] < 0])),
    ],
    ids=[
        "solver",
        "max_steps",
        "dense",
        "steps",
        "sets of times",
        "own controller",
        "a real event",
        "several events",
    ],
)
def test_what_it_does_not_take_another_adjoint_does(how):
    with pytest.raises(NotImplementedError, match="the other adjoint"):
        solved(ReplayAdjoint(Spy()), K, jnp.asarray(1.0), TS, **how)


def test_what_is_no_adjoint_and_reverse_over_reverse_are_refused():
    with pytest.raises(TypeError, match="otherwise"):
        ReplayAdjoint(1)  # pyright: ignore[reportArgumentType]
    value = lambda x: solved(REPLAY, K, x, TS).ys["x"].sum()
    with pytest.raises(TypeError, match=r"wanted jax\.jacfwd\(jax\.grad\(f\)\)"):
        jax.jit(jax.grad(jax.grad(value))).lower(1.0)
