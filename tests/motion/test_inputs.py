"""Laws that are driven: samples held exactly through a step, rotors, drag along the body's axes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion.drive import Drive

import rigidjax as rj
from rigidjax import torques

H, STEPS = 0.05, 12
MOMENTS = np.array([1.0, 2.0, 2.5])
BODY = rj.Inertia(np.diag(MOMENTS))


def spins(many):
    return rj.Spin(np.tile([0.0, 0.0, 0.3], (many, 1)))


RAMP = np.stack([np.arange(STEPS, dtype=float), -2.0 * np.arange(STEPS)])


@pytest.mark.parametrize("solver", [rj.solvers.RungeKutta4(), rj.solvers.DormandPrince8()])
def test_a_held_ramp_is_exact_at_every_step(solver):
    found = rj.batch.rollout(
        BODY, spins(2), H, STEPS, Drive(torques.Input("u")), solver=solver, save_every=1,
        inputs={"u": RAMP},
    )  # fmt: skip
    wanted = 0.3 + H * np.cumsum(RAMP, axis=1) / MOMENTS[2]
    np.testing.assert_allclose(np.asarray(found.omega)[..., 2], wanted, rtol=0, atol=1e-12)


def test_adaptive_steps_end_at_the_samples():
    times = H * np.arange(STEPS)
    law = torques.bind(Drive(torques.Input("u")), {"u": torques.Held(times, RAMP[0])})
    ts = np.append(times, H * STEPS)
    found = rj.simulate(BODY, rj.Spin([0.0, 0.0, 0.3]), ts, law).ys
    wanted = 0.3 + H * np.cumsum(np.append(0.0, RAMP[0])) / MOMENTS[2]
    np.testing.assert_allclose(np.asarray(found.omega)[:, 2], wanted, rtol=0, atol=1e-12)


def test_by_attitude_by_magnus_and_by_sensitivity():
    """The same samples on another rung and method; derivatives by them beside the exact ones."""
    many = rj.Attitude(np.tile([1.0, 0, 0, 0], (2, 1)), spins(2).omega)

    def last(inputs):
        law = Drive(torques.Input("u"))
        return rj.batch.rollout(BODY, many, H, STEPS, law, inputs={"u": inputs}).omega[:, 2]

    np.testing.assert_allclose(last(RAMP), 0.3 + H * RAMP.sum(1) / 2.5, rtol=0, atol=1e-12)
    slope = jax.jit(jax.grad(lambda u: jnp.sum(last(u))))(jnp.asarray(RAMP))
    np.testing.assert_allclose(slope, np.full((2, STEPS), H / 2.5), rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        ({"inputs": None}, ValueError, "inputs: the torque reads 'u', got none"),
        ({"inputs": {"v": RAMP}}, ValueError, "the torque reads 'u', got 'v'"),
        ({"inputs": {"u": RAMP, "v": RAMP}}, ValueError, "the torque reads 'u', got 'u', 'v'"),
        ({"inputs": [RAMP]}, TypeError, "wanted a mapping from names to arrays, .* got list"),
        (
            {"inputs": {"u": RAMP[:, :-1]}},
            ValueError,
            r"\(N, num_steps, \*k\) that begins with \(2, 12\), got \(2, 11\)",
        ),
        ({"inputs": {"u": RAMP * np.nan}}, ValueError, r"inputs\['u'\].*NaN"),
    ],
)
@pytest.mark.usefixtures("unhooked")
def test_wrong_inputs_are_named(change, kind, words):
    with pytest.raises(kind, match=words):
        rj.batch.rollout(BODY, spins(2), H, STEPS, Drive(torques.Input("u")), **change)


def test_other_mistakes_are_named():
    law = Drive(torques.Input("u"))
    with pytest.raises(ValueError, match=r"Input\('u'\) has no value: give inputs"):
        rj.simulate(BODY, rj.Spin([0.0, 0.0, 0.3]), [0.0, 1.0], law)
    with pytest.raises(ValueError, match=r"inputs are for Steps\(size, number\).*torques.Held"):
        rj.batch.simulate(BODY, spins(2), [0.0, 1.0], law, inputs={"u": RAMP})
    with pytest.raises(ValueError, match="inputs: the torque reads 'u', got none"):
        torques.bind(law, {})
    with pytest.raises(ValueError, match="times: wanted increasing times"):
        torques.Held([0.0, 0.0], [1.0, 2.0])
    with pytest.raises(ValueError, match=r"values: wanted a row for each of 2 times, got \(3,\)"):
        torques.Held([0.0, 1.0], [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="values: contains NaN"):
        torques.Held([0.0, 1.0], [1.0, np.nan])
    with pytest.raises(ValueError, match=r"positions: wanted \(R, 3\).*\(3,\)"):
        torques.Rotors(np.ones(3), np.ones(3), [1.0], 1.0, 1.0, [1.0])
    with pytest.raises(ValueError, match="directions: wanted unit vectors"):
        torques.Rotors(np.ones((1, 3)), np.ones((1, 3)), [1.0], 1.0, 1.0, [1.0])
    with pytest.raises(ValueError, match="spins: wanted 1 or -1"):
        torques.Rotors(np.ones((1, 3)), np.eye(3)[2:], [2.0], 1.0, 1.0, [1.0])
    with pytest.raises(ValueError, match=r"speeds: wanted shape \(1,\)|speeds"):
        torques.Rotors(np.ones((1, 3)), np.eye(3)[2:], [1.0], 1.0, 1.0, [1.0, 2.0])


CRAFT = rj.MassProperties(0.5, np.zeros(3), np.diag([1e-3, 1e-3, 2e-3]))
PLACES = 0.1 * np.array([[1.0, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]])
UP = np.tile([0.0, 0, 1.0], (4, 1))
REST = rj.Rigid([0.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])


def test_rotors_against_sums_by_hand():
    """Mahony, Kumar and Corke 2012, eqs 4 to 6, in NumPy; a hovering craft stays where it is."""
    thrust, drag = np.array([1.0, 2.0, 3.0, 4.0]) * 1e-6, 2e-8
    spins, speeds = np.array([1.0, -1, 1, -1]), np.array([500.0, 700, 600, 400])
    q = np.array([0.8, 0.2, -0.4, 0.4])
    law = torques.Rotors(PLACES, UP, spins, thrust, drag, speeds)
    found = law(0.0, rj.Rigid([0.0, 0, 0], [0.0, 0, 0], q, [0.0, 0, 0]), CRAFT)
    lift = thrust * speeds**2
    torque = np.cross(PLACES, lift[:, None] * UP).sum(0)
    torque[2] -= np.sum(spins * drag * speeds**2)
    np.testing.assert_allclose(found.torque, torque, rtol=1e-13)
    matrix = np.asarray(rj.quaternion.to_matrix(q))
    np.testing.assert_allclose(found.force, matrix @ [0.0, 0.0, lift.sum()], rtol=1e-13)
    hover = torques.Rotors(PLACES, UP, spins, 1e-6, drag, np.full(4, np.sqrt(0.5 * 9.81 / 4e-6)))
    both = torques.Sum(torques.UniformGravity([0.0, 0, -9.81]), hover)
    end = rj.simulate(CRAFT, REST, [0.0, 1.0], both).ys
    np.testing.assert_allclose(end.x[-1], 0.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(end.omega[-1], 0.0, rtol=0, atol=1e-12)


def test_drag_along_the_axes_slows_as_it_should():
    """v₀ exp(−a t/m) along one axis, v₀/(1 + b v₀ t/m) along another, both with derivatives."""
    ts = np.array([0.0, 0.7])

    def speed(a, b):
        law = torques.BodyDrag(jnp.stack([a, 0 * a, 0 * a]), jnp.stack([0 * b, b, 0 * b]))
        start = rj.Rigid([0.0, 0, 0], [2.0, -3.0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
        return rj.simulate(CRAFT, start, ts, law, rtol=1e-11, atol=1e-13).ys.v[-1, :2]

    found, slopes = jax.jit(lambda a, b: (speed(a, b), jax.jacfwd(speed, (0, 1))(a, b)))(0.3, 0.2)
    slow, fade = np.exp(-0.3 * 0.7 / 0.5), 1 + 0.2 * 3.0 * 0.7 / 0.5
    np.testing.assert_allclose(found, [2.0 * slow, -3.0 / fade], rtol=1e-9)
    np.testing.assert_allclose(slopes[0], [-1.4 * 2.0 * slow, 0.0], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(slopes[1], [0.0, 3.0 * 3.0 * 1.4 / fade**2], rtol=1e-8, atol=1e-12)
