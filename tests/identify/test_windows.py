"""Fits of many short open-loop runs: numbers known beforehand come back, mistakes are named."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify, torques
from rigidjax.identify import Free, Known, Model

H, T = 0.02, 81
BODY = rj.Inertia.from_principal(1.0, 2.0, 2.5)
BALL = rj.Inertia.from_principal(1.0, 1.0, 1.0)


class Push(torques.AbstractTorque):
    """A driven torque along an axis of the body, and the same damping about all axes."""

    feels = rj.motion.HasSpin
    gain: jax.Array = eqx.field(converter=jnp.asarray)
    damping: jax.Array = eqx.field(converter=jnp.asarray)
    source: torques.Input | torques.Delayed = torques.Input("u")

    def __call__(self, t, state, body):
        return self.gain * self.source(t) - self.damping * state.omega


class Slow(torques.AbstractTorque):
    """A damping of two numbers: of both about all axes, of the second `apart` more about x."""

    feels = rj.motion.HasSpin
    a: jax.Array = eqx.field(converter=jnp.asarray)
    b: jax.Array = eqx.field(converter=jnp.asarray)
    c: jax.Array = eqx.field(converter=jnp.asarray)
    apart: float = 0.0
    together: float = 1.0

    def __call__(self, t, state, body):
        x = jnp.stack([state.omega[0], 0.0, 0.0])
        both = (self.a + self.together * self.b) * state.omega + self.apart * self.b * x
        return self.c * jnp.ones(3) - both


GAIN = Free(lambda s: s.torque.gain, "gain")
DAMPING = Free(lambda s: s.torque.damping, "damping")
DRAG = Free(lambda s: s.torque.coefficient, "drag")
TRUE = {"gain": np.array([0.5, -0.3, 0.8]), "damping": np.array(0.2)}
GUESS = Push([1.0, 0.0, 0.0], 0.0)


def fitted(cut, law, free, body=BODY, stretches=12, **options):
    return identify.fit(Model(cut, Known(body), torque=law, free=free, stretches=stretches), **options)  # fmt: skip


def deviation(fit, name):
    (found,) = (q.deviation for q in fit.quantities if q.name == name)
    return found


def recorded(sigma=0.0, seed=0):
    """Attitudes and rates of one run through diffrax's tight steps, with noise; and the inputs."""
    rng = np.random.default_rng(seed)
    t, u = H * np.arange(T), np.cos(0.3 * np.arange(T)) + rng.normal(size=T)
    law = torques.bind(Push(**TRUE), {"u": torques.Held(t, u)})
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


def slowed(sigma=1e-3):
    """Times and rates of a ball whose damping is 0.3 1/s, with noise."""
    t = H * np.arange(T)
    omega = np.array([0.5, 1.0, -0.4]) * np.exp(-0.3 * t)[:, None]
    return t, omega + sigma * np.random.default_rng(1).normal(size=(T, 3))


def test_known_numbers_come_back():
    t, states, u = recorded()
    cut = identify.windows(t, states, {"u": u}, length=8, stride=8)
    assert (cut.count, cut.length, cut.step) == (10, 8, H)
    found = fitted(cut, GUESS, [GAIN, DAMPING])
    assert found.search.word == "found"
    # Equal steps of order 4 stand against a tight solver: 1e-7 of the numbers is theirs.
    for name, value in TRUE.items():
        np.testing.assert_allclose(found.values[name], value, rtol=0, atol=1e-6)
    ahead = identify.predict_windows(found, cut)
    assert ahead.steps.tolist() == list(range(1, 9))
    assert max(e.max() for e in ahead.mean_absolute.values()) < 1e-7
    held = cut.held_horizons()
    rise = np.abs(np.asarray(states.omega)[1::8] - np.asarray(states.omega)[:-1:8]).mean()
    np.testing.assert_allclose(held.mean_absolute["omega"][0], rise, rtol=1e-12)
    # Of other windows, of another length, too.
    other = identify.predict_windows(found, identify.windows(t, states, {"u": u}, length=5))
    assert other.steps.size == 5 and max(e.max() for e in other.rms.values()) < 1e-7


