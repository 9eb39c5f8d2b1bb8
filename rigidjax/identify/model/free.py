"""The free numbers of a fit, the numbers of one recording among them, and their places."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from rigidjax import _checks
from rigidjax.identify.data.recording import Recording
from rigidjax.identify.model.charts import spread

if TYPE_CHECKING:
    from rigidjax.identify.model.problem import Problem


class Free(eqx.Module):
    """A number or array inside the recordings' torque or sensors that the fit may move.

    **Arguments:** `where` picks it: `lambda r: r.readings[0].sensor.bias`, or
    `lambda r: r.torque.coefficient`; the starting value is the recording's value there. `name`
    for reports, `unit` too; `None` names that of a bias, a delay or a clock offset, a mounting or
    tilt, and a place. `scale` its natural size: a step of one in the fit is one `scale`, in its
    unit. `each`: `False` for one value for all recordings, `True` for one for each, `"body"` for
    one for each body, or a sequence of labels, one for each recording: recordings with the same
    label share a value. `positive`: the fit moves its logarithm, so that it keeps its sign. `prior`
    a standard deviation around the starting value (a Gaussian prior, in its unit; relative for
    `positive`), or `None`. `spread`: each recording deviates from the shared value by a number of
    its own, with this standard deviation (in its unit; relative for `positive`), or `"estimated"`
    from the deviations of three recordings or more, with one `scale` as first guess; `None` for no
    deviations.

    **Raises** `ValueError` for a scale, prior or spread that is not positive, and for a spread if
    each recording has its own value already.

    >>> Free(lambda r: r.readings[0].sensor.bias, "gyro bias", scale=0.01, spread=0.02).name
    'gyro bias'
    """

    where: Callable[[Recording], Any]
    name: str
    scale: float
    each: bool | str | tuple[Any, ...]
    positive: bool
    prior: float | None
    spread: float | str | None
    unit: str | None

    def __init__(
        self,
        where: Callable[[Recording], Any],
        name: str,
        *,
        scale: float = 1.0,
        each: bool | str | Sequence[Any] = False,
        positive: bool = False,
        prior: float | None = None,
        spread: float | str | None = None,
        unit: str | None = None,
    ):
        _checks.function(where, "where", "of a recording, such as lambda r: r.torque.coefficient")
        _checks.instance(name, str, "name")
        self.where, self.name = where, name
        here = f"Free {name!r}"
        self.unit = None if unit is None else _checks.instance(unit, str, f"{here}: unit")
        self.scale = _checks.positive(scale, f"{here}: scale")
        self.each = shares(each, f"{here}: each")
        self.positive = positive
        self.prior = None if prior is None else _checks.positive(prior, f"{here}: prior")
        if spread is not None and spread != "estimated":
            wanted = 'a positive number or "estimated"'
            spread = _checks.positive(spread, f"{here}: spread", wanted)
        self.spread = spread
        if each is True and spread is not None:
            wanted = "spread is about a shared value, each=True has none; give prior"
            raise ValueError(f"{here}: {wanted}")


def shares(each: Any, name: str) -> bool | str | tuple[Any, ...]:
    """`each` if it is valid. **Raises** `TypeError`, `ValueError` for other values."""
    if isinstance(each, bool):
        return each
    if isinstance(each, str):
        return _checks.word(each, ("body",), name)
    wanted = 'True, False, "body", or a sequence of labels, one for each recording'
    return tuple(_checks.instance(each, Sequence, name, wanted=wanted))


class Slot(eqx.Module):
    """A `Free` found in the recordings: which leaf it is, and the group of each recording (R,).
    `prior` and `spread` are in steps. No function is kept: a second problem does not compile again.
    """

    leaf: int = eqx.field(static=True)
    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    each: bool = eqx.field(static=True)
    positive: bool = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    groups: Array | None
    scale: Array
    prior: Array | None
    spread: Array | None
    estimated: bool = eqx.field(static=True, default=False)

    def read(self, recording: Recording) -> Array:
        """Its value in a recording."""
        return jax.tree.leaves(recording)[self.leaf]

    def move(self, start: Array, step: Array) -> Array:
        """The value that lies `step` away from `start`, in units of the scale."""
        if self.positive:
            return start * jnp.exp(step * self.scale)
        return start + step * self.scale

    def step(self, start: Array, value: Array) -> Array:
        """The inverse of `move`."""
        if self.positive:
            return jnp.log(value / start) / self.scale
        return (value - start) / self.scale

    def alone(self) -> "Slot":
        """The same in a problem of one recording."""
        return dataclasses.replace(
            self, each=False, labels=(), groups=None, spread=None, estimated=False
        )


def grouped(
    each: str | tuple[Any, ...], of: Sequence[str], name: str
) -> tuple[Array, tuple[str, ...]]:
    """The index of each recording's group, and the groups' labels: of bodies, or as given."""
    row = list(of) if isinstance(each, str) else list(each)
    if len(row) != len(of):
        raise ValueError(
            f"{name}: wanted one label for each of {len(of)} recordings, got {len(row)}"
        )
    labels = list(dict.fromkeys(map(str, row)))
    rows = [labels.index(str(label)) for label in row]
    return jnp.asarray(rows, jnp.int32), tuple(labels)


def find(free: Sequence[Free], recording: Recording, of: Sequence[str] = ("",)) -> tuple[Slot, ...]:
    """The leaf of the recording that each `Free` moves; `of` the name of each recording's body."""
    slots: list[Slot] = []
    for item in free:
        _checks.instance(item, Free, "free", wanted="Free(where, name)")
        here = f"Free {item.name!r}"
        index, value = leaf_at(item.where, recording, here, "it")
        if any(slot.leaf == index for slot in slots):
            raise ValueError(f"{here}: another Free moves the same numbers")
        if any(slot.name == item.name for slot in slots):
            raise ValueError(f"{here}: another Free has this name; give each its own")
        if item.positive and not (np.asarray(value) > 0).all():
            raise ValueError(f"{here}: wanted a positive starting value, got {value}")
        guessed = isinstance(item.spread, str)
        if guessed and len(of) < 3:
            wanted = "a spread is estimated from three recordings or more"
            raise ValueError(f"{here}: {wanted}, got {len(of)}; give it")
        wide = item.scale if isinstance(item.spread, str) else item.spread
        steps = (None if x is None else jnp.asarray(x / item.scale) for x in (item.prior, wide))
        groups, labels = None, ()
        if not isinstance(item.each, bool):
            groups, labels = grouped(item.each, of, here)
        unit = _unit_of(recording, index) if item.unit is None else item.unit
        own: Any = (item.positive, labels, groups, jnp.asarray(item.scale), *steps, guessed)
        slots.append(Slot(index, item.name, unit, item.each is True, *own))
    return tuple(slots)


