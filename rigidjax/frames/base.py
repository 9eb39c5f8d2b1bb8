"""Define the base class of scenes of a particle: a vector field, and conserved quantities."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks, _show
from rigidjax._types import NumbersLike, Scalar, ScalarLike, Vec3
from rigidjax.frames.point import Point


class AbstractScene(eqx.Module):
    """Define the equations of motion of a particle, whose state is a `Point` (position and
    velocity): a subclass has the methods `acceleration` and `conserved`.

    `rigidjax.simulate(None, Point(x, v), ts, scene)` solves a scene; `diffrax.ODETerm(scene.field)`
    is the term of the scene in plain diffrax.

    A scene that ends a run early, for example at a collision, has two more methods: `ends(t,
    state)`, which is true where the run must end, and `end_words(t, state)`, a text with the
    reason. Under `jit` JAX traces the state, so that the text cannot contain numbers of the state.
    The `stats` of the solution then have the entries `ended`, `end_time` and `end_state`. Only
    scenes of a particle can end a run in this way.

    >>> class Spring(AbstractScene):
    ...     def acceleration(self, t, state):
    ...         return -state.x
    ...     def conserved(self, t, state):
    ...         return {"energy": 0.5 * (state.x @ state.x + state.v @ state.v)}
    >>> float(Spring().conserved(0.0, Point([1.0, 0, 0], [0.0, 2, 0]))["energy"])
    2.5
    """

    __repr__ = _show.fields_as_text

    @abc.abstractmethod
    def acceleration(self, t: ScalarLike, state: PyTree) -> Vec3:
        """Return the acceleration d²x/dt² (3,), m/s², of the particle with the position and
        velocity in `state`, at the time `t`, s, in the frame of this scene (notes, eq 84).
        """

    @abc.abstractmethod
    def conserved(self, t: ScalarLike, state: PyTree) -> dict[str, Scalar]:
        """Return, by name, the values of the quantities that the exact motion in this scene
        conserves, at the time `t`, s, and the state `state`; an empty `dict` if no such quantity is
        known.
        """

    def field(self, t: ScalarLike, y: PyTree, args: object = None) -> Point:
        """Return the derivatives (dx/dt, dv/dt) of the position and velocity in the state `y`, as a
        `Point`: the vector field of this scene for `diffrax.ODETerm`. The argument `args` is not
        used.
        """
        return Point(y.v, self.acceleration(t, y))

    def drift(self, ts: Float[Array, " times"], ys: PyTree) -> dict[str, Scalar]:
        """Return, by name, the largest absolute change of each conserved quantity from its value at
        `ts[0]`.

        **Arguments:** `ts` (T,) times, s; `ys` the states at these times, with a leading axis T.

        >>> still = Point(jnp.zeros((2, 3)), jnp.zeros((2, 3)))
        >>> float(rj.scenes.earth(0.8).drift(jnp.arange(2.0), still)["jacobi"])
        0.0
        """
        values = jax.vmap(self.conserved)(ts, ys)
        return {name: jnp.max(jnp.abs(q - q[0])) for name, q in values.items()}


class Force(AbstractScene):
    """Define the scene of a particle in an inertial frame under a force per mass that you give
    (notes, eq 84).

    **Arguments:** `force` a function, or a Module with `__call__`, `(t, state, body) → (3,)`, m/s²,
    which gets `None` as its `body`; or `None` for a free particle.

    >>> fall = Force(lambda t, state, body: jnp.array([0.0, 0.0, -9.8]))
    >>> fall.field(0.0, Point([0.0, 0, 0], [1.0, 0, 0])).v.tolist()
    [0.0, 0.0, -9.8]
    """

    force: Callable[..., Any] | None

    def __check_init__(self) -> None:
        if self.force is not None:
            _checks.require_function(self.force, "force", "(t, state, body) → (3,) per mass")

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Return the times, s, at which the force on the particle jumps or has a kink: the
        attribute `jump_times` of the field `force`.
        """
        return jump_times_within(self.force)

    def acceleration(self, t: ScalarLike, state: PyTree) -> Vec3:
        if self.force is None:
            return jnp.zeros_like(state.x)
        with _checks.explain_tracing("force", self.force):
            value = self.force(t, state, None)
        return force_per_mass(value, self.force)

    def conserved(self, t: ScalarLike, state: PyTree) -> dict[str, Scalar]:
        return {}


def force_per_mass(value: NumbersLike, force: object) -> Vec3:
    """Return the value of the user's function `force` after a check of its shape."""
    name = getattr(force, "__name__", type(force).__name__)
    return _checks.array_of_shape(value, (3,), f"force {name}", hint="force per mass, m/s²")


def jump_times_within(*laws: object) -> Float[Array, " n"]:
    """Return the times, s, at which any of the `laws` (forces, torques, functions of time) jumps or
    has a kink, in no particular order.

    A scene or torque with other laws inside declares their jump times, too: the solver reads only
    the `jump_times` of the outermost one.
    """
    jumps = (getattr(law, "jump_times", None) for law in laws)
    times = [jnp.asarray(times, float) for times in jumps if times is not None]
    return jnp.concatenate([jnp.zeros(0), *times])


def cast_like(x: Array, *values: Array) -> tuple[Array, ...]:
    """Return constants of a scene in the dtype of the state x: float32 then stays float32."""
    return tuple(value.astype(x.dtype) for value in values)
