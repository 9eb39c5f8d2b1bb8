"""Fits of many short open-loop runs: numbers known beforehand come back, mistakes are named."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from rigidjax.identify.search.window_fit import open_loop_errors

import rigidjax as rj
from rigidjax import identify, torques
from rigidjax.identify.model.normal import Normal
from rigidjax.identify.search import window_fit

H, T = 0.02, 81
BODY = rj.Inertia.from_principal(1.0, 2.0, 2.5)


class Push(torques.AbstractTorque):
    """A driven torque along an axis of the body, and damping."""

    feels = rj.motion.HasSpin
    gain: jax.Array
    source: torques.Input = torques.Input("u")

    def __call__(self, t, state, body):
        return self.gain * self.source(t)


def scene(free):
    law = torques.Sum(Push(free["gain"]), torques.Damping(free["damping"] * jnp.ones(3)))
    return BODY, law


TRUE = {"gain": np.array([0.5, -0.3, 0.8]), "damping": np.array(0.2)}
GUESS = {"gain": jnp.array([1.0, 0.0, 0.0]), "damping": jnp.asarray(0.0)}


def recorded(sigma=0.0, seed=0):
    """Attitudes and rates of one run through diffrax's tight steps, with noise; and the inputs."""
    rng = np.random.default_rng(seed)
    t, u = H * np.arange(T), np.cos(0.3 * np.arange(T)) + rng.normal(size=T)
    law = torques.bind(scene(jax.tree.map(jnp.asarray, TRUE))[1], {"u": torques.Held(t, u)})
    start = rj.Attitude([1.0, 0, 0, 0], [0.5, 1.0, -0.4])

    class Whole(eqx.Module):
        law: object
        feels = rj.motion.HasSpin
        jump_times: jax.Array

        def __call__(self, t, state, body):
            return self.law(t, state, body)

    whole = Whole(law, jnp.asarray(t))
    ys = rj.simulate(BODY, start, t, whole, rtol=1e-11, atol=1e-13).ys
    q = np.asarray(ys.q) + sigma * rng.normal(size=(T, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    return t, rj.Attitude(q, np.asarray(ys.omega) + sigma * rng.normal(size=(T, 3))), u


def test_known_numbers_come_back():
    t, states, u = recorded()
    cut = identify.windows(t, states, {"u": u}, length=8, stride=8)
    assert (cut.count, cut.length, cut.step) == (10, 8, H)
    found = identify.fit_windows(cut, scene, GUESS)
    assert found.converged
    assert found.message == ""
    # Equal steps of order 4 stand against a tight solver: 1e-7 of the numbers is theirs.
    for name, value in TRUE.items():
        np.testing.assert_allclose(found.value[name], value, rtol=0, atol=1e-6)
    ahead = found.predict(cut)
    assert ahead.steps.tolist() == list(range(1, 9))
    assert max(e.max() for e in ahead.mean_absolute.values()) < 1e-7
    held = cut.held()
    rise = np.abs(np.asarray(states.omega)[1::8] - np.asarray(states.omega)[:-1:8]).mean()
    np.testing.assert_allclose(held.mean_absolute["omega"][0], rise, rtol=1e-12)


def test_what_windows_do_not_show_has_no_deviation():
    rng = np.random.default_rng(1)
    t = H * np.arange(T)
    omega = np.array([0.5, 1.0, -0.4]) * np.exp(-0.3 * t)[:, None]
    spins = rj.Spin(omega + 1e-3 * rng.normal(size=(T, 3)))
    ball = rj.Inertia.from_principal(1.0, 1.0, 1.0)
    both = lambda k: (ball, torques.Damping((k["a"] + k["b"]) * jnp.ones(3)))
    guess = {"a": jnp.asarray(0.1), "b": jnp.asarray(0.1)}
    found = identify.fit_windows(identify.windows(t, spins, length=8, stride=8), both, guess)
    assert float(found.value["a"] + found.value["b"]) == pytest.approx(0.3, abs=0.02)
    assert {float(d) for d in found.deviation.values()} == {np.inf}
    assert "some combination of the free numbers changes nothing" in found.message
    one = lambda k: (ball, torques.Damping(k * jnp.ones(3)))
    # From how windows differ: of one window nothing.
    cut = identify.windows(t[:9], rj.Spin(spins.omega[:9]), length=8)
    found = identify.fit_windows(cut, one, jnp.asarray(0.1))
    assert cut.count == 1 and np.isnan(found.deviation)
    assert "from the differences between windows, and there is one" in found.message


def test_a_body_at_rest_shows_nothing_of_its_damping():
    still = identify.windows(H * np.arange(9), rj.Spin(np.zeros((9, 3))), length=2, stride=2)
    one = lambda k: (BODY, torques.Damping(k * jnp.ones(3)))
    found = identify.fit_windows(still, one, jnp.asarray(0.1), noise={"omega": 0.1})
    assert np.isinf(found.deviation) and "changes nothing" in found.message


@pytest.mark.parametrize("apart", [1e-3, 1e-5, 3e-6])
def test_numbers_that_are_hardly_told_apart_have_wide_deviations_not_nan(apart):
    t = H * np.arange(T)
    omega = np.array([0.5, 1.0, -0.4]) * np.exp(-0.3 * t)[:, None]
    spins = rj.Spin(omega + 1e-3 * np.random.default_rng(1).normal(size=(T, 3)))
    ball = rj.Inertia.from_principal(1.0, 1.0, 1.0)

    def both(k):
        damping = (k["a"] + k["b"]) * jnp.ones(3) + apart * k["b"] * jnp.array([1.0, 0, 0])
        return ball, torques.Sum(
            torques.Damping(damping), torques.ConstantTorque(k["c"] * jnp.ones(3))
        )

    cut = identify.windows(t, spins, length=4, stride=4)
    found = identify.fit_windows(cut, both, {k: jnp.asarray(0.1) for k in "abc"})
    # The readings show a + b, apart · b and c: a fit of those three finds their deviations.
    plain = lambda k: (
        ball,
        torques.Sum(
            torques.Damping(k["sum"] * jnp.ones(3) + k["b"] * jnp.array([1.0, 0, 0])),
            torques.ConstantTorque(k["c"] * jnp.ones(3)),
        ),
    )
    wanted = identify.fit_windows(cut, plain, {k: jnp.asarray(0.1) for k in ("sum", "b", "c")})
    refits = [leave_out(cut, plain, wanted.value, k) for k in range(12)]
    for name in ("b", "c"):
        off = np.array([float(one[name] - wanted.value[name]) for one in refits])
        by_hand = np.sqrt(11 / 12 * np.sum(off**2))
        assert float(wanted.deviation[name]) == pytest.approx(by_hand, rel=0.02)
    for name in ("a", "b"):
        own = float(found.deviation[name]) * apart
        assert own == pytest.approx(float(wanted.deviation["b"]), rel=0.01)
    assert float(found.deviation["c"]) == pytest.approx(float(wanted.deviation["c"]), rel=0.01)


def leave_out(cut, scene, guess, k, count=12):
    """The fit without one stretch."""
    kept = np.arange(cut.count) * count // cut.count != k
    return identify.fit_windows(jax.tree.map(lambda a: a[kept], cut), scene, guess).value


def test_intervals_hold_though_windows_overlap():
    """Twelve records with noise, five windows over each sample: of 48 intervals 95 % hold."""
    inside = []
    for seed in range(12):
        t, states, u = recorded(2e-3, seed)
        cut = identify.windows(t, states, {"u": u}, length=10, stride=2)
        found = identify.fit_windows(cut, scene, {k: jnp.asarray(v) for k, v in TRUE.items()})
        assert found.stretches == 12
        low, high = found.interval()
        for name, value in TRUE.items():
            inside += list(np.ravel((low[name] < value) & (value < high[name])))
    # 45.6 are expected; three standard deviations of a binomial number are 4.5.
    assert sum(inside) >= 41


def test_a_number_that_one_stretch_shows_is_named():
    t = H * np.arange(T)
    omega = np.array([0.5, 1.0, -0.4]) * np.exp(-0.3 * t)[:, None]
    # A push of 0.2 s about x, in the windows 18 … 22 of 40.
    pushed = np.clip(t - 18 * 2 * H, 0.0, 0.2)
    omega[:, 0] += 0.5 * pushed
    spins = rj.Spin(omega + 1e-3 * np.random.default_rng(1).normal(size=(T, 3)))
    inputs = {"u": ((t >= 18 * 2 * H - 1e-9) & (t < 18 * 2 * H + 0.2 - 1e-9)).astype(float)}
    ball = rj.Inertia.from_principal(1.0, 1.0, 1.0)
    scene = lambda k: (
        ball,
        torques.Sum(
            Push(k["gain"] * jnp.array([1.0, 0.0, 0.0])),
            torques.Damping(k["damping"] * jnp.ones(3)),
        ),
    )
    cut = identify.windows(t, spins, inputs, length=2, stride=2)
    guess = {"damping": jnp.asarray(0.1), "gain": jnp.asarray(0.1)}
    found = identify.fit_windows(cut, scene, guess, stretches=5)
    # All of the push lies in the third of five stretches: the others do not show its size.
    assert np.isinf(found.deviation["gain"]) and found.deviation["damping"] < 0.05
    assert "number 1 (± inf)" in found.message
    apart = identify.fit_windows(cut, scene, guess, stretches=20)
    assert apart.deviation["gain"] < 0.1


def test_the_true_numbers_cost_as_much_more_as_is_expected_of_noise():
    """Twenty records: what a fit gains from noise, on the average, is what ends its search."""
    gained, expected = [], []
    true = {k: jnp.asarray(v) for k, v in TRUE.items()}
    (t, states, u), rng = recorded(), np.random.default_rng(7)
    noise = {"q": 1.0, "omega": 1.0}

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def linear(x, one):
        flat, back = ravel_pytree(x)

        def errors(flat):
            return open_loop_errors(scene, back(flat), one).reshape(-1)

        rows, e = jax.jacfwd(errors)(flat), errors(flat)
        return rows.T @ rows, jnp.outer(e @ rows, e @ rows), 0.5 * e @ e

    for _ in range(20):
        q = np.asarray(states.q) + 2e-3 * rng.normal(size=(T, 4))
        q /= np.linalg.norm(q, axis=1)[:, None]
        noisy = rj.Attitude(q, np.asarray(states.omega) + 2e-3 * rng.normal(size=(T, 3)))
        cut = identify.windows(t, noisy, {"u": u}, length=8, stride=8)
        found = identify.fit_windows(cut, scene, true, noise=noise)
        gram, spread, cost = (np.asarray(a).sum(0) for a in linear(found.value, cut))
        gained.append(np.sum(linear(true, cut)[2]) - cost)
        expected.append(0.5 * np.trace(np.linalg.solve(gram, spread)))
        root = jnp.linalg.cholesky(jnp.asarray(spread)).T
        level = window_fit._by_noise((jnp.asarray(gram), root), Normal(jnp.asarray(gram)))
        np.testing.assert_allclose(level, expected[-1], rtol=1e-9)
    ratio = np.mean(gained) / np.mean(expected)
    assert 0.5 < ratio < 2.0, ratio


def test_long_windows_lead_to_the_truth_from_a_poor_guess():
    """A dipole in a field, three turns to and fro a window: by its whole length alone the search
    ends in another minimum of the cost.
    """
    body = rj.Inertia.from_principal(1.0, 1.2, 1.5)
    t = 0.05 * np.arange(241)

    def scene(log):
        return body, torques.MagneticDipole([jnp.exp(log), 0.0, 0.0], [0.0, 1.0, 0.0])

    start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0.0, 0.0])
    ys = rj.simulate(body, start, t, scene(jnp.log(9.0))[1], rtol=1e-10, atol=1e-12).ys
    cut = identify.windows(t, ys, length=120, stride=40)
    guess = jnp.log(jnp.asarray(3.0))
    found = identify.fit_windows(cut, scene, guess)
    np.testing.assert_allclose(np.exp(found.value), 9.0, rtol=1e-4)
    assert found.converged


