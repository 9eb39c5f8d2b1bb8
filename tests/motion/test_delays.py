"""Inputs that come later: exact runs, derivatives by the delay, fits of it, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion.drive import Drive
from once import filter_once, once

import rigidjax as rj
from rigidjax import identify, torques

H, STEPS = 0.05, 12
BODY = rj.Inertia.from_principal(1.0, 2.0, 2.5)
ROWS = np.random.default_rng(0).normal(size=(2, STEPS))


class Turn(Drive):
    """The square of what is given: what is held must not be mixed."""

    def __call__(self, t, state, body):
        return jnp.stack([0.0, 0.0, 1.0]) * self.source(t) ** 2


def exact(rows, delay, t):
    """Ω at t, and its derivative by the delay: the staircase's squares, moved by the delay."""
    edges = np.append(-np.inf, H * np.arange(1, rows.size))
    ends = np.append(edges[1:], np.inf)
    inside = np.clip(t - delay, edges, ends) - np.clip(-delay, edges, ends)
    at = lambda s: rows[np.searchsorted(H * np.arange(1, rows.size), s, side="right")] ** 2
    return np.sum(np.where(rows**2 > 0, rows**2 * inside, 0.0)) / 2.5, (
        at(-delay) - at(t - delay)
    ) / 2.5


def spins(many):
    return rj.Spin(np.zeros((many, 3)))


# The third is two whole steps.
DELAYS = [0.013, 0.12, 0.1, 0.0, -0.07]


def test_a_delayed_input_is_exact_at_every_step():
    law = lambda d: Turn(torques.Delayed(torques.Input("u"), d))

    def last(delay, rows):
        found = rj.batch.rollout(
            BODY, spins(2), H, STEPS, law(delay), inputs={"u": rows}, save_every=1
        )
        return found.omega[..., 2]

    both = once(lambda d, rows: (last(d, rows), jax.jacfwd(last)(d, rows)))
    for delay in DELAYS:
        found, slopes = both(jnp.asarray(delay), jnp.asarray(ROWS))
        for body in range(2):
            wanted = np.array([exact(ROWS[body], delay, H * k) for k in range(1, STEPS + 1)])
            np.testing.assert_allclose(found[body], wanted[:, 0], rtol=0, atol=1e-13)
            if delay != -0.07:
                # At a whole step the derivative is that towards longer delays.
                later = [exact(ROWS[body], delay + 1e-9, H * k)[1] for k in range(1, STEPS + 1)]
                np.testing.assert_allclose(slopes[body], later, rtol=0, atol=1e-11)
    by_reverse = once(jax.grad(lambda d, rows: last(d, rows)[1, -1]))(0.12, jnp.asarray(ROWS))
    np.testing.assert_allclose(by_reverse, exact(ROWS[1], 0.12, H * STEPS)[1], rtol=1e-11)


def test_two_delays_and_an_input_that_has_none():
    law = torques.Sum(
        Turn(torques.Delayed(torques.Input("u"), 0.013)),
        Turn(torques.Input("v")),
        Turn(torques.Delayed(torques.Delayed(torques.Input("u"), 0.1), 0.02)),
    )
    found = rj.batch.rollout(BODY, spins(1), H, STEPS, law, inputs={"u": ROWS[:1], "v": ROWS[1:]})
    wanted = sum(
        exact(r, d, H * STEPS)[0] for r, d in ((ROWS[0], 0.013), (ROWS[1], 0.0), (ROWS[0], 0.12))
    )
    np.testing.assert_allclose(found.omega[0, 2], wanted, rtol=1e-13)


def test_a_delay_in_adaptive_steps_has_its_derivative():
    """Steps end at the jumps, which move with the delay; both modes."""
    times = jnp.asarray(H * np.arange(STEPS))

    def last(delay):
        law = Turn(torques.Delayed(torques.Held(times, ROWS[0]), delay))
        return rj.simulate(BODY, rj.Spin([0.0, 0, 0]), [0.0, H * STEPS], law).ys.omega[-1, 2]

    found, forward, reverse = filter_once(
        lambda d: (last(d), jax.jacfwd(last)(d), jax.grad(last)(d))
    )(0.07)
    value, slope = exact(ROWS[0], 0.07, H * STEPS)
    np.testing.assert_allclose([found, forward, reverse], [value, slope, slope], rtol=1e-11)


