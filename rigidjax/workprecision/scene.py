"""Define a scene with its reference, and a method that is prepared for it and run."""

import functools
import json
from collections.abc import Callable, Sequence
from importlib import resources
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from rigidjax import _checks
from rigidjax.body import validation
from rigidjax.body.inertia import Inertia
from rigidjax.body.symmetric3 import PAIRS, from_components
from rigidjax.frames import Point
from rigidjax.motion import Attitude
from rigidjax.rotation import quaternion

# A, B and C are the vectors a, b and c in the scalar a·R b + c·Ω/|Ω0|, whose gradient is compared.
# Here R is the attitude and Ω the body rate at the end, and Ω0 is the body rate at the beginning.
# The three directions are generic.
A, B, C = (0.6, -0.48, 0.64), (0.36, 0.8, -0.48), (0.28, -0.5, 0.82)


class Reference(NamedTuple):
    """Hold the correct last state of a scene (a motion to run), and the correct gradient of the
    scalar function `loss` of this state.

    **Fields:** `end` the last state as one tuple; `error` the estimated error of its entries;
    `gradient` the gradient of the scalar with respect to the scene's `numbers`, or empty;
    `gradient_error` the estimated error of the entries of the gradient; `source` a sentence about
    the method by which both were computed.

    >>> top = stored_reference("heavy top")
    >>> top is None or top.error < 1e-12
    True
    """

    end: tuple[float, ...]
    error: float
    gradient: tuple[float, ...]
    gradient_error: float
    source: str


@functools.cache
def stored_reference(name: str) -> Reference | None:
    """Return the stored reference of the standard scene of this name, or `None` if there is none.

    The stored references are made by `tests/workprecision/make_references.py` at 40 digits and
    rounded to float64.
    """
    file = resources.files("rigidjax.workprecision").joinpath("references.json")
    row = json.loads(file.read_text()).get(name)
    if row is None:
        return None
    end, slope = (tuple(map(float, row[key])) for key in ("end", "gradient"))
    return Reference(end, float(row["error"]), slope, float(row["gradient_error"]), row["source"])


class BenchmarkScene(eqx.Module):
    """Define one motion for the comparison of methods.

    **Fields:** `name`, and `title` in words; `body` an `Inertia`, or `None` for a point; `state0`
    the initial state, an `Attitude` (of a body) or a `Point` (position and velocity); `torque` as
    for `rigidjax.simulate`; `end` the last time, s (the first is 0); `plain` the equations of the
    scene without JAX, a function `plain(numbers, sin, cos, sqrt) → f(t, y)`, for other packages and
    references, or `None` to leave other packages out; `reference` the correct last state and
    gradient, or `None` to compute them by our own method with small steps; `slow` true to leave the
    scene out unless it is named; `notes` data that MuJoCo needs beyond the equations.

    >>> from rigidjax import Attitude, Inertia, torques
    >>> scene = BenchmarkScene("mine", "my body", Inertia(jnp.eye(3)),
    ...     Attitude([1.0, 0, 0, 0], [0.0, 0, 1]), torques.Damping([0.1, 0.1, 0.1]), 5.0)
    >>> scene.numbers.shape
    (13,)
    """

    name: str = eqx.field(static=True)
    title: str = eqx.field(static=True)
    body: Inertia | None
    state0: Attitude | Point
    torque: Any
    end: float = eqx.field(static=True)
    plain: Callable[..., Any] | None = eqx.field(static=True, default=None)
    reference: Reference | None = eqx.field(static=True, default=None)
    slow: bool = eqx.field(static=True, default=False)
    notes: dict[str, Any] | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        if isinstance(self.state0, Point) == (self.body is not None):
            raise TypeError(
                "BenchmarkScene: wanted an Inertia with an Attitude, or None with a Point, got "
                f"{type(self.body).__name__} with {type(self.state0).__name__}"
            )
        hint = "errors are angles between attitudes, or distances"
        wanted = "an Attitude or a Point"
        _checks.require_instance(
            self.state0, (Attitude, Point), "state0", requirement=wanted, hint=hint
        )
        if self.body is not None:
            validation.require_single_body(self.body, Inertia, "body", hint="or None with a Point")
        _checks.positive_float(self.end, "end", "an end > 0, s")

    @property
    def numbers(self) -> Float[Array, " parameters"]:
        """Return the numbers of this scene with respect to which gradients are taken, as one array.

        For a body they are the entries Ixx, Iyy, Izz, Ixy, Ixz, Iyz of the inertia tensor, the
        initial body rate, and the quaternion of the initial attitude (13,). For a point they are
        the initial position and velocity (6,).
        """
        if self.body is None:
            return jnp.concatenate([self.state0.x, self.state0.v])  # pyright: ignore
        entries = jnp.stack([self.body.tensor[at] for at in PAIRS])
        state: Any = self.state0
        return jnp.concatenate([entries, state.omega, state.q])

    @property
    def blocks(self) -> dict[str, slice]:
        """Return where the array `numbers` of this scene has the inertia, the initial rate and the
        initial attitude: a dictionary of three slices.

        The keys are the fields of a `Measurement` that hold the error of a gradient with respect to
        these numbers. For a point there are two slices, of position and velocity.
        """
        if self.body is None:
            return {"by_attitude": slice(0, 3), "by_rate": slice(3, 6)}
        return {"by_inertia": slice(0, 6), "by_rate": slice(6, 9), "by_attitude": slice(9, 13)}

    def assemble(
        self, numbers: Float[Array, " parameters"]
    ) -> tuple[Inertia | None, Attitude | Point]:
        """Return the body and the initial state that an array like the property `numbers` of this
        scene describes; the body is `None` for a point.
        """
        if self.body is None:
            return None, Point(numbers[:3], numbers[3:])
        tensor = from_components(*(numbers[i] for i in range(6)))
        return Inertia(tensor), Attitude(quaternion.normalise(numbers[9:]), numbers[6:9])

    def flatten(self, state: PyTree) -> Float[Array, " state"]:
        """Return a state of this scene as one vector: (7,) for a body, whose state is an
        `Attitude`, or (6,) for a `Point`.
        """
        return jnp.concatenate(jax.tree.leaves(state))

    @property
    def size(self) -> tuple[float, float]:
        """Return the two scales by which errors in this scene are divided: 1 rad for the attitude;
        and for the body rate the length |Ω0| of the initial body rate.

        For a point they are the initial distance |x0| for the position, and for the velocity the
        initial speed |v0|, or |x0|/`end` if that is larger.
        """
        state: Any = self.state0
        if self.body is None:
            length = float(np.linalg.norm(state.x))
            return length, max(float(np.linalg.norm(state.v)), length / self.end)
        return 1.0, float(np.linalg.norm(state.omega))

    def loss(self, end: Float[Array, " state"]) -> Float[Array, ""]:
        """Return a scalar function of the last state `end` (one vector): the gradients of this
        function are compared between methods.

        For a body it is a·R b + c·Ω/|Ω0|, with three constant vectors a, b and c, the attitude R
        and body rate Ω at the end, and the initial body rate Ω0. For a point it is such a sum for
        position and velocity.
        """
        one, two = self.size
        a, b, c = (jnp.asarray(v, end.dtype) for v in (A, B, C))
        if self.body is None:
            return jnp.sum(a * end[:3]) / one + jnp.sum(c * end[3:]) / two
        return jnp.sum(a * quaternion.rotate(end[:4], b)) + jnp.sum(c * end[4:]) / two


