"""Bodies in moving frames, whole states, and frames that ride on trajectories."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from frames.test_moving import NUMBERS, TIGHT, wobbly
from surface.scenes import Kick

import rigidjax as rj
from rigidjax.frames import BodyInFrame, MovingFrame, Point
from rigidjax.frames.frame_dynamics import InFrame
from rigidjax.motion.equations import AttitudeEquations

BODY = rj.shapes.box(2.0, [0.3, 0.5, 0.8])
START = rj.Rigid([0.4, -0.2, 0.3], [0.1, 0.5, -0.3], [0.8, 0.0, 0.6, 0.0], [0.5, -0.4, 0.7])
FRAME = wobbly(0.5 * NUMBERS)
TS = np.array([0.0, 1.0, 2.0])


def same(found, wanted, bar):
    for name in ("x", "v", "omega"):
        a, b = getattr(found, name, 0.0), getattr(wanted, name, 0.0)
        np.testing.assert_allclose(a, b, rtol=0, atol=bar)
    if hasattr(found, "q"):
        np.testing.assert_allclose(jnp.abs(jnp.sum(found.q * wanted.q)), 1.0, rtol=0, atol=bar)


class Spring(eqx.Module):
    """A force and a torque in S, of place, velocity, attitude, rate and time."""

    feels = rj.motion.HasPose

    def __call__(self, t, state, body):
        force = (
            -3 * state.x - 0.2 * state.v + jnp.sin(t) * rj.quaternion.rotate(state.q, jnp.ones(3))
        )
        up = rj.quaternion.rotate_inverse(state.q, jnp.array([0.0, 0, 1]))
        return rj.torques.Wrench(force, 0.1 * up - 0.05 * state.omega)


class SeenInside(eqx.Module):
    """The same law for who is in S': it asks S, and takes the force into the axes of S'."""

    frame: MovingFrame
    law: Spring

    def __call__(self, t, state, body):
        outside = self.law(t, self.frame.to_inertial(state, t), body)
        return rj.torques.Wrench(self.frame.force_from_inertial(outside.force, t), outside.torque)


@pytest.mark.slow
@pytest.mark.parametrize(
    "law", [pytest.param(None, marks=pytest.mark.slow), Spring()], ids=["free", "spring"]
)
def test_a_rigid_body_moves_and_turns_inside_a_moving_frame(law):
    kw = {} if law is None else TIGHT
    outside = rj.simulate(BODY, START, TS, law, **kw).ys
    inner = BodyInFrame(FRAME, None if law is None else SeenInside(FRAME, law))
    first = FRAME.from_inertial(START, 0.0)
    inside = rj.simulate(BODY, first, TS, inner, **TIGHT).ys
    last = jax.tree.map(lambda leaf: leaf[-1], (inside, outside))
    same(eqx.filter_jit(FRAME.to_inertial)(last[0], TS[-1]), last[1], 1e-11)


@pytest.mark.slow
def test_its_centre_is_a_point():
    # Without a law the centre of mass moves as a Point does, whatever the body does.
    first = FRAME.from_inertial(START, 0.0)
    body = rj.simulate(BODY, first, TS, BodyInFrame(FRAME), **TIGHT).ys
    point = rj.simulate(None, Point(first.x, first.v), TS, FRAME, **TIGHT).ys
    np.testing.assert_allclose(body.x[-1], point.x[-1], rtol=0, atol=1e-11)
    np.testing.assert_allclose(body.v[-1], point.v[-1], rtol=0, atol=1e-11)


class Drive(eqx.Module):
    """A torque that is never at rest: the body is not free."""

    k: jax.Array

    def __call__(self, t, state, body):
        return self.k * jnp.sin(t) - 0.1 * state.omega


INERTIA = rj.Inertia.from_principal(1.0, 1.3, 1.6)
ATTITUDE = rj.Attitude([1.0, 0, 0, 0], [0.5, -0.4, 0.7])
DRIVE = Drive(jnp.array([0.3, 0.2, -0.4]))


def driven():
    return rj.simulate(INERTIA, ATTITUDE, np.linspace(0.0, 2.0, 5), DRIVE, **TIGHT)


def test_a_frame_rides_on_a_forced_body():
    solution, t = driven(), 1.3
    now = eqx.filter_jit(MovingFrame(solution).at)(t)
    there = solution.evaluate(t)
    np.testing.assert_allclose(now.rate, there.omega, rtol=0, atol=1e-13)
    np.testing.assert_allclose(now.rotation, rj.quaternion.to_matrix(there.q), rtol=0, atol=1e-13)
    # dΩ/dt of the solved motion against the equation it solves.
    wanted = AttitudeEquations(INERTIA, DRIVE)(t, there).omega
    np.testing.assert_allclose(now.rate_change, wanted, rtol=0, atol=1e-11)
    for state in (Point(NUMBERS[:3], NUMBERS[3:6]), START, ATTITUDE):
        same(now.from_inertial(now.to_inertial(state)), state, 1e-11)


@pytest.mark.slow
def test_motion_inside_a_frame_that_rides_on_a_forced_body():
    # A free particle seen from the body: straight outside.
    frame, start = MovingFrame(driven()), Point([0.4, -0.2, 0.3], [0.1, 0.5, -0.3])
    first = eqx.filter_jit(frame.from_inertial)(start, 0.0)
    inside = rj.simulate(None, first, [0.0, 2.0], InFrame(frame), **TIGHT).ys
    last = jax.tree.map(lambda leaf: leaf[-1], inside)
    back = eqx.filter_jit(frame.to_inertial)(last, 2.0)
    same(back, Point(start.x + 2 * start.v, start.v), 1e-11)


class Ellipse(eqx.Module):
    """An origin that goes round."""

    def __call__(self, t):
        return jnp.stack([jnp.cos(t), 2 * jnp.sin(t), 0.3 * t])


@pytest.mark.slow
def test_frames_of_trajectories_compose():
    # One rides on a forced body, the next on a free body within it, each with an origin of its own.
    free = rj.exact.FreeBody(INERTIA, rj.Attitude([0.6, 0.8, 0, 0], [0.2, 0.3, -0.6]))
    outer, inner, t = MovingFrame(driven(), Ellipse()), MovingFrame(free, Ellipse()), 0.7

    @eqx.filter_jit
    def both(outer, inner, state):
        whole = outer.compose(inner)
        step = outer.to_inertial(inner.to_inertial(state, t), t)
        at_once = whole.to_inertial(state, t)
        return at_once, step, whole.from_inertial(step, t), whole.inverse().to_inertial(step, t)

    for state in (Point(NUMBERS[:3], NUMBERS[3:6]), START):
        at_once, step, back, through = both(outer, inner, state)
        same(at_once, step, 1e-11)
        same(back, state, 1e-11)
        same(through, state, 1e-11)


@pytest.mark.usefixtures("unhooked")
def test_a_force_on_what_only_turns_is_refused():
    law = BodyInFrame(FRAME, rj.torques.UniformGravity([0.0, 0, -9.8]))
    with pytest.raises(
        TypeError, match="UniformGravity returns a force: wanted a Rigid state, got Attitude"
    ):
        law(0.0, ATTITUDE, BODY)


# 10 ms of 20 after 2 s: steps of an adaptive solver pass over it.
KICK = Kick(rj.torques.Held([0.0, 2.0, 2.01], [[0.0, 0, 0], [0.0, 0, 20.0], [0.0, 0, 0]]))
TURN = MovingFrame(rj.frames.Uniform([0.0, 0, 0.3]))


@pytest.mark.parametrize("scene", [InFrame(TURN, KICK), rj.frames.Force(KICK)])
def test_a_scene_passes_on_the_times_at_which_its_force_jumps(scene):
    motion = rj.simulate(None, Point([0.1, 0.2, 0.0], [0.0, 0.0, 0.5]), [0.0, 5.0], scene).ys
    np.testing.assert_allclose(motion.v[-1, 2], 0.7, rtol=0, atol=1e-9)


def test_a_body_in_a_frame_feels_a_short_pulse():
    sphere, start = rj.Inertia(2.0 * jnp.eye(3)), rj.Attitude([1.0, 0, 0, 0], np.zeros(3))
    turned = rj.simulate(sphere, start, [0.0, 5.0], BodyInFrame(TURN, KICK)).ys
    np.testing.assert_allclose(turned.omega[-1, 2], 0.1, rtol=0, atol=1e-9)


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize(
    "law",
    [
        rj.torques.Sum(rj.scenes.libration(0.3), rj.torques.Flywheel([0.0, 0, 2.0])),
        BodyInFrame(TURN, rj.torques.Flywheel([0.0, 0, 2.0])),
        rj.torques.ChangingInertia(lambda t: (1 + t) * jnp.eye(3), BodyInFrame(TURN)),
    ],
    ids=["sum", "inside", "outside"],
)
def test_a_law_of_the_absolute_rate_is_refused_in_a_moving_frame(law):
    # The states in S' have the relative rate: h × Ω was wrong by h × W, and nothing said so.
    with pytest.raises(TypeError, match="needs the body rate in an inertial frame"):
        rj.simulate(INERTIA, ATTITUDE, [0.0, 1.0], law)