def test_no_window_goes_across_a_gap():
    t = np.concatenate([np.arange(6.0), 20.0 + np.arange(4.0)])
    spins = rj.Spin(np.arange(30.0).reshape(10, 3))
    cut = identify.windows(t, spins, length=3)
    assert np.asarray(cut.starts.omega)[:, 0].tolist() == [0.0, 3.0, 6.0, 18.0]
    both = identify.Windows.joined(cut, cut)
    assert both.count == 8
    assert identify.Windows.joined(cut) is cut


def test_a_fit_that_is_stopped_returns_its_best_point():
    t, states, u = recorded()
    cut = identify.windows(t, states, {"u": u}, length=8, stride=8)
    found = identify.fit_windows(cut, scene, GUESS, max_steps=1)
    assert not found.converged
    assert found.message == "stopped after 1 steps: its best point"


SPINS = rj.Spin(np.ones((10, 3)))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: identify.windows(np.arange(10.0), SPINS, length=10), r"length \+ 1 = 11 times"),
        (lambda: identify.windows(np.arange(9.0), SPINS, length=2), "omega: wanted a row for each of 9 times"),
        (lambda: identify.windows(np.arange(10.0), rj.Spin(np.full((10, 3), np.nan)), length=2), "omega: NaN or infinity in row 0"),
        (lambda: identify.windows(np.arange(10.0), SPINS, {"u": np.ones(9)}, length=2), r"inputs\['u'\]: wanted a row"),
        (lambda: identify.windows(np.arange(10.0) ** 1.1, SPINS, length=2), "t: wanted even times"),
        (lambda: identify.windows(10.0 * np.arange(10.0) // 15, SPINS, length=2), "t: wanted even times"),
        (lambda: identify.windows(np.arange(10.0), SPINS, length=4, before=8), r"no stretch of 12 steps \(before \+ length\) without a gap; the longest has 9"),
        (lambda: identify.windows(np.arange(10.0), rj.Attitude(np.ones((10, 4)), np.ones((10, 3))), length=2), "q: wanted quaternions of length 1, scalar first, got another in row 0"),
        (lambda: identify.fit_windows(identify.windows(np.arange(10.0), SPINS, {"u": np.ones(10)}, length=2), lambda x: (BODY, Push(x, torques.Delayed(torques.Input("u"), -3.0))), jnp.ones(3)), r"inputs\['u'\]: a delay of -3 s reaches beyond the end of windows of 2 s"),
        (lambda: identify.Windows.joined(), "wanted at least one"),
        (lambda: identify.Windows.joined(*(identify.windows(np.arange(10.0), SPINS, length=k) for k in (2, 3))), "wanted one step, length"),
        (lambda: identify.fit_windows(identify.windows(np.arange(10.0), SPINS, length=2), scene, GUESS), "the torque reads 'u', got none"),
        (lambda: identify.fit_windows(identify.windows(np.arange(10.0), SPINS, length=2), lambda x: (BODY, None), jnp.ones(1), noise={"q": 1.0}), "noise: wanted a number for each of"),
        (lambda: identify.fit_windows(identify.windows(np.arange(10.0), SPINS, length=2), lambda x: (BODY, None), ()), "guess: wanted a tree of floating numbers"),
        (lambda: identify.fit_windows(identify.windows(np.arange(10.0), SPINS, length=2), lambda x: (BODY, rj.torques.Damping(-1e200 * x * jnp.ones(3))), jnp.ones(1)), "guess: the runs from it are not finite"),
    ],
)  # fmt: skip
def test_mistakes_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_numbers_of_no_real_body_are_said():
    """A body whose moments a fit drives beyond the triangle inequality."""
    t = H * np.arange(30)
    law = rj.torques.ConstantTorque([0.1, 0.1, 0.1])
    rates = np.outer(t, 0.1 / np.array([1.0, 1.0, 3.0]))
    cut = identify.windows(t, rj.Spin(rates), length=4, stride=4)

    def scene(log):
        moments = jnp.exp(log)
        return rj.Inertia(jnp.diag(moments)), law

    found = identify.fit_windows(cut, scene, jnp.log(jnp.array([1.0, 1.2, 1.5])))
    assert "no real body has these numbers" in found.message


def test_a_best_point_that_is_no_body_is_returned_with_a_word():
    """The scene takes any numbers while they are traced, and refuses those that were found."""
    t = jnp.linspace(0.0, 1.0, 21)
    # About y with a moment of 0.9, where the second moment about z, 1, leaves −0.1 about x.
    rate, angle = jnp.exp(-t / 0.9), 0.9 * (1.0 - jnp.exp(-t / 0.9))
    zero = jnp.zeros((21, 3))
    q = jax.vmap(rj.quaternion.exp)(zero.at[:, 1].set(angle))
    states = rj.Rigid(zero, zero, q, zero.at[:, 1].set(rate))
    drag = rj.torques.Damping(jnp.ones(3))
    scene = lambda k: (
        rj.MassProperties(1.0, jnp.zeros(3), jnp.diag(jnp.stack([k, 1.0, 1.0]))),
        drag,
    )
    windows = rj.identify.windows(t, states, length=10)
    found = rj.identify.fit_windows(windows, scene, jnp.asarray(0.2), noise={"x": 1.0, "v": 1.0, "q": 1e-3, "omega": 1e-3})  # fmt: skip
    np.testing.assert_allclose(found.value, -0.1, atol=1e-3)
    assert "at the best point the scene raises: second moment" in found.message
