"""The numbers of a recording's torque and sensors that a fit may move."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rigidjax import _checks
from rigidjax.identify.recording import Recording


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

    >>> import rigidjax as rj
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
    """A `Free` found in the recordings: which leaf it is. No function is kept, so that a second
    problem of the same form does not compile again.

    **Fields:** `each` whether every recording has its own; `groups` (R,) the index of each
    recording's value if groups share values, `labels` of the groups; `prior`, `spread` in steps,
    `estimated` whether the spread is only a first guess.
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
    """The index of each recording's group, and the groups' labels.

    **Arguments:** `each` `"body"`, or one label for each recording; `of` the name of each
    recording's body; `name` for messages. **Raises** `ValueError` for another number of labels.
    """
    row = list(of) if isinstance(each, str) else list(each)
    if len(row) != len(of):
        raise ValueError(
            f"{name}: wanted one label for each of {len(of)} recordings, got {len(row)}"
        )
    labels = list(dict.fromkeys(map(str, row)))
    rows = [labels.index(str(label)) for label in row]
    return jnp.asarray(rows, jnp.int32), tuple(labels)


def find(free: Sequence[Free], recording: Recording, of: Sequence[str] = ("",)) -> tuple[Slot, ...]:
    """The leaf of the recording that each `Free` moves; `of` the name of each recording's body.

    **Raises** `ValueError` if it picks nothing, something other than numbers, or the same numbers
    twice.
    """
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
    """The index of the leaf that `where` picks, and the leaf: an array of numbers.

    **Arguments:** `name` for messages; `what` needs a starting value instead of `None`.
    **Raises** `ValueError` if it picks nothing, several leaves, or something other than numbers.
    """
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
