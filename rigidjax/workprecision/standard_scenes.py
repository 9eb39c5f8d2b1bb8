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
from rigidjax.workprecision.scene import BenchmarkScene, stored_reference

# μ, x0, v_y0 and the period of Arenstorf's orbit (Hairer, Nørsett and Wanner, Solving Ordinary
# Differential Equations I, II.0).
ARENSTORF = (0.012277471, 0.994, -2.00158510637908252240, 17.0652165601579625588917)
# The initial attitude of the bodies: the quaternion of a turn by 0.3 rad about x.
TILTED = np.array([np.cos(0.15), np.sin(0.15), 0.0, 0.0])
# The acceleration of gravity in the scenes of heavy tops, m/s², in world axes.
WEIGHT = (0.0, 0.0, -2.0)
# The distance of the planet in the scene `gravity-gradient`. The motion does not depend on this
# distance, because the mass of the planet is chosen so that a circular orbit at this distance has
# the orbital rate of the scene.
RADIUS = 7.0

# The scenes of bodies, by name. Each has a title, the principal moments in kg m², the initial body
# rate in rad/s, the last time in seconds, the handwritten torque (`None` for a free body), and the
# constants of this torque.
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
    """Compute the position on a circular orbit in the xy-plane, with the angular rate in rad/s."""

    radius: Float[Array, ""]
    rate: Float[Array, ""]

    def __call__(self, t: Array) -> Float[Array, "3"]:
        angle = self.rate * t
        zero = jnp.zeros_like(angle)
        return self.radius * jnp.stack([jnp.cos(angle), jnp.sin(angle), zero])


def _unchanged(x: Any) -> Any:
    """Return x; this stands for a conversion or a compilation that is not needed."""
    return x


def _scene_of_body(
    name: str,
    title: str,
    moments: Sequence[float],
    omega: Sequence[float],
    end: float,
    handwritten_torque: Callable[..., Any] | None,
    constants: Sequence[float],
) -> BenchmarkScene:
    """Return a standard scene of a rigid body, from a row of `BODIES`."""

    def plain(
        numbers: Sequence[Any],
        sin: Callable[..., Any],
        cos: Callable[..., Any],
        sqrt: Callable[..., Any],
        wrap: Callable[..., Any] = _unchanged,
        number: Callable[..., Any] = _unchanged,
    ) -> Any:
        exact = tuple(number(c) for c in constants)
        torque = None
        if handwritten_torque is not None:
            torque = wrap(
                handwritten_torque(numbers[:6], exact, sin, cos, wrap(equations.to_body_axes))
            )
        return wrap(equations.body_vector_field(numbers[:6], torque))

    # MuJoCo needs the mass, the centre of mass and gravity as data (`notes`); for a free body the
    # last two are zero. A scene with any other torque than weight gets no such data, because our
    # method for MuJoCo cannot do it.
    com, gravity, torque = (0.0,) * 3, (0.0,) * 3, None
    if handwritten_torque is equations.heavy_top_torque:
        com, gravity = constants[:3], constants[3:]
        torque = HeavyTop(1.0, com, gravity)
    elif handwritten_torque is equations.gyrostat_torque:
        torque = Sum(Flywheel(constants[:3]), Damping(constants[3:]))
    elif handwritten_torque is equations.gravity_gradient_torque:
        (rate,) = constants
        circle = Circle(jnp.asarray(RADIUS), jnp.asarray(rate))
        torque = GravityGradient(rate**2 * RADIUS**3, circle)
    weighs = handwritten_torque in (None, equations.heavy_top_torque)
    return BenchmarkScene(
        name, title, Inertia.from_principal(*moments), Attitude(TILTED, omega),
        torque, end, plain, stored_reference(name),
        slow=omega[2] > 1e3,
        notes={"mass": 1.0, "com": com, "gravity": gravity} if weighs else None,
    )  # fmt: skip


def _scene_of_point(
    name: str,
    title: str,
    start: Point,
    end: float,
    library_equations: PyTree,
    handwritten_equations: Callable[..., Any],
    constants: Sequence[float],
) -> BenchmarkScene:
    """Return a standard scene of a particle, with the equations of the library and the same in
    plain arithmetic.
    """

    def plain(
        numbers: Sequence[Any],
        sin: Callable[..., Any],
        cos: Callable[..., Any],
        sqrt: Callable[..., Any],
        wrap: Callable[..., Any] = _unchanged,
        number: Callable[..., Any] = _unchanged,
    ) -> Any:
        return wrap(handwritten_equations(tuple(number(c) for c in constants), sqrt))

    return BenchmarkScene(
        name, title, None, start, library_equations, end, plain, stored_reference(name)
    )


def _foucault_scene() -> BenchmarkScene:
    """Return the standard scene of Foucault's pendulum, released at rest and followed for ten
    minutes.
    """
    law = places.foucault(0.85, 67.0)
    _, north, up = (float(w) for w in law.place.angular_velocity())
    return _scene_of_point(
        "foucault", "Foucault's pendulum", law.start(3.0, 0.0), 600.0, law,
        equations.foucault_vector_field, (float(law.place.gravity), north, up),
    )  # fmt: skip


def _arenstorf_scene() -> BenchmarkScene:
    """Return the standard scene of Arenstorf's orbit about Earth and Moon, followed for one
    period.
    """
    mu, x, v, period = ARENSTORF
    return _scene_of_point(
        "arenstorf", "Arenstorf's orbit", Point([x, 0.0, 0.0], [0.0, v, 0.0]), period,
        orbits.cr3bp(mu), equations.three_body_vector_field, (mu,),
    )  # fmt: skip


def scenes() -> dict[str, Callable[[], BenchmarkScene]]:
    """Return the standard scenes: name → a function that makes the scene (in the default precision
    of JAX).

    The long run of a million steps, for the drift of the energy, is not among these scenes: it is
    run by `python -m rigidjax workprecision long-drift`.

    >>> sorted(scenes())[:3]
    ['arenstorf', 'asymmetric-top', 'damped-gyrostat']
    """
    bodies = {name: functools.partial(_scene_of_body, name, *row) for name, row in BODIES.items()}
    return {**bodies, "foucault": _foucault_scene, "arenstorf": _arenstorf_scene}