def state_errors(
    scene: BenchmarkScene,
    final_state: ArrayLike | Sequence[float],
    reference: ArrayLike | Sequence[float],
) -> tuple[float, float]:
    """Return the error of the attitude, rad, and that of the body rate, divided by |Ω0|; of a point
    those of position and velocity, divided by `scene.size`.
    """
    final_state, reference = np.asarray(final_state, float), np.asarray(reference, float)
    one, two = scene.size
    if scene.body is None:
        first, second = final_state[:3] - reference[:3], final_state[3:] - reference[3:]
        return float(np.linalg.norm(first)) / one, float(np.linalg.norm(second)) / two
    if not np.isfinite(final_state).all():
        return float("nan"), float("nan")
    (a, *u), (b, *v) = final_state[:4] / np.linalg.norm(final_state[:4]), reference[:4]
    u, v = np.asarray(u), np.asarray(v)
    turn = a * v - b * u + np.cross(v, u)
    angle = 2 * float(np.arctan2(np.linalg.norm(turn), abs(a * b + u @ v)))
    return angle, float(np.linalg.norm(final_state[4:] - reference[4:])) / two


class PreparedMethod(NamedTuple):
    """Hold a method that is prepared (compiled) for one scene, a motion to run.

    **Fields:** `run` a function of the setting (a tolerance, a number of steps, or the length of a
    step) that returns, only when the computation is complete, the last state, or the gradient, as
    one vector, and the number of steps; `compile` the time of preparation, s, and
    `memory` the bytes of temporary arrays, both NaN if unknown.

    >>> prepared = PreparedMethod(lambda setting: ([0.0, 1.0], 1 / setting))
    >>> prepared.run(1e-2)[1], prepared.compile
    (100.0, nan)
    """

    run: Callable[[float], tuple[Any, Any]]
    compile: float = float("nan")
    memory: float = float("nan")


class TimedMethod(NamedTuple):
    """Define a method to compare; `measure` takes your own, or a peer's, in this form.

    **Fields:** `name`; `group` `ours`, `jax` (anything else that runs in JAX) or `peer`; `settings`
    tolerances, numbers of equal steps, or lengths of a step, from coarse to fine; `value` a
    function of a scene that returns a `PreparedMethod`, or `None` for a scene that the method
    cannot do; `gradients` has, by the name of the adjoint (the way in which a gradient is
    computed), functions like `value` for the gradient of the scene's scalar `loss` with respect to
    its `numbers`; `equal` whether the settings are numbers of equal steps for a motion in which the
    body turns by 50 rad: they are then scaled to the angle of the scene.

    >>> import numpy as np
    >>> prepared = PreparedMethod(lambda setting: (np.ones(7), 0))
    >>> guess = TimedMethod("a guess", "peer", (1e-3,), lambda scene: prepared)
    >>> guess.gradients
    {}
    """

    name: str
    group: str
    settings: Sequence[float | int]
    value: Callable[[BenchmarkScene], PreparedMethod | None]
    gradients: dict[str, Callable[[BenchmarkScene], PreparedMethod | None]] = {}  # noqa: RUF012
    equal: bool = False