def leaf_at(where: Callable[[Any], Any], tree: Any, name: str, what: str) -> tuple[int, Any]:
    """The index of the leaf that `where` picks, and the leaf: an array of numbers."""
    leaves, structure = jax.tree.flatten(tree)
    try:
        index = where(jax.tree.unflatten(structure, list(range(len(leaves)))))
    except (AttributeError, IndexError, TypeError) as error:
        raise ValueError(f"{name}: nothing is there ({error})") from None
    if index is None:
        raise ValueError(
            f"{name}: None is there; give {what} a starting value, such as "
            "Gyro(bias=[0.0, 0.0, 0.0])"
        )
    if not isinstance(index, int):
        one = name.split()[0]
        raise ValueError(f"{name}: wanted one array, got {type(index).__name__}; one {one} each")
    if not eqx.is_inexact_array_like(leaves[index]):
        raise ValueError(f"{name}: wanted numbers, got {type(leaves[index]).__name__}")
    return index, leaves[index]


_UNITS = {"offset": "s", "delay": "s", "mounting": "rad", "tilt": "rad", "place": "m"}


def _unit_of(recording: Recording, index: int) -> str:
    """The unit of a leaf of a recording, if its name implies one."""
    path, _ = jax.tree.leaves_with_path(recording)[index]
    *way, last = path
    name = getattr(last, "name", "")
    if name != "bias":
        return _UNITS.get(name, "")
    holder: Any = recording
    for key in way:
        holder = getattr(holder, key.name) if hasattr(key, "name") else holder[key.idx]
    return getattr(holder, "unit", "")


def put(recording: Recording, slots: Sequence[Slot], values: Sequence[Array]) -> Recording:
    """The recording with these values in the slots."""
    leaves, structure = jax.tree.flatten(recording)
    for slot, value in zip(slots, values, strict=True):
        leaves[slot.leaf] = jnp.broadcast_to(value, jnp.shape(leaves[slot.leaf])).astype(
            jnp.result_type(leaves[slot.leaf])
        )
    return jax.tree.unflatten(structure, leaves)


