"""What data do not determine is named: made-up singular vectors whose meaning is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import turns

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.answer.answers import Answer
from rigidjax.identify.answer.parts import Assessment, BestPoint, Uncertainty
from rigidjax.identify.answer.undetermined import Combination, describe_identifiability
from rigidjax.identify.uncertainty.quantities import Quantity

TS = np.linspace(0.0, 1.0, 5)
BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)


def fit_with(chart, directions, search="found", model="explains the readings", mix=None):
    """A fit of which only the directions that its data do not determine matter.

    **Arguments:** `directions` functions of a model, to the change (n,) of its free numbers.
    """
    gyro = identify.Gyro(0.01, bias=[0.0, 0.0, 0.0])
    turned = np.tile([0.8, 0.0, 0.6, 0.0], (5, 1))
    record = identify.Recording(
        TS, (gyro, np.ones((5, 3))), (identify.AttitudeSensor(0.01), turned)
    )
    bias = identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05)
    problem = identify.Model(record, chart, free=[bias])
    here = problem.start(BODY)
    null = np.stack([np.asarray(make(problem)) for make in directions])
    null = null if mix is None else mix @ null
    n = null.shape[1]
    like = jnp.eye(n)
    return identify.Fit(
        BestPoint(problem, here, tuple(jnp.ones((1, k)) for k in (3, 3))),
        Uncertainty(like, like, "none", jnp.asarray(null)),
        Assessment(Answer(search), Answer(model), (), 1.0, 1, 1.0), (), (),
    )  # fmt: skip


def moved(model, places, value):
    """No change but at these places."""
    return jnp.zeros(model.size).at[jnp.asarray(places)].set(value)


def grown(model):
    """The body by 1 %: half the logarithm of its size."""
    return moved(model, 0, 0.005)


def test_combinations_are_told_apart_and_named():
    def heading(model):
        # About the world's vertical, in the axes of the body.
        axis = rj.quaternion.rotate_inverse(first, jnp.array([0.0, 0.0, 1.0]))
        return moved(model, model.index.start[0, :3], axis)

    def spun(model):
        # The rate up, the bias down: in units of the typical rate and of 0.05 rad/s.
        rate, bias = jnp.array([0.0, 0.0, step_rate]), jnp.array([0.0, 0.0, -20.0])
        (slot,) = model.slots
        return moved(model, model.index.start[0, 3:], rate) + moved(model, slot.shared[0], bias)

    probe = fit_with(identify.Principal(1.5), [grown])
    first, step_rate = probe.state0.q, 1 / probe.model.typical_rate
    assert rj.quaternion.angle(first) > 0.1  # so that the world's axes are not the body's
    mix = np.random.default_rng(0).normal(size=(3, 3))
    found = fit_with(
        identify.Principal(1.5), [grown, heading, spun], mix=mix
    ).undetermined_combinations
    assert sorted(one.in_words for one in found) == [
        "Ix, Iy and Iz rise together: only their ratios are determined.",
        "The initial attitude about the world's z is not determined: no reading changes with it.",
        "Ωz rises as bias z falls: only Ωz + bias z is determined.",
    ]


def test_axes_that_turn_are_named_by_the_tensor():
    chart = identify.Tensor(1.0)

    def tilted(model):
        def vector(angle):
            turned = BODY.rotate(rj.quaternion.exp(angle * jnp.array([0.0, 0.0, 1.0])))
            return chart.vector(turned)

        return moved(model, range(6), (vector(1e-6) - vector(0.0)) / 1e-6)

    (one,) = fit_with(chart, [tilted]).undetermined_combinations
    assert one.names == ("Ixy",)
    assert one.in_words == "Ixy is not determined: no reading changes with it."


def test_a_fit_that_explains_nothing_calls_nothing_determined():
    lost = "does not explain the readings"
    (line,) = fit_with(identify.Principal(1.5), [grown], model=lost).identifiability
    assert "does not explain the data, so it determines nothing" in line
    failed = fit_with(identify.Principal(1.5), [grown], "not ended").identifiability
    assert "did not end in a minimum" in failed[0]
    assert "Ix, Iy and Iz rise together: only their ratios are determined." in failed


@pytest.mark.parametrize(
    ("changes", "relative", "words"),
    [
        ((0.01, -0.01), (True, True), "A rises as B falls: only A·B is determined."),
        ((0.01, 0.01), (True, True), "A and B rise together: only A/B is determined."),
        ((0.01, 0.02), (True, False), "No reading changes where these change together: A by +1 %, B by +0.02 m."),
    ],
)  # fmt: skip
def test_words(changes, relative, words):
    units = tuple("" if ratio else "m" for ratio in relative)
    assert Combination(("A", "B"), changes, units, relative).in_words == words


def test_a_number_that_switches_a_torque_is_named():
    class Until(eqx.Module):
        end: jax.Array
        unused: jax.Array

        def __call__(self, t, state, body):
            return jnp.array([0.2, 0.1, 0.5]) * jnp.where(t < self.end, 1.0, 0.0)

    law = Until(jnp.asarray(0.55), jnp.asarray(1.0))
    record = identify.Recording(TS, (identify.Gyro(0.01), np.ones((5, 3))))
    free = [
        identify.Free(lambda s: s.torque.end, "end", scale=1.0),
        identify.Free(lambda s: s.torque.unused, "gain", scale=1.0),
    ]
    problem = identify.Model(record, identify.Known(BODY), torque=law, free=free)
    here = problem.start()
    null = np.zeros((2, problem.size))
    for row, slot in enumerate(problem.slots):
        null[row, np.ravel(slot.shared)] = 1.0
    like = jnp.eye(null.shape[1])
    fit = identify.Fit(
        BestPoint(problem, here, (jnp.full((1, 3), 1e-3),)),
        Uncertainty(like, like, "none", jnp.asarray(null)),
        Assessment(Answer("found"), Answer("explains the readings"), (), 1.0, 1, 1.0), (), (),
    )  # fmt: skip
    words = [one.in_words for one in fit.undetermined_combinations]
    assert words[0].startswith("Readings change with end, but derivatives do not see it: a torque")
    assert words[1] == "Gain is not determined: no reading changes with it."


class Push(eqx.Module):
    """A push across by two numbers, of which the motion shows a product, a ratio, a sum..."""

    a: jax.Array
    b: jax.Array
    weights: jax.Array
    feels = rj.motion.HasSpin

    def __call__(self, t, state, body):
        a, b = self.a, self.b
        shown = jnp.sum(self.weights * jnp.stack([a * b, a / b, a + b, a - b]))
        return shown * jnp.array([0.0, 0.0, 1.0])


SIGNS = ["·", "/", " + ", " − "]


@pytest.fixture(scope="module")
def pushed_by():
    return [identify.Free(lambda s, k=k: getattr(s.torque, k), k, scale=0.1) for k in "ab"]


@pytest.mark.parametrize("values", [(0.7, 0.7), (-0.7, 0.7), (0.4, 1.3)])
@pytest.mark.parametrize("combine", SIGNS, ids=["product", "ratio", "sum", "difference"])
def test_a_sum_is_told_from_a_product(pushed_by, combine, values):
    """Numbers that are equal in size: small changes of a sum and of a product are then the same."""
    ts = np.linspace(0.0, 2.0, 11)
    law = Push(*map(jnp.asarray, values), jnp.eye(4)[SIGNS.index(combine)])
    rates = rj.simulate(BODY, rj.Spin([1.0, 2.0, 0.5]), ts, law).ys.omega
    record = identify.Recording(ts, (identify.Gyro(1e-3), rates))
    model = identify.Model(record, identify.Known(BODY), torque=law, free=pushed_by)
    found = identify.fit(model, starts=1, initial=model.start(omega=[1.0, 2.0, 0.5]))
    (one,) = found.undetermined_combinations
    assert f"only a{combine}b is determined" in one.in_words


def test_the_place_of_a_marker_is_known_only_from_the_centre_of_mass():
    ts, place = np.linspace(0.0, 2.0, 41), np.array([-0.08, 0.11, 0.3])
    body = rj.MassProperties(2.0, [0.08, 0.0, -0.3], BODY.tensor)
    start = rj.Rigid([0.0, 0, 0], [0.1, 0, 0], [1.0, 0, 0, 0], [2.0, 3.0, -1.0])
    states = rj.simulate(body, start, ts).ys
    arm = jnp.asarray(place - np.asarray(body.com))
    seen = states.x + turns.to_world(states.q, arm)
    sensors = (identify.Gyro(0.01), states.omega), (identify.Marker(place, 0.01), seen)
    model = identify.Model(
        identify.Recording(ts, *sensors),
        identify.Mass(body, ["com"]),
        free=[identify.Free(lambda s: s.sensors[1].place, "place", scale=0.1)],
    )
    found = identify.fit(model, starts=1, initial=model.start(body, start.omega))
    words = [one.in_words for one in found.undetermined_combinations]
    assert words == [
        f"com {k} and place {k} rise together: only com {k} − place {k} is determined."
        for k in "xyz"
    ]
    units = {quantity.name: quantity.unit for quantity in found.quantities}
    assert units["com x"] == units["place x"] == "m"


@pytest.mark.parametrize(
    ("ratio", "other", "many"), [(1e-7, 2.0, 1), (1e-7, 0.02, 0), (1e-3, 2.0, 0)]
)
def test_a_tiny_interval_beside_one_of_everything_is_told(ratio, other, many):
    """Of two ratios of moments, given with these relative deviations."""
    bias = lambda model: moved(model, model.slots[0].shared[0], 1.0)
    fit = fit_with(identify.PrincipalRatios(), [bias])
    ratios = (
        Quantity("Ix/Iz", 1.0, ratio, "", True, most=1.0),
        Quantity("Iy/Iz", 0.5, 0.5 * other, "", True, most=1.0),
    )
    parts = fit.point, fit.uncertainty, fit.assessment, (*ratios, *fit.quantities[2:])
    said = [one for one in describe_identifiability(*parts) if "at a limit of real bodies" in one]
    assert len(said) == many
    assert all("of Ix/Iz" in one and "of Iy/Iz spans most" in one for one in said)