def test_other_starting_numbers_compile_nothing():
    traced = []

    class Counted(Push):
        def __call__(self, t, state, body):
            traced.append(1)
            return Push.__call__(self, t, state, body)

    t, states, u = recorded(1e-3)
    cut = identify.windows(t, states, {"u": u}, length=4, stride=4)
    first = fitted(cut, Counted([1.0, 0.0, 0.0], 0.0), [GAIN, DAMPING])
    assert traced
    traced.clear()
    again = fitted(cut, Counted([0.3, 0.2, -0.1], 0.4), [GAIN, DAMPING])
    assert not traced
    for name, value in first.values.items():
        reach = [deviation(first, q.name) for q in first.quantities if q.name.startswith(name)]
        np.testing.assert_array_less(np.abs(again.values[name] - value), 1e-2 * np.max(reach))


def test_what_windows_do_not_show_has_an_infinite_deviation():
    t, omega = slowed()
    free = [Free(lambda s: s.torque.a, "a"), Free(lambda s: s.torque.b, "b")]
    cut = identify.windows(t, rj.Spin(omega), length=8, stride=8)
    found = fitted(cut, Slow(0.1, 0.1, 0.0), free, BALL)
    assert float(found.values["a"] + found.values["b"]) == pytest.approx(0.3, abs=0.02)
    assert {deviation(found, name) for name in "ab"} == {np.inf}
    (both,) = found.undetermined_combinations
    assert both.names == ("a", "b")


def test_one_window_shows_no_deviation():
    """It comes from how windows differ."""
    t, omega = slowed()
    cut = identify.windows(t[:9], rj.Spin(omega[:9]), length=8)
    found = fitted(cut, Slow(0.1, 0.0, 0.0), [Free(lambda s: s.torque.a, "a")], BALL)
    assert cut.count == 1 and np.isinf(deviation(found, "a"))
    assert "from the differences between windows, and there is one" in found.status
    low, high = found.interval_of(lambda point: point.values["a"])
    assert (low, high) == (-np.inf, np.inf)


def test_a_body_at_rest_shows_nothing_of_its_damping():
    still = identify.windows(
        H * np.arange(9), rj.Spin(np.zeros((9, 3))), length=2, stride=2, noise={"omega": 0.1}
    )
    found = fitted(still, Slow(0.1, 0.0, 0.0), [Free(lambda s: s.torque.a, "a")])
    assert np.isinf(deviation(found, "a"))
    assert [one.names for one in found.undetermined_combinations] == [("a",)]


@pytest.mark.parametrize("apart", [1e-3, 1e-5, 3e-6])
def test_numbers_that_are_hardly_told_apart_have_wide_deviations_not_nan(apart):
    t, omega = slowed()
    cut = identify.windows(t, rj.Spin(omega), length=4, stride=4)
    free = [Free(lambda s, k=k: getattr(s.torque, k), k) for k in "abc"]
    found = fitted(cut, Slow(0.1, 0.1, 0.1, apart=apart), free, BALL)
    # The readings show a + b, apart · b and c: a fit of those three finds their deviations.
    plain = Slow(0.1, 0.1, 0.1, apart=1.0, together=0.0)
    wanted = fitted(cut, plain, free, BALL)
    refits = [fitted(without_stretch(cut, k), plain, free, BALL).values for k in range(12)]
    for name in ("b", "c"):
        off = np.array([float(one[name] - wanted.values[name]) for one in refits])
        by_hand = np.sqrt(11 / 12 * np.sum(off**2))
        assert deviation(wanted, name) == pytest.approx(by_hand, rel=0.02)
    for name in ("a", "b"):
        own = deviation(found, name) * apart
        assert own == pytest.approx(deviation(wanted, "b"), rel=0.01)
    assert deviation(found, "c") == pytest.approx(deviation(wanted, "c"), rel=0.01)


