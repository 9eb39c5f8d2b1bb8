"""The free numbers of a fit, the numbers of one recording among them, and their places."""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from rigidjax.identify.several_bodies import spread

if TYPE_CHECKING:
    from rigidjax.identify.free_parameters import Slot
    from rigidjax.identify.problem import Problem


class Own(eqx.Module):
    """The free numbers that belong to one recording, of order one.

    **Fields:** `place`, `speed` (3,) the initial position and velocity from the reference, in
    typical lengths and speeds, or `None` if nothing depends on them; `turn` (3,) the rotation
    vector from the reference attitude to the initial one (body frame, rad), or `None`; `spin` (3,)
    the initial body rate over the typical rate; `each` the steps of the `Free`s with one value for
    each recording, and the deviations of those with a `spread`.

    >>> import rigidjax as rj
    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> problem = rj.identify.Problem(record, rj.identify.PrincipalRatios())
    >>> plan = problem.start(rj.Inertia.from_principal(2.0, 2.0, 2.0), [0.0, 0.0, 3.0])
    >>> plan.own.spin.tolist(), plan.own.turn  # a gyro does not show the attitude
    ([[0.0, 0.0, 3.0]], None)
    """

    place: Float[Array, "*records 3"] | None
    speed: Float[Array, "*records 3"] | None
    turn: Float[Array, "*records 3"] | None
    spin: Float[Array, "*records 3"]
    each: tuple[Array, ...]


class Parameters(eqx.Module):
    """The free numbers of a fit, all unconstrained and of order one.

    **Fields:** `body` the chart's numbers, of several bodies one after another; `shared` the steps
    of the `Free`s with one value for all, or (groups, …) for one in each group; `own` the numbers
    of each recording, with a leading axis.

    >>> import rigidjax as rj
    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> problem = rj.identify.Problem(record, rj.identify.PrincipalRatios())
    >>> plan = problem.start(rj.Inertia.from_principal(2.0, 2.0, 2.0), [0.0, 0.0, 3.0])
    >>> plan.body.shape, plan.shared
    ((2,), ())
    """

    body: Float[Array, " chart"]
    shared: tuple[Array, ...]
    own: Own


class Unpacked(eqx.Module):
    """The quantities that the free numbers of a fit or a posterior density represent.

    **Fields:** `parameters` of the problem; `body`, of several bodies a dict by name, and `state0`,
    of several recordings with a leading axis, as `Problem.unpack` gives them; `values` of the
    `Free`s by name, in their units; `noise` (R, k) of each sensor, in its unit; `process` the
    random torque of a density or `None`.

    >>> import rigidjax as rj
    >>> ts = jnp.linspace(0.0, 10.0, 80)
    >>> motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    >>> record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), motion.ys.omega))
    >>> found = rj.identify.fit(rj.identify.Problem(record, rj.identify.PrincipalRatios()))
    >>> low, high = found.interval_of(lambda point: point.state0.omega)  # a function of `Unpacked`
    >>> bool((abs(high - low) < 0.03).all())
    True
    """

    parameters: Parameters
    body: Any
    state0: Any
    values: dict[str, Array]
    noise: tuple[Array, ...]
    process: Any = None


class Local(eqx.Module):
    """The free numbers that one recording depends on.

    **Fields:** `body` (K,) of its body, padded to the largest chart; `steps` one for each `Free`;
    `place`, `speed`, `turn`, `spin` as in `Own`.
    """

    body: Float[Array, "*records chart"]
    steps: tuple[Array, ...]
    place: Float[Array, "*records 3"] | None
    speed: Float[Array, "*records 3"] | None
    turn: Float[Array, "*records 3"] | None
    spin: Float[Array, "*records 3"]


def firsts(own: Own | Local) -> list[Any]:
    """The numbers of the initial state in use, in the order of a change of a state."""
    parts = (own.place, own.speed, own.turn, own.spin)
    return [part for part in parts if part is not None]


def local(problem: "Problem", parameters: Parameters) -> Local:
    """The numbers that each recording depends on, with a leading axis over recordings."""
    own, steps = parameters.own, []
    for slot, shared, each in by_slot(problem, parameters):
        if shared is None:
            steps.append(each)
            continue
        step = _of_each(slot, shared, problem.count)
        steps.append(step if each is None else step + each)
    body = spread(problem.body, parameters.body, problem.which, problem.count)
    return Local(body, tuple(steps), own.place, own.speed, own.turn, own.spin)


def by_slot(problem: "Problem", parameters: Parameters) -> list[tuple["Slot", Any, Any]]:
    """Each `Free` with its shared number and the recordings' own numbers; `None` if it has none."""
    of_all, of_each = iter(parameters.shared), iter(parameters.own.each)
    return [
        (
            slot,
            None if slot.each else next(of_all),
            next(of_each) if slot.each or slot.spread is not None else None,
        )
        for slot in problem.slots
    ]


def _of_each(slot: "Slot", shared: Array, count: int) -> Array:
    """A shared number repeated for each recording, (R, …)."""
    if slot.groups is not None:
        return shared[slot.groups]
    return jnp.broadcast_to(shared, (count, *shared.shape))


def columns(problem: "Problem", one: Local) -> np.ndarray:
    """The recording's number that belongs to each column of its block.

    All numbers in order; then again the numbers made of a shared value and a deviation.
    """
    counted = numbered(one)
    twice = [
        np.ravel(step)
        for slot, step in zip(problem.slots, counted.steps, strict=True)
        if slot.spread is not None
    ]
    size = sum(np.size(leaf) for leaf in jax.tree.leaves(one))
    return np.concatenate([np.arange(size), *twice]).astype(int)


def places(problem: "Problem", parameters: Parameters) -> Int[Array, "records columns"]:
    """Each column's place in the flattened parameters; n for a column of no number."""
    count, size = problem.count, ravel_pytree(parameters)[0].size
    counted = numbered(parameters)
    parts, deviations = [], []

    def rows(leaf: Any) -> Array:
        return jnp.asarray(leaf, jnp.int32).reshape(count, -1)

    for slot, shared, each in by_slot(problem, counted):
        if shared is None:
            parts.append(rows(each))
            continue
        parts.append(rows(_of_each(slot, jnp.asarray(shared, jnp.int32), count)))
        if each is not None:
            deviations.append(rows(each))
    first = [rows(leaf) for leaf in firsts(counted.own)]
    numbers = jnp.asarray(counted.body, jnp.int32)
    body = spread(problem.body, numbers, problem.which, count, fill=size)
    return jnp.concatenate([body, *parts, *first, *deviations], axis=1)


def numbered(tree: Any) -> Any:
    """The same tree with its numbers counted from zero in the order of `ravel_pytree`."""
    leaves, structure = jax.tree.flatten(tree)
    ends = np.cumsum([np.size(leaf) for leaf in leaves])
    counted = [
        np.arange(end - np.size(leaf), end).reshape(np.shape(leaf))
        for leaf, end in zip(leaves, ends, strict=True)
    ]
    return jax.tree.unflatten(structure, counted)
