"""Join models of several kinds of recordings to one model, by the places of their parameters."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from rigidjax.identify.data import stacking
from rigidjax.identify.data.reference_states import ReferenceStates
from rigidjax.identify.model.free import Slot
from rigidjax.identify.model.index import Index
from rigidjax.identify.sensors.base import extras


class Part(eqx.Module):
    """Hold the model of one kind of recordings, and its places in the model of all kinds."""

    name: str = eqx.field(static=True)
    model: Any
    # The places of its parameters among all; `None` for the only part of a model, which has all.
    places: Int[Array, " k"] | None
    # The indices of its first recording and of its first sensor among all.
    first: int = eqx.field(static=True)
    first_sensor: int = eqx.field(static=True)

    @property
    def recordings_slice(self) -> slice:
        """Return where the recordings of this part stand among all."""
        return slice(self.first, self.first + self.model.records.t.shape[0])

    @property
    def sensors_slice(self) -> slice:
        """Return where the sensors of this part stand among all."""
        return slice(self.first_sensor, self.first_sensor + len(self.model.records.readings))

    def take(self, x: Any) -> Any:
        """Return the entries of x (n,) for the parameters of this part."""
        return x if self.places is None else x[self.places]


def fields_of_several(models: Mapping[str, Any], **arguments: Any) -> dict[str, Any]:
    """Return the values of all fields of a `Model` of several kinds of recordings by name."""
    given = [name for name, value in arguments.items() if value is not None and value != ()]
    if given:
        raise TypeError(f"Model: of several kinds give {given[0]} to the Model of one kind")
    if len(models) < 2:
        raise ValueError("Model: wanted two kinds of recordings or more, each a Model, got one")
    for name, model in models.items():
        _require_part(model, f"Model: {name!r}")
    kinds = list(models.values())
    body_names = tuple(name for model in kinds for name in model.body_names)
    names = list(dict.fromkeys(body_names))
    if "" in names and len(names) > 1:
        raise ValueError("Model: wanted bodies by name in every kind, or in none")
    charts: dict[str, Any] = {}
    for kind, model in models.items():
        for name, chart in zip(dict.fromkeys(model.body_names), model.charts, strict=True):
            if not eqx.tree_equal(charts.setdefault(name, chart), chart):
                words = f"body {name!r}" if name else "the body"
                raise ValueError(f"Model: {kind!r}: wanted the same chart of {words} in each kind")
    ends = np.cumsum([charts[name].size for name in names])
    spots = {n: np.arange(e - charts[n].size, e) for n, e in zip(names, ends, strict=True)}
    bodies = end = int(ends[-1])
    parts, slots, first, first_sensor = [], {}, 0, 0
    for kind, model in models.items():
        mine = np.full(model.size, -1)
        of_bodies = [spots[name] for name in dict.fromkeys(model.body_names)]
        mine[: model.index.bodies] = np.concatenate(of_bodies)
        for slot in model.slots:
            if slot.name in slots:
                same, other = slots[slot.name]
                _require_same(f"Free {slot.name!r} of {kind!r}", slot, model, same, other)
                mine[np.ravel(slot.shared)] = np.ravel(same.shared)
        fresh = np.flatnonzero(mine < 0)
        mine[fresh] = end + np.arange(fresh.size)
        end += fresh.size
        for slot in model.slots:
            both = (slot.shared, slot.own)
            shared, own = (None if a is None else jnp.asarray(mine[a], jnp.int32) for a in both)
            moved = dataclasses.replace(slot, shared=shared, own=own)
            slots.setdefault(slot.name, (moved, model))
        parts.append(Part(kind, model, jnp.asarray(mine, jnp.int32), first, first_sensor))
        first, first_sensor = parts[-1].recordings_slice.stop, parts[-1].sensors_slice.stop
    indices = [names.index(name) for name in body_names]
    priors = [model.prior for model in kinds if model.prior is not None]
    if len(priors) > 1 or not all(eqx.tree_equal(one.loss, kinds[0].loss) for one in kinds):
        raise ValueError("Model: wanted the same loss in each kind, and one prior in all kinds")
    rates, groups, counts = (
        np.concatenate([np.asarray(part) for part in some])
        for some in zip(*((m.reference.rate, m.noise_groups, m.counts) for m in kinds), strict=True)
    )
    torques = {kind: model.torque for kind, model in models.items() if model.torque is not None}
    # All other fields, such as a loss, are alike in all kinds.
    alike = {field.name: getattr(kinds[0], field.name) for field in dataclasses.fields(kinds[0])}
    return alike | {
        "parts": tuple(parts),
        "records": stacking.unite([model.records for model in kinds]),
        "counts": counts,
        "charts": tuple(charts[name] for name in names),
        "body_names": body_names,
        "body_indices": None if names == [""] else jnp.asarray(indices, jnp.int32),
        "torque": torques or None,
        "slots": tuple(slot for slot, _ in slots.values()),
        "index": _index(parts, bodies, end),
        "noise_groups": jnp.asarray(groups),
        "prior": next(iter(priors), None),
        "integrator": None,
        "state_kind": object,
        "reference": ReferenceStates(None, jnp.asarray(rates), jnp.zeros((rates.size, 0))),
    }


def _require_part(model: Any, name: str) -> None:
    """Raise an error unless a model may be one of several kinds."""
    if not hasattr(model, "parts"):
        raise TypeError(f"{name}: wanted a Model of one kind, got {type(model).__name__}")
    jitter = any(extras(sensor).jitter is not None for sensor in model.records.sensors)
    wrong = {
        "several kinds": model.parts,
        "windows": model.clusters is not None,
        "an unknown torque or drift": model.process is not None or model.walks,
        "jitter": jitter,
        "`measured`, which the model of all kinds has": model.measured,
    }
    for words, found in wrong.items():
        if found:
            raise ValueError(f"{name}: a model of several kinds takes no model with {words}")


def _require_same(name: str, slot: Slot, model: Any, other: Slot, model_of_other: Any) -> None:
    """Raise `ValueError` unless two slots of one name in two models may be one parameter."""
    alone = any(one.groups is not None or one.own is not None for one in (slot, other))
    alike = not alone and all(
        eqx.tree_equal(getattr(slot, field), getattr(other, field))
        for field in ("shape", "scale", "positive", "prior", "unit")
    )
    values = [m.values(m.start())[slot.name] for m in (model, model_of_other)] if alike else []
    if not alike or not np.array_equal(*values):
        raise ValueError(
            f"{name}: another kind has a Free of this name: give it another name, or, for one "
            "number in both, the same value, scale, prior, unit and `positive`, and each=False"
        )


def _index(parts: Sequence[Part], bodies: int, size: int) -> Index:
    """Return the index of all parts, with the place `size` where a row has fewer columns."""
    places, starts = [], []
    for part in parts:
        of = np.append(np.asarray(part.places), size)
        places.append(of[np.asarray(part.model.index.places)])
        starts.append(of[np.asarray(part.model.index.start)])
    width, long = (max(rows.shape[1] for rows in some) for some in (places, starts))

    def wide(rows: np.ndarray, left: int, right: int) -> np.ndarray:
        return np.pad(rows, ((0, 0), (left, right)), constant_values=size)

    return Index(
        jnp.asarray(np.concatenate([wide(x, 0, width - x.shape[1]) for x in places]), jnp.int32),
        jnp.asarray(np.concatenate([wide(x, long - x.shape[1], 0) for x in starts]), jnp.int32),
        (),
        (),
        width,
        bodies,
        width,
        size,
    )