def without_stretch(cut, k, count=12):
    """The windows without one stretch."""
    kept = np.arange(cut.count) * count // cut.count != k
    return jax.tree.map(lambda a: a[kept], cut)


def test_intervals_hold_though_windows_overlap():
    """Twelve records with noise, five windows over each sample: of 48 intervals 95 % hold."""
    inside = []
    for seed in range(12):
        t, states, u = recorded(2e-3, seed)
        cut = identify.windows(t, states, {"u": u}, length=10, stride=2)
        found = fitted(cut, Push(**TRUE), [GAIN, DAMPING])
        assert found.covariance_kind == "jackknife: one of 12 stretches of windows left out"
        intervals = found.interval()
        truth = dict(zip(("gain x", "gain y", "gain z"), TRUE["gain"], strict=True))
        for name, value in (truth | {"damping": TRUE["damping"]}).items():
            inside.append(intervals[name][0] < value < intervals[name][1])
    # 45.6 are expected; three standard deviations of a binomial number are 4.5.
    assert len(inside) == 48 and sum(inside) >= 41


def test_a_number_that_one_stretch_shows_is_named():
    t, omega = slowed()
    # A push of 0.2 s about x, in the windows 18 … 22 of 40.
    omega[:, 0] += 0.5 * np.clip(t - 18 * 2 * H, 0.0, 0.2)
    inputs = {"u": ((t >= 18 * 2 * H - 1e-9) & (t < 18 * 2 * H + 0.2 - 1e-9)).astype(float)}
    cut = identify.windows(t, rj.Spin(omega), inputs, length=2, stride=2)
    law = Push([0.1, 0.0, 0.0], 0.1)
    found = fitted(cut, law, [GAIN, DAMPING], BALL, stretches=5)
    # All of the push lies in the third of five stretches: the others do not show its size.
    assert np.isinf(deviation(found, "gain x")) and deviation(found, "damping") < 0.05
    assert "only windows 16 … 23 show gain x" in found.search.reasons
    assert found.undetermined_combinations == ()
    low, high = found.interval_of(lambda point: point.values["gain"][0])
    assert np.isinf(low) and np.isinf(high)
    apart = fitted(cut, law, [GAIN, DAMPING], BALL, stretches=20)
    assert deviation(apart, "gain x") < 0.1


def test_groups_of_windows_have_values_of_their_own():
    """Two halves of a record with different damping: each value and deviation is that of its half."""
    t, omega = slowed()
    cut = identify.windows(t, rj.Spin(omega), length=4, stride=4)
    halves = ["first"] * 10 + ["second"] * 10
    free = Free(lambda s: s.torque.a, "a", each=halves)
    found = fitted(cut, Slow(0.1, 0.0, 0.0), [free], BALL, stretches=20)
    alone = Free(lambda s: s.torque.a, "a")
    for k, label in enumerate(("first", "second")):
        part = jax.tree.map(lambda a, k=k: a[10 * k : 10 * k + 10], cut)
        half = fitted(part, Slow(0.1, 0.0, 0.0), [alone], BALL, stretches=10)
        tenth = deviation(half, "a")
        # The unit of errors differs, not what they say of one number.
        np.testing.assert_allclose(found.values["a"][k], half.values["a"], atol=1e-3 * tenth)
        factor = np.sqrt((19 / 20) / (9 / 10))
        assert deviation(found, f"a [{label}]") == pytest.approx(factor * tenth, rel=1e-3)


