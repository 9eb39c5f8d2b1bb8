"""What data do not determine is named: made-up singular vectors whose meaning is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.answer.answers import Answer
from rigidjax.identify.answer.undetermined import Combination

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
        problem, here, like, like, "none", tuple(jnp.ones((1, k)) for k in (3, 3)), (), 1.0, 1,
        1.0, 1.0, jnp.ones(n), jnp.asarray(null), (), Answer(search),
        Answer(model), (),
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
        "No reading changes where these change together: Ωz by +0.0005 rad/s, bias z by "
        "−0.0005 rad/s.",
        "The initial attitude about the world's z is not determined: no reading changes with it.",
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
    assert not any("well determined" in line for line in failed)


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
        problem, here, like, like, "none", (jnp.full((1, 3), 1e-3),), (), 1.0, 1, 1.0, 1.0,
        jnp.ones(null.shape[1]), jnp.asarray(null), (), Answer("found"),
        Answer("explains the readings"), (),
    )  # fmt: skip
    words = [one.in_words for one in fit.undetermined_combinations]
    assert words[0].startswith("Readings change with end, but derivatives do not see it: a torque")
    assert words[1] == "Gain is not determined: no reading changes with it."
