"""The bodies, states and laws that the good calls share: of no symmetry, and made once."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import rigidjax as rj

V = np.array([0.3, -0.5, 0.2])
W = np.array([0.7, 0.1, -0.4])
Y = np.array([1.1, 0.4, -0.6])
Q = np.array([0.8, 0.4, -0.4, 0.2])
P = np.array([0.2, 0.4, 0.4, 0.8])
TS = np.array([0.0, 0.4, 0.9, 1.5])
# Rotations by Q and P, and the inertia of a body turned by Q.
M = np.array([[0.6, -0.64, -0.48], [0.0, 0.6, -0.8], [0.8, 0.48, 0.36]])
N = np.array([[-0.6, 0.0, 0.8], [0.64, -0.6, 0.48], [0.48, 0.8, 0.36]])
SYMMETRIC = np.array([[2.0, 0.1, -0.2], [0.1, 2.5, 0.3], [-0.2, 0.3, 3.0]])
SECOND = np.array([[1.75, -0.1, 0.2], [-0.1, 1.25, -0.3], [0.2, -0.3, 0.75]])
DOWN = np.array([0.0, 0.0, -9.81])


@functools.cache
def inertia() -> rj.Inertia:
    return rj.Inertia(jnp.asarray(SYMMETRIC))


@functools.cache
def body() -> rj.MassProperties:
    return rj.MassProperties(2.0, [0.1, -0.2, 0.3], SECOND)


@functools.cache
def other_body() -> rj.MassProperties:
    return rj.MassProperties(3.0, [0.0, 0.1, 0.2], np.diag([1.0, 2.0, 1.5]))


@functools.cache
def spin() -> rj.Spin:
    return rj.Spin(W)


@functools.cache
def attitude() -> rj.Attitude:
    return rj.Attitude(Q, W)


@functools.cache
def rigid() -> rj.Rigid:
    return rj.Rigid([1.0, 2.0, -0.5], [0.3, 0.1, -0.2], Q, W)


@functools.cache
def point() -> rj.Point:
    return rj.Point([0.5, 0.2, -0.1], [0.1, 0.3, 0.2])


@functools.cache
def top() -> rj.torques.HeavyTop:
    return rj.torques.HeavyTop(2.0, [0.02, 0.01, 0.3], DOWN)


@functools.cache
def damping() -> rj.torques.Damping:
    return rj.torques.Damping([0.1, 0.2, 0.3])


@functools.cache
def turning() -> rj.frames.Uniform:
    return rj.frames.Uniform(W)


@functools.cache
def frame() -> rj.frames.MovingFrame:
    return rj.frames.MovingFrame(turning(), Place(jnp.asarray(V)))


class Place(eqx.Module):
    """A place that moves: a start, growing with t²."""

    start: Any

    def __call__(self, t: Any) -> Any:
        return self.start.astype(t.dtype) * (1.0 + t * t)


class Quadratic(eqx.Module):
    """½ k t²."""

    k: Any

    def __call__(self, t: Any) -> Any:
        return 0.5 * self.k.astype(t.dtype) * t * t


class Spring(eqx.Module):
    """A potential of the attitude."""

    k: Any

    def __call__(self, q: Any) -> Any:
        return 2.0 * self.k.astype(q.dtype) * (q[1] ** 2 + q[2] ** 2 + 2 * q[3] ** 2)


class Kinetic(eqx.Module):
    """A pendulum's Lagrangian."""

    g: Any

    def __call__(self, q: Any, rate: Any) -> Any:
        return 0.5 * jnp.sum(rate * rate) + self.g * jnp.sum(jnp.cos(q))


def batch(tree: Any) -> Any:
    """Two of it."""
    return jax.tree.map(lambda leaf: jnp.stack([leaf, leaf * 0.9]), tree)


@functools.cache
def attitudes() -> rj.Attitude:
    """Two of them, to be given to `batch`."""
    return rj.Attitude(np.stack([Q, P]), np.stack([W, V]))


@functools.cache
def motion() -> Any:
    """A free motion at 21 times."""
    return rj.simulate(inertia(), attitude(), np.linspace(0.0, 6.0, 21))


@functools.cache
def recording() -> rj.identify.Recording:
    """That motion as a gyroscope reads it, with a little noise."""
    noise = 0.01 * np.random.default_rng(0).standard_normal((21, 3))
    return rj.identify.Recording(
        np.asarray(motion().ts), (rj.identify.Gyro(0.01), np.asarray(motion().ys.omega) + noise)
    )


@functools.cache
def model() -> rj.identify.Model:
    return rj.identify.Model(recording(), rj.identify.PrincipalRatios())


@functools.cache
def found() -> rj.identify.Fit:
    return rj.identify.fit(model(), starts=1)


@functools.cache
def scene() -> Any:
    """A scene of work and precision, with a reference of its own."""
    from rigidjax.workprecision import BenchmarkScene
    from rigidjax.workprecision.scene import Reference

    end = tuple(float(x) for x in [*Q, *W])
    return BenchmarkScene(
        "mine", "a body slowed down", inertia(), attitude(), damping(), 1.0,
        reference=Reference(end, 1e-15, (), 0.0, "typed in"),
    )  # fmt: skip


@functools.cache
def records() -> tuple:
    from rigidjax.workprecision.record import Measurement

    return tuple(
        Measurement("s", name, "ours", "value", "", 10.0**-k, error=10.0**-k, time=float(k))
        for name in ("a", "b")
        for k in (3, 6, 9)
    )


class Kick(eqx.Module):
    """A force per mass, or a torque, from a schedule."""

    schedule: rj.torques.Held

    @property
    def jump_times(self):
        return self.schedule.jump_times

    def __call__(self, t, state, body=None):
        return self.schedule(t)