def test_long_windows_lead_to_the_truth_from_a_poor_guess():
    """A dipole in a field, three turns to and fro a window: by its whole length alone the search
    ends in another minimum of the cost.
    """
    body = rj.Inertia.from_principal(1.0, 1.2, 1.5)
    t = 0.05 * np.arange(241)

    class Dipole(torques.AbstractTorque):
        feels = rj.motion.HasAttitude
        size: jax.Array = eqx.field(converter=jnp.asarray)

        def __call__(self, t, state, body):
            law = torques.MagneticDipole(self.size * jnp.array([1.0, 0, 0]), [0.0, 1.0, 0.0])
            return law(t, state, body)

    start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0.0, 0.0])
    ys = rj.simulate(body, start, t, Dipole(9.0), rtol=1e-10, atol=1e-12).ys
    cut = identify.windows(t, ys, length=120, stride=40)
    free = Free(lambda s: s.torque.size, "size", positive=True)
    found = fitted(cut, Dipole(3.0), [free], body)
    np.testing.assert_allclose(found.values["size"], 9.0, rtol=1e-4)
    assert found.search.word == "found"


def test_no_window_goes_across_a_gap():
    t = np.concatenate([np.arange(6.0), 20.0 + np.arange(4.0)])
    spins = rj.Spin(np.arange(30.0).reshape(10, 3))
    cut = identify.windows(t, spins, length=3)
    assert np.asarray(cut.starts.omega)[:, 0].tolist() == [0.0, 3.0, 6.0, 18.0]
    both = identify.Windows.join(cut, cut)
    assert both.count == 8
    assert identify.Windows.join(cut) is cut


def test_a_fit_that_is_stopped_returns_its_best_point():
    t, states, u = recorded()
    cut = identify.windows(t, states, {"u": u}, length=8, stride=8)
    found = fitted(cut, GUESS, [GAIN, DAMPING], max_steps=1)
    assert found.search.word == "not ended"
    assert "max_steps reached" in found.search.reasons
    assert "this is the best point found" in found.search.reasons


def test_a_guess_whose_runs_are_not_finite_says_so():
    cut = identify.windows(np.arange(10.0), SPINS, length=2)
    found = fitted(cut, torques.Damping(-1e200 * jnp.ones(3)), [DRAG])
    assert found.search.word == "not ended"
    assert found.search.reasons == ("no start gave a finite cost",)


SPINS = rj.Spin(np.ones((10, 3)))
TIMES = np.arange(10.0)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: identify.windows(TIMES, SPINS, length=10), r"length \+ 1 = 11 times"),
        (lambda: identify.windows(np.arange(9.0), SPINS, length=2), "omega: wanted a row for each of 9 times"),
        (lambda: identify.windows(TIMES, rj.Spin(np.full((10, 3), np.nan)), length=2), "omega: NaN or infinity in row 0"),
        (lambda: identify.windows(TIMES, SPINS, {"u": np.ones(9)}, length=2), r"inputs\['u'\]: wanted a row"),
        (lambda: identify.windows(TIMES**1.1, SPINS, length=2), "t: wanted even times"),
        (lambda: identify.windows(10.0 * TIMES // 15, SPINS, length=2), "t: wanted even times"),
        (lambda: identify.windows(TIMES, SPINS, length=4, before=8), r"no stretch of 12 steps \(before \+ length\) without a gap; the longest has 9"),
        (lambda: identify.windows(TIMES, rj.Attitude(np.ones((10, 4)), np.ones((10, 3))), length=2), "q: wanted quaternions of length 1, scalar first, got another in row 0"),
        (lambda: identify.windows(TIMES, SPINS, length=2, noise={"q": 1.0}), "noise: wanted a number for each of"),
        (lambda: Model(identify.windows(TIMES, SPINS, {"u": np.ones(10)}, length=2), Known(BODY), torque=Push([1.0, 0, 0], 0.0, torques.Delayed(torques.Input("u"), -3.0))), r"inputs\['u'\]: a delay of -3 s reaches beyond the end of windows of 2 s"),
        (lambda: identify.Windows.join(), "wanted at least one"),
        (lambda: identify.Windows.join(*(identify.windows(TIMES, SPINS, length=k) for k in (2, 3))), "wanted one step, length"),
        (lambda: Model(identify.windows(TIMES, SPINS, length=2), Known(BODY), torque=GUESS), "the torque reads 'u', got none"),
        (lambda: Model(identify.windows(TIMES, SPINS, {"v": np.ones(10)}, length=2), Known(BODY), torque=GUESS), "the torque reads 'u', got 'v'"),
        (lambda: Model(identify.windows(TIMES, SPINS, length=2), Known(BODY), torque=torques.Damping(jnp.ones(3)), integrator=identify.FixedSteps(2)), "integrator: samples as inputs are held"),
        (lambda: Model(identify.windows(TIMES, SPINS, length=2), Known(BODY), process=torques.RandomTorque(0.1)), "process: a filter follows one record"),
        (lambda: Model(identify.windows(TIMES, SPINS, length=2), Known(BODY), stretches=1), "stretches: wanted"),
    ],
)  # fmt: skip
def test_mistakes_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