def test_a_fit_of_windows_finds_delay_and_lag():
    """A record with a delay of 1.7 samples and a lag of 1.5: both come back, and say what they lack."""
    rng = np.random.default_rng(2)
    t = H * np.arange(81)
    u = np.repeat(rng.normal(size=27), 3)
    true = {"delay": 1.7 * H, "lag": 1.5 * H}

    def law(delay, lag):
        late = torques.Delayed(torques.Input("u"), delay)
        return torques.Sum(Push(torques.Lagged(late, lag)), torques.Damping([0.3, 0.3, 0.3]))

    free = [
        identify.Free(lambda s: s.torque.parts[0].source.source.delay, "delay", scale=H),
        identify.Free(lambda s: s.torque.parts[0].source.time, "lag", scale=H),
    ]

    def model(cut, delay):
        return identify.Model(cut, identify.Known(BODY), torque=law(delay, 0.05), free=free)

    run = rj.batch.rollout(
        BODY, spins(1), H, 80, law(**true), inputs={"u": u[None, :80]}, save_every=1
    )
    omega = np.concatenate([np.zeros((1, 3)), run.motion.omega[0]])
    cut = identify.windows(t, rj.Spin(omega), {"u": u}, length=80, before=0)
    with pytest.raises(
        ValueError, match=r"a delay of 0\.02 s, and inputs that are known 0 s before"
    ):
        model(cut, 0.02)
    cut = identify.windows(t, rj.Spin(omega), {"u": u}, length=8, stride=8, before=12)
    assert cut.inputs["u"].shape == (cut.count, 20)
    found = identify.fit(model(cut, 0.02))
    assert found.search.word == "found"
    # What the lag was 12 samples before a window is not known: e⁻⁷ of it is left there.
    for name, value in true.items():
        np.testing.assert_allclose(found.values[name], value, rtol=0, atol=1e-3 * H)
    with pytest.raises(ValueError, match=r"known 0\.6 s before a window"):
        model(cut, 0.7)
    # A fit that ends at a delay beyond the inputs says so.
    few = identify.windows(t, rj.Spin(omega), {"u": u}, length=8, stride=8, before=1)
    late = identify.fit(model(few, 0.02))
    assert float(late.values["delay"]) > H
    assert any("known 0.05 s before a window" in reason for reason in late.search.reasons)


class Push(Turn):
    def __call__(self, t, state, body):
        return jnp.stack([1.0, 0.5, -0.4]) * self.source(t)


def test_linear_of_any_number_of_channels_under_jit_and_vmap():
    times, values = jnp.array([0.0, 1.0, 3.0]), jnp.asarray(np.arange(24.0).reshape(3, 2, 4))
    found = jax.jit(lambda t, v: torques.Linear(t, v)(2.0))(times, values)
    np.testing.assert_allclose(found, 0.5 * (values[1] + values[2]), rtol=1e-15)
    many = jax.vmap(lambda v: torques.Linear(times, v)(0.5))(jnp.stack([values, 2 * values]))
    np.testing.assert_allclose(many[1], values[0] + values[1], rtol=1e-15)
    # A cubic is its own spline.
    t = np.linspace(0.0, 2.0, 6)
    rows = np.stack([t**3, 1 - t**3, 0 * t], 1)
    spline = jax.jit(lambda t, v: torques.Series(t, v)(1.23))(t, rows)
    np.testing.assert_allclose(spline, [1.23**3, 1 - 1.23**3, 0.0], rtol=0, atol=1e-14)
    # Round-off of the times makes no uneven ones: seconds since 1970, and float32 under `jit`.
    unix = np.linspace(0.0, 10.0, 80) + 1.7e9
    torques.Series(jnp.arange(5.0, dtype=jnp.bfloat16), np.arange(5.0))
    lately = torques.Series(unix, np.sin(unix - 1.7e9))(1.7e9 + 3.3)
    np.testing.assert_allclose(lately, np.sin(3.3), rtol=0, atol=1e-5)
    short = jnp.linspace(0.0, 10.0, 1000, dtype=jnp.float32)
    single = jax.jit(lambda t: torques.Series(t, jnp.sin(t))(jnp.float32(3.3)))(short)
    np.testing.assert_allclose(single, np.sin(3.3), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("call", "kind", "words"),
    [
        (lambda: torques.Delayed(torques.Held([0.0, 1.0], [1.0, 2.0]), 1.0), ValueError, "delay: wanted less than the 1 s of the record of the source, got 1"),
        (lambda: torques.Delayed(torques.InSpace(torques.Input("u")), 0.1), TypeError, "delay the Input itself"),
        (lambda: torques.Delayed(torques.Input("u"), np.nan), ValueError, "delay: contains NaN"),
        (lambda: rj.batch.rollout(BODY, spins(2), H, STEPS, Turn(torques.Delayed(torques.Input("u"), 0.7)), inputs={"u": ROWS}), ValueError, r"inputs\['u'\]: its delay of 0\.7 s is not shorter than the run of 0\.6 s"),
        (lambda: rj.simulate(BODY, rj.Spin([0.0, 0, 0]), [0.0, 1.0], Turn(torques.Delayed(torques.Input("u"), 0.6))), ValueError, r"Input\('u'\) has no value"),
    ],
)  # fmt: skip
def test_mistakes_are_named(call, kind, words):
    with pytest.raises(kind, match=words):
        call()