class Own(eqx.Module):
    """The free numbers that belong to one recording, of order one.

    **Fields:** `place`, `speed` (3,) the initial position and velocity from the reference, in
    typical lengths and speeds, or `None` if nothing depends on them; `turn` (3,) the rotation
    vector from the reference attitude to the initial one (body frame, rad), or `None`; `spin` (3,)
    the initial body rate over the typical rate; `each` the steps of the `Free`s with one value for
    each recording, and the deviations of those with a `spread`.

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

    >>> found = rj.identify.fit(rj.datasets.toutatis.problem())
    >>> low, high = found.interval_of(lambda point: point.state0.omega)  # a function of `Unpacked`
    >>> bool((low < high).all())
    True
    """

    parameters: Parameters
    body: Any
    state0: Any
    values: dict[str, Array]
    noise: tuple[Array, ...]
    process: Any = None


def local(
    problem: "Problem", parameters: Parameters, fill: int = 0, join: Any = jnp.add
) -> Parameters:
    """What each recording depends on, with a leading axis: numbers of its body (padded by `fill` to
    the largest chart), as `shared` one step for each `Free` (shared and own ones joined), its
    initial state.
    """
    steps = []
    for slot, shared, each in by_slot(problem, parameters):
        if shared is None:
            steps.append(each)
            continue
        # A shared number is repeated for each recording.
        wide = (problem.count, *shared.shape)
        step = jnp.broadcast_to(shared, wide) if slot.groups is None else shared[slot.groups]
        steps.append(step if each is None else join(step, each))
    body = spread(problem.body, parameters.body, problem.which, problem.count, fill=fill)
    parts = body, tuple(steps), ()
    return eqx.tree_at(lambda p: (p.body, p.shared, p.own.each), parameters, parts)


def by_slot(problem: "Problem", parameters: Parameters) -> list[tuple["Slot", Any, Any]]:
    """Each `Free` with its shared number and the recordings' own numbers; `None` if it has none."""
    shared, each = iter(parameters.shared), iter(parameters.own.each)
    of_all = [None if slot.each else next(shared) for slot in problem.slots]
    alone = [slot.each or slot.spread is not None for slot in problem.slots]
    of_each = [next(each) if own else None for own in alone]
    return list(zip(problem.slots, of_all, of_each, strict=True))


def columns(problem: "Problem", one: Parameters) -> np.ndarray:
    """The number of each column of a recording's block: all, then shared ones with a deviation."""
    steps = zip(problem.slots, numbered(one).shared, strict=True)
    twice = [np.ravel(step) for slot, step in steps if slot.spread is not None]
    size = sum(np.size(leaf) for leaf in jax.tree.leaves(one))
    return np.concatenate([np.arange(size), *twice]).astype(int)


def columns_alone(problem: "Problem", one: Parameters) -> np.ndarray:
    """The columns of a recording's block whose numbers no other recording has."""
    counted, total = numbered(one), columns(problem, one).size
    steps = zip(problem.slots, counted.shared, strict=True)
    each = [np.ravel(step) for slot, step in steps if slot.each]
    state = [np.ravel(leaf) for leaf in jax.tree.leaves(counted.own)]
    size = sum(np.size(leaf) for leaf in jax.tree.leaves(one))
    return np.concatenate([*each, *state, np.arange(size, total)]).astype(int)


def places(problem: "Problem", parameters: Parameters) -> Int[Array, "records columns"]:
    """Each column's place in the flattened parameters; n for a column of no number."""
    counted = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.int32), numbered(parameters))
    size = ravel_pytree(parameters)[0].size
    first = local(problem, counted, size, lambda shared, each: shared)
    twice = [each for slot, _, each in by_slot(problem, counted) if slot.spread is not None]
    rows = [leaf.reshape(problem.count, -1) for leaf in (*jax.tree.leaves(first), *twice)]
    return jnp.concatenate(rows, axis=1)


def numbered(tree: Any) -> Any:
    """The same tree with its numbers counted from zero in the order of `ravel_pytree`."""
    leaves, structure = jax.tree.flatten(tree)
    ends = np.cumsum([np.size(leaf) for leaf in leaves])
    counted = np.split(np.arange(ends[-1] if leaves else 0), ends[:-1])
    shaped = [row.reshape(np.shape(leaf)) for row, leaf in zip(counted, leaves, strict=True)]
    return jax.tree.unflatten(structure, shaped)