class Diagonal(identify.AbstractBodyChart):
    """Three moments by their logarithms, which may be those of no real body."""

    size, log_names, unit = 3, ("Ix", "Iy", "Iz"), "kg m²"

    def body(self, vector):
        return rj.Inertia(jnp.diag(jnp.exp(vector)))

    def vector(self, body):
        return self.logs(body)

    def logs(self, body):
        return jnp.log(jnp.diagonal(body.tensor))


def test_numbers_of_no_real_body_are_said():
    """A body whose moments a fit drives beyond the triangle inequality."""
    t = H * np.arange(30)
    law = torques.ConstantTorque([0.1, 0.1, 0.1])
    rates = np.outer(t, 0.1 / np.array([1.0, 1.0, 3.0]))
    cut = identify.windows(t, rj.Spin(rates), length=4, stride=4)
    model = Model(cut, Diagonal(), torque=law)
    guess = model.start(rj.Inertia.from_principal(1.0, 1.2, 1.5))
    found = identify.fit(model, starts=1, initial=guess)
    np.testing.assert_allclose(np.diag(found.body.tensor), [1.0, 1.0, 3.0], rtol=0.01)
    assert any("no real body has these numbers" in one for one in found.explanation.reasons)


class SecondMoment(identify.AbstractBodyChart):
    """The second moment about x, of either sign; the others are one."""

    size, log_names, plain_names = 1, (), ("Sxx",)

    def body(self, vector):
        moment = jnp.diag(jnp.stack([vector[0], 1.0, 1.0]))
        return rj.MassProperties(1.0, jnp.zeros(3), moment)

    def vector(self, body):
        return self.plain(body)

    def logs(self, body):
        return jnp.zeros(0)

    def plain(self, body):
        return body.second_moment[:1, 0]


def test_a_best_point_that_is_no_body_is_returned_with_a_word():
    """The chart takes any numbers while they are traced, and refuses those that were found."""
    t = jnp.linspace(0.0, 1.0, 21)
    # About y with a moment of 0.9, where the second moment about z, 1, leaves −0.1 about x.
    rate, angle = jnp.exp(-t / 0.9), 0.9 * (1.0 - jnp.exp(-t / 0.9))
    zero = jnp.zeros((21, 3))
    q = jax.vmap(rj.quaternion.exp)(zero.at[:, 1].set(angle))
    states = rj.Rigid(zero, zero, q, zero.at[:, 1].set(rate))
    noise = {"x": 1.0, "v": 1.0, "q": 1e-3, "omega": 1e-3}
    cut = identify.windows(t, states, length=10, noise=noise)
    model = Model(cut, SecondMoment(), torque=torques.Damping(jnp.ones(3)))
    found = identify.fit(model, starts=1, initial=jnp.array([0.2]))
    np.testing.assert_allclose(found.x, [-0.1], atol=1e-3)
    assert any("no real body has these numbers" in one for one in found.explanation.reasons)
