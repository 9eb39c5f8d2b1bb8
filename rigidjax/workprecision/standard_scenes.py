"""Define the standard scenes of the comparison of methods."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from rigidjax import orbits
from rigidjax.body.inertia import Inertia
from rigidjax.frames import Point, scenes as places
from rigidjax.motion import Attitude
from rigidjax.motion.torques import Damping, Flywheel, GravityGradient, HeavyTop, Sum
from rigidjax.workprecision import equations
from rigidjax.workprecision.scene import BenchmarkScene, stored_answer

# μ, x0, v_y0 and the period of Arenstorf's orbit (Hairer, Nørsett and Wanner, Solving Ordinary
# Differential Equations I, II.0).
ARENSTORF = (0.012277471, 0.994, -2.00158510637908252240, 17.0652165601579625588917)
# The initial attitude of the bodies: the quaternion of a turn by 0.3 rad about x.
TILTED = np.array([np.cos(0.15), np.sin(0.15), 0.0, 0.0])
WEIGHT = (0.0, 0.0, -2.0)
# The distance of the planet in the scene `gravity-gradient`.
RADIUS = 7.0

# Bodies: title, principal moments, Ω0, end, equations, and their constants.
BODIES: dict[str, tuple[str, Any, Any, float, Any, Any]] = {
    "free-top": ("free asymmetric top", (1.0, 2.0, 3.0), (1.0, 0.7, 0.4), 100.0, None, ()),
    "middle-axis": (
        "free top about its middle axis", (1.0, 2.0, 3.0), (0.0, 1.0, 1e-3), 50.0, None, (),
    ),
    "heavy-top": (
        "heavy symmetric top", (1.0, 1.0, 0.7), (0.3, 0.2, 5.0), 50.0,
        equations.heavy_top_torque, (0.0, 0.0, 0.5, *WEIGHT),
    ),
    "asymmetric-top": (
        "heavy asymmetric top", (1.0, 1.3, 0.8), (0.3, 0.2, 5.0), 50.0,
        equations.heavy_top_torque, (0.1, 0.05, 0.5, *WEIGHT),
    ),
    "gravity-gradient": (
        "gravity gradient on a circular orbit", (1.0, 1.3, 0.7), (0.1, 0.2, 0.7), 100.0,
        equations.gravity_gradient_torque, (0.1,),
    ),
    "damped-gyrostat": (
        "damped gyrostat", (1.0, 1.3, 0.7), (1.0, 0.5, 2.0), 50.0,
        equations.gyrostat_torque, (0.0, 0.3, 0.1, 0.01, 0.02, 0.01),
    ),
    **{
        f"spinning-top-1e{power}": (
            f"top spun at {10.0**power:g} rad/s", (1.0, 1.0, 0.7), (0.0, 0.0, 10.0**power), 1.0,
            equations.heavy_top_torque, (0.0, 0.0, 0.5, *WEIGHT),
        )
        for power in (2, 3, 4)
    },
}  # fmt: skip


class Circle(eqx.Module):
    """Compute the position (3,) on a circular orbit in the xy-plane; `rate` is the angular rate,
    rad/s.
    """

    radius: Float[Array, ""]
    rate: Float[Array, ""]

    def __call__(self, t: Array) -> Float[Array, "3"]:
        angle = self.rate * t
        zero = jnp.zeros_like(angle)
        return self.radius * jnp.stack([jnp.cos(angle), jnp.sin(angle), zero])


def _return_unchanged(x: Any) -> Any:
    return x


def _torque_of_equation(kind: Callable[..., Any] | None, constants: Sequence[float]) -> Any:
    """Return the library's torque for an equation of `workprecision.equations`."""
    if kind is equations.heavy_top_torque:
        return HeavyTop(1.0, constants[:3], constants[3:])
    if kind is equations.gyrostat_torque:
        return Sum(Flywheel(constants[:3]), Damping(constants[3:]))
    if kind is equations.gravity_gradient_torque:
        (rate,) = constants
        circle = Circle(jnp.asarray(RADIUS), jnp.asarray(rate))
        return GravityGradient(rate**2 * RADIUS**3, circle)
    return None


def _body_scene(
    name: str,
    title: str,
    moments: Sequence[float],
    omega: Sequence[float],
    end: float,
    kind: Callable[..., Any] | None,
    constants: Sequence[float],
) -> BenchmarkScene:
    def plain(
        numbers: Sequence[Any],
        sin: Callable[..., Any],
        cos: Callable[..., Any],
        sqrt: Callable[..., Any],
        wrap: Callable[..., Any] = _return_unchanged,
        number: Callable[..., Any] = _return_unchanged,
    ) -> Any:
        exact = tuple(number(c) for c in constants)
        torque = None
        if kind is not None:
            torque = wrap(kind(numbers[:6], exact, sin, cos, wrap(equations.to_body_axes)))
        return wrap(equations.body_rates(numbers[:6], torque))

    # MuJoCo can do scenes without torque, and scenes whose only torque is that of weight.
    com, gravity = (
        (constants[:3], constants[3:]) if kind is equations.heavy_top_torque else ((0.0,) * 3,) * 2
    )
    weighs = kind in (None, equations.heavy_top_torque)
    return BenchmarkScene(
        name, title, Inertia.from_principal(*moments), Attitude(TILTED, omega),
        _torque_of_equation(kind, constants), end, plain, stored_answer(name), slow=omega[2] > 1e3,
        notes={"mass": 1.0, "com": com, "gravity": gravity} if weighs else None,
    )  # fmt: skip


def _point_scene(
    name: str,
    title: str,
    start: Point,
    end: float,
    law: PyTree,
    kind: Callable[..., Any],
    constants: Sequence[float],
) -> BenchmarkScene:
    def plain(
        numbers: Sequence[Any],
        sin: Callable[..., Any],
        cos: Callable[..., Any],
        sqrt: Callable[..., Any],
        wrap: Callable[..., Any] = _return_unchanged,
        number: Callable[..., Any] = _return_unchanged,
    ) -> Any:
        return wrap(kind(tuple(number(c) for c in constants), sqrt))

    return BenchmarkScene(name, title, None, start, law, end, plain, stored_answer(name))


def _foucault() -> BenchmarkScene:
    """Return Foucault's pendulum, released at rest, for ten minutes."""
    law = places.foucault(0.85, 67.0)
    _, north, up = (float(w) for w in law.place.angular_velocity())
    return _point_scene(
        "foucault", "Foucault's pendulum", law.start(3.0, 0.0), 600.0, law,
        equations.foucault_rates, (float(law.place.gravity), north, up),
    )  # fmt: skip


def _arenstorf() -> BenchmarkScene:
    """Return Arenstorf's orbit about Earth and Moon, for one period."""
    mu, x, v, period = ARENSTORF
    return _point_scene(
        "arenstorf", "Arenstorf's orbit", Point([x, 0.0, 0.0], [0.0, v, 0.0]), period,
        orbits.cr3bp(mu), equations.three_body_rates, (mu,),
    )  # fmt: skip


def scenes() -> dict[str, Callable[[], BenchmarkScene]]:
    """Return the standard scenes: name → a function that makes the scene (in the default precision
    of JAX).

    The drift over a million steps is no standard scene: `python -m rigidjax workprecision
    long-drift` measures this drift.

    >>> sorted(scenes())[:3]
    ['arenstorf', 'asymmetric-top', 'damped-gyrostat']
    """
    bodies = {name: functools.partial(_body_scene, name, *row) for name, row in BODIES.items()}
    return {**bodies, "foucault": _foucault, "arenstorf": _arenstorf}
