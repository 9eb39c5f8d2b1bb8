"""Name inputs of a torque, which are set in a loop or as functions of time; delay and lag functions
of time.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks, _show
from rigidjax._types import NumbersLike, ScalarLike
from rigidjax.body.inertia import Body
from rigidjax.motion.torques.base import jump_times_of
from rigidjax.motion.torques.piecewise import Held
from rigidjax.motion.torques.states import contains_own_states

Law = TypeVar("Law")


class Input(eqx.Module):
    """Name an input of a torque, a signal whose values are given when a motion is computed, such as
    by `rigidjax.batch.rollout(…, inputs=…)`.

    **Arguments:** `name` the name under which `inputs` holds the values of this input. A torque
    calls the input with the time; `bind` replaces the input by its values.

    >>> law = bind(Input("speed"), {"speed": jnp.array([3.0])})
    >>> law(0.0)
    Array([3.], dtype=float64)
    """

    name: str = eqx.field(static=True)

    __repr__ = _show.fields_as_text

    def __call__(self, t: ScalarLike) -> Any:
        """Raise `ValueError`: an input has no value until `bind` puts a value or a function of time
        in its place.
        """
        raise ValueError(
            f"Input({self.name!r}) has no value: give inputs={{{self.name!r}: …}} to "
            "rigidjax.batch.rollout, or put a function of time in its place with "
            "rigidjax.torques.bind"
        )


class _Constant(eqx.Module):
    """Return one value at every time, in the place of an `Input` during a step."""

    value: Array

    __repr__ = _show.fields_as_text

    def __call__(self, t: ScalarLike) -> Array:
        return self.value


class Delayed(eqx.Module):
    """Delay a function of time: `t → source(t − delay)`.

    **Arguments:** `source` a function of time such as `Held(times, values)` (samples, each of which
    holds until the next), or `Input("u")` (a signal whose values are given when a motion is
    computed); `delay` s, one number, which may be free in a fit; a negative delay shifts the
    function to earlier times.

    The times at which the source jumps (its attribute `jump_times`) move with the delay. `simulate`
    ends steps at these times, so that the derivative of a motion with respect to the delay is
    correct although the source jumps. `rigidjax.batch.rollout` and `identify.fit` hold each sample
    of an input constant over one step. A delayed input changes inside a step: the step is therefore
    split in two at the change, and the derivative with respect to the delay is correct as well. The
    first sample also holds before its own time, and the last sample after its own time. `Linear`
    and `Series` can be delayed, too.

    **Raises:** `TypeError` for a source that has states of its own (delay the input of the source
    instead, as in `Lagged(Delayed(u, delay), time)`); `ValueError` for a delay that is not shorter
    than the record of the source.

    >>> float(Delayed(rj.torques.Held([0.0, 1.0, 2.0], [5.0, 6.0, 7.0]), 0.7)(1.5))
    5.0
    """

    source: Any
    delay: Float[Array, ""]

    __repr__ = _show.fields_as_text

    def __init__(self, source: object, delay: ScalarLike):
        source = _checks.require_function(source, "source", "of time")
        if contains_own_states(source):
            words = "wanted a source without states of its own, whose past values are not kept, got"
            advice = "delay its input: Lagged(Delayed(source, delay), time)"
            raise TypeError(f"Delayed: {words} {type(source).__name__}; {advice}")
        self.delay = _checks.finite_array(delay, (), "delay").astype(jnp.result_type(float))
        if isinstance(source, Delayed):
            source, self.delay = source.source, self.delay + source.delay
        if not isinstance(source, Input) and input_names_of(source):
            words = f"wanted a source that reads no Input, got {type(source).__name__}"
            raise TypeError(f"Delayed: {words}; delay the Input itself, inside the source")
        self.source = source
        times = getattr(source, "times", None)
        if times is not None and _checks.is_known((times, self.delay)):
            length = float(times[-1] - times[0])
            if abs(float(self.delay)) >= length:
                words = f"wanted less than the {length:.6g} s of the record of the source"
                raise ValueError(f"delay: {words}, got {float(self.delay):.6g}; is it in seconds?")

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Return the times (n,), s, at which this delayed function jumps or has a kink: each such
        time of its source, plus the delay.
        """
        times = jump_times_of(self.source)
        return times + self.delay.astype(times.dtype)

    def __call__(self, t: ScalarLike) -> Any:
        return self.source(t - self.delay.astype(jnp.result_type(t)))


