"""The standard scenes."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import orbits
from rigidjax.body.inertia import Inertia
from rigidjax.frames import Point, scenes as places
from rigidjax.motion import Attitude
from rigidjax.motion.torques import Damping, Flywheel, GravityGradient, HeavyTop, Sum
from rigidjax.workprecision import equations
from rigidjax.workprecision.reference import stored
from rigidjax.workprecision.scene import Scene

# Hairer, Nørsett and Wanner, Solving Ordinary Differential Equations I, II.0.
ARENSTORF = (0.012277471, 0.994, -2.00158510637908252240, 17.0652165601579625588917)
TILT = (0.3, 0.0, 0.0)
WEIGHT = 2.0


class Circle(eqx.Module):
    """A place on a circular orbit in the plane x, y, at an angular rate, rad/s."""

    radius: Float[Array, ""]
    rate: Float[Array, ""]

    def __call__(self, t: Any) -> Float[Array, "3"]:
        angle = self.rate * t
        zero = jnp.zeros_like(angle)
        return self.radius * jnp.stack([jnp.cos(angle), jnp.sin(angle), zero])


def _same(x: Any) -> Any:
    return x


def _turned(vector: Any) -> np.ndarray:
    """The unit quaternion exp(v), by NumPy alone."""
    angle = np.linalg.norm(vector)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * np.asarray(vector) / angle])


def _body(
    name: str,
    title: str,
    moments: Any,
    omega: Any,
    end: float,
    law: Any = None,
    kind: Any = equations.free,
    constants: Any = (),
    **more: Any,
) -> Scene:
    def plain(
        numbers: Any, sin: Any, cos: Any, sqrt: Any, wrap: Any = _same, number: Any = _same
    ) -> Any:
        exact = tuple(number(c) for c in constants)
        torque = kind(numbers[:6], exact, sin, cos, wrap(equations.into_body))
        return wrap(equations.body_rates(numbers[:6], None if torque is None else wrap(torque)))

    return Scene(
        name, title, Inertia.from_principal(*moments), Attitude(_turned(TILT), omega), law, end,
        plain, stored(name), **more,
    )  # fmt: skip


def _point(name: str, title: str, x: Any, v: Any, end: float, law: Any, kind: Any,
           constants: Any) -> Scene:  # fmt: skip
    def plain(
        numbers: Any, sin: Any, cos: Any, sqrt: Any, wrap: Any = _same, number: Any = _same
    ) -> Any:
        return wrap(kind(tuple(number(c) for c in constants), sqrt))

    return Scene(name, title, None, Point(x, v), law, end, plain, stored(name))


def _top(
    name: str, title: str, moments: Any, com: Any, omega: Any, end: float, **more: Any
) -> Scene:
    pull = (0.0, 0.0, -WEIGHT)
    return _body(
        name, title, moments, omega, end, HeavyTop(1.0, com, pull), equations.heavy, (*com, *pull),
        notes={"mass": 1.0, "com": com, "gravity": pull}, **more,
    )  # fmt: skip


def free_top() -> Scene:
    """A free body with three different moments."""
    return _body(
        "free-top", "free asymmetric top", (1.0, 2.0, 3.0), (1.0, 0.7, 0.4), 100.0,
        notes={"mass": 1.0, "com": (0.0, 0.0, 0.0), "gravity": (0.0, 0.0, 0.0)},
    )  # fmt: skip


def middle_axis() -> Scene:
    """The same body set spinning about its middle axis, a little off: it flips."""
    return _body(
        "middle-axis", "free top about its middle axis", (1.0, 2.0, 3.0), (0.0, 1.0, 1e-3), 50.0,
        notes={"mass": 1.0, "com": (0.0, 0.0, 0.0), "gravity": (0.0, 0.0, 0.0)},
    )  # fmt: skip


def heavy_top() -> Scene:
    """Lagrange's top: two equal moments, the centre of mass on the third axis."""
    return _top(
        "heavy-top", "heavy symmetric top", (1.0, 1.0, 0.7), (0.0, 0.0, 0.5), (0.3, 0.2, 5.0), 50.0
    )


def asymmetric_top() -> Scene:
    """A heavy top with three moments and its centre of mass off every axis."""
    return _top(
        "asymmetric-top", "heavy asymmetric top", (1.0, 1.3, 0.8), (0.1, 0.05, 0.5),
        (0.3, 0.2, 5.0), 50.0,
    )  # fmt: skip


def gravity_gradient() -> Scene:
    """A satellite on a circular orbit, turned by the gradient of gravity."""
    rate, radius = 0.1, 7.0
    law = GravityGradient(rate**2 * radius**3, Circle(jnp.asarray(radius), jnp.asarray(rate)))
    return _body(
        "gravity-gradient", "gravity gradient on a circular orbit", (1.0, 1.3, 0.7),
        (0.1, 0.2, 0.7), 100.0, law, equations.gradient, (rate,),
    )  # fmt: skip


def damped_gyrostat() -> Scene:
    """A body with a wheel inside, slowed by damping."""
    wheel, drag = (0.0, 0.3, 0.1), (0.01, 0.02, 0.01)
    return _body(
        "damped-gyrostat", "damped gyrostat", (1.0, 1.3, 0.7), (1.0, 0.5, 2.0), 50.0,
        Sum(Flywheel(wheel), Damping(drag)), equations.gyrostat, (*wheel, *drag),
    )  # fmt: skip


def foucault() -> Scene:
    """Foucault's pendulum, let go at rest, for ten minutes."""
    law = places.foucault(0.85, 67.0)
    start, place = law.start(3.0, 0.0), law.place
    _, north, up = (float(w) for w in place.angular_velocity())
    return _point(
        "foucault", "Foucault's pendulum", start.x, start.v, 600.0, law, equations.foucault,
        (float(place.gravity), north, up),
    )  # fmt: skip


def arenstorf() -> Scene:
    """Arenstorf's orbit about Earth and Moon, once round."""
    mu, x, v, period = ARENSTORF
    return _point(
        "arenstorf", "Arenstorf's orbit", [x, 0.0, 0.0], [0.0, v, 0.0], period, orbits.cr3bp(mu),
        equations.three_body, (mu,),
    )  # fmt: skip


def spinning_top(speed: float) -> Scene:
    """A symmetric top spun up to `speed`, rad/s, for a second."""
    return _top(
        f"spinning-top-{speed:.0e}".replace("e+0", "e"), f"top spun at {speed:g} rad/s",
        (1.0, 1.0, 0.7), (0.0, 0.0, 0.5), (0.0, 0.0, speed), 1.0, slow=speed > 1e3,
    )  # fmt: skip


@functools.cache
def _makers() -> dict[str, Callable[[], Scene]]:
    plain = (
        free_top, middle_axis, heavy_top, asymmetric_top, gravity_gradient, damped_gyrostat,
        foucault, arenstorf,
    )  # fmt: skip
    made = {maker.__name__.replace("_", "-"): maker for maker in plain}
    for speed in (1e2, 1e3, 1e4):
        made[f"spinning-top-1e{round(np.log10(speed))}"] = functools.partial(spinning_top, speed)
    return made


def scenes() -> dict[str, Callable[[], Scene]]:
    """The standard scenes: name → a function that makes it (in the default precision of JAX).

    The drift over a million steps is apart: `rigidjax.workprecision.long_drift`.

    >>> sorted(scenes())[:3]
    ['arenstorf', 'asymmetric-top', 'damped-gyrostat']
    """
    return dict(_makers())