class Lagged(eqx.Module):
    """Return a signal y that follows a function of time u with a lag of first order, as a motor
    does: `T dy/dt = u(t) − y`.

    y is a state of its own, which is integrated with the state of the body (see `AbstractTorque`).
    A `Lagged` can replace any function of time inside a torque: `Rotors(…,
    speeds=Lagged(Input("speeds"), 0.05))`.

    **Arguments:**

    - `source`: u, a function of time such as `Held(times, values)` (samples, each of which holds
      until the next), or `Input("u")` (a signal whose values are given when a motion is computed).
    - `time`: the time constant T, s, > 0, one number or one for each channel of u; it may be free
      in a fit.
    - `start`: the value of y at the start of the motion, or `None` for the value of u at the start.

    If u jumps from 0 to 1 at t = 0, y is `1 − exp(−t/T)` (Åström and Murray, Feedback Systems).
    **Raises:** `ValueError` for a `time` that is not positive, unless JAX traces this number.

    >>> push = rj.torques.InSpace(Lagged(lambda t: jnp.array([0.0, 0.0, 1.0]), 0.5, jnp.zeros(3)))
    >>> body, start = rj.Inertia(jnp.eye(3)), rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 0])
    >>> rj.simulate(body, start, [0.0, 0.5], push).own[0][-1, 2]  # 1 − 1/e
    Array(0.63212056, dtype=float64)
    """

    source: Any
    time: Float[Array, "*k"]
    start: Array | None

    __repr__ = _show.fields_as_text

    def __init__(self, source: object, time: NumbersLike, start: NumbersLike | None = None):
        self.source = _checks.require_function(source, "source", "of time")
        dtype = jnp.result_type(float)
        time = _checks.check_if_known(
            _checks.require_positive,
            _numbers(time, "time"),
            "time",
            "a positive time, s",
        )
        self.time = time.astype(dtype)
        self.start = None if start is None else _numbers(start, "start").astype(dtype)

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Return the times (n,), s, at which the lagged signal has a kink, because its source jumps
        or has a kink.
        """
        return jump_times_of(self.source)

    def state0(self, t: ScalarLike, state: PyTree, body: Body) -> Array:
        """Return the initial value of the lagged signal y, which is the state of this object: the
        field `start`, or the value of the source at the time `t`, s, if `start` is `None`.
        """
        return self.source(t) if self.start is None else self.start

    def rate(self, t: ScalarLike, own: Array, state: PyTree, body: Body) -> Array:
        """Return dy/dt = (u − y)/T, the derivative of the lagged signal y = `own` with respect to
        time, at the time `t`, s, in the unit of u per second.

        Here u is the value of the source, and T the time constant; `state` and `body` are not used.
        """
        wanted = _checks.numeric_array(self.source(t), "source(t)").astype(own.dtype)
        if wanted.shape != own.shape:
            words = f"start has the shape {own.shape}, values of the source have {wanted.shape}"
            raise ValueError(f"Lagged: wanted one shape for both, but {words}")
        return (wanted - own) / self.time

    def __call__(self, t: ScalarLike, own: Array) -> Array:
        return own


def require_no_jumps(source: PyTree, name: str) -> None:
    """Raise `TypeError` if a function of time, or one in a pytree, holds samples constant: a torque
    that uses its derivative would lose the jumps.

    An `Input` is checked only when it has a value, because `bind` may give it a smooth function of
    time.
    """
    jumping = (Held, _Constant)
    nodes = jax.tree.leaves(source, is_leaf=lambda node: isinstance(node, jumping))
    for node in nodes:
        if isinstance(node, jumping):
            what = "Held" if isinstance(node, Held) else "an Input with held samples"
            raise TypeError(
                f"{name}: wanted a function of time without jumps, since its derivative acts on "
                f"the body, got {what}; take Linear(times, values) or Series(times, values)"
            )


def _numbers(value: NumbersLike, name: str) -> Array:
    """Return one number, or one for each channel of a signal; raise `ValueError` for none, and for
    known numbers that are not finite.
    """
    array = _checks.numeric_array(value, name)
    if not array.size:
        raise ValueError(f"{name}: wanted one number, or one for each channel, got none")
    return _checks.check_if_known(_checks.require_finite, array, name)


class InputRow(NamedTuple):
    """Hold the values of all inputs of a torque during one step, or the part of a step up to where
    a delayed input changes.
    """

    values: Mapping[str, Any]
    # The value of each delayed input, in the order of these inputs in the torque.
    delayed: tuple[Any, ...]


def bind(law: Law, inputs: Mapping[str, Any] | InputRow | None) -> Law:
    """Return the torque with values in place of each `Input`, which is a signal that a torque reads
    by name.

    **Arguments:**

    - `law`: a torque, a force, or a tree of them.
    - `inputs`: the value for each name of an `Input`: an array, which holds at all times, or a
      function of time such as `Held(times, values)`; `None` changes nothing.

    **Raises:** `ValueError` if the torque reads an input that has no value in `inputs`.

    >>> bind(Input("u"), {"u": rj.torques.Held([0.0, 1.0], [2.0, 4.0])})(1.0)
    Array(4., dtype=float64)
    """
    if inputs is None:
        return law

    values, later = inputs if isinstance(inputs, InputRow) else (inputs, None)
    queue = list(later or ())

    def with_value(node: PyTree) -> Any:
        if _is_delayed(node):
            if later is not None:
                return _Constant(jnp.asarray(queue.pop(0)))
            bound = with_value(node.source)
            return bound if isinstance(bound, _Constant) else Delayed(bound, node.delay)
        if not isinstance(node, Input):
            return node
        if node.name not in values:
            names = ", ".join(map(repr, values)) or "none"
            raise ValueError(f"inputs: the torque reads {node.name!r}, got {names}")
        bound = values[node.name]
        return bound if callable(bound) else _Constant(jnp.asarray(bound))

    return jax.tree.map(with_value, law, is_leaf=lambda n: isinstance(n, Input) or _is_delayed(n))


def _is_delayed(node: PyTree) -> bool:
    """Return whether `node` is a `Delayed` whose source is an `Input`."""
    return isinstance(node, Delayed) and isinstance(node.source, Input)


def delays_of(torque: PyTree) -> list[tuple[str, Array]]:
    """Return name and delay, s, of each delayed input of `torque`, in their order there."""
    nodes = jax.tree.leaves(torque, is_leaf=_is_delayed)
    return [(node.source.name, node.delay) for node in nodes if _is_delayed(node)]


def input_names_of(torque: PyTree) -> list[str]:
    """Return the names of the inputs that `torque` reads, each name once."""
    nodes = jax.tree.leaves(torque, is_leaf=lambda node: isinstance(node, Input))
    return list(dict.fromkeys(node.name for node in nodes if isinstance(node, Input)))


def require_inputs(torque: PyTree, inputs: object) -> Mapping[str, Any]:
    """Return inputs by name; raise `ValueError` unless `torque` reads exactly these."""
    read, mapping = input_names_of(torque), {} if inputs is None else inputs
    if not isinstance(mapping, Mapping):
        raise TypeError(
            "inputs: wanted a mapping from names to arrays, such as {'u': array}, got "
            f"{type(mapping).__name__}"
        )
    if set(read) != set(mapping):
        raise ValueError(
            f"inputs: the torque reads {', '.join(map(repr, read)) or 'none'}, got "
            f"{', '.join(map(repr, mapping)) or 'none'}"
        )
    return mapping
