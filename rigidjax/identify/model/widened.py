"""Add a torque whose numbers are free to a model."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import GetAttrKey, SequenceKey
from jaxtyping import Array, Float

from rigidjax.identify.data import stacking
from rigidjax.identify.model.build import chosen_integrator
from rigidjax.identify.model.charts import body_places
from rigidjax.identify.model.free import Free, find_slots
from rigidjax.identify.model.index import build_index
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.scene import Scene
from rigidjax.motion.torques import Sum
from rigidjax.motion.torques.base import Torque


class Widened(NamedTuple):
    model: Model
    # From the parameters of the model before to those of this one, at which the torque is as given.
    point: Callable[[Float[Array, " n"]], Float[Array, " m"]]


def widened(model: Model, torque: Torque, free: Sequence[Free]) -> Widened:
    """Return a `model` of one kind of recordings with a further `torque` of its state type.

    Each `Free` picks a number of this torque: `where` is a function of the torque alone.
    """
    whole = torque if model.torque is None else Sum(model.torque, torque)
    # A torque that was there before becomes the first part of a sum.
    first = () if model.torque is None else (GetAttrKey("parts"), SequenceKey(0))
    old = [
        dataclasses.replace(one, path=(one.path[0], *first, *one.path[1:]))
        if one.path[0].name == "torque"
        else one
        for one in model.slots
    ]
    of = (lambda s: s.torque) if model.torque is None else (lambda s: s.torque.parts[1])
    picked = [dataclasses.replace(f, where=lambda s, w=f.where: w(of(s))) for f in free]
    sensors = stacking.pick(model.records, 0).sensors
    slots = find_slots(picked, Scene(None, whole, model.process, sensors, None), model.body_names)
    places = body_places(model.charts, model.body_indices, model.count)
    index, slots = build_index(places, [*old, *slots], model.index.start.shape[1] // 3)
    integrator = model.integrator
    if integrator is None:
        t = np.asarray(model.records.t)
        integrator = chosen_integrator(float(np.diff(t, axis=1).max()), model.reference)

    def point(x: Float[Array, " n"]) -> Float[Array, " m"]:
        out = np.zeros(index.size, x.dtype)
        out[: index.bodies] = x[: index.bodies]
        out[np.asarray(index.start)] = x[model.index.start]
        for before, after in zip(model.slots, slots, strict=False):
            for name in ("shared", "own"):
                if (where := getattr(before, name)) is not None:
                    out[np.asarray(getattr(after, name))] = x[where]
        return jnp.asarray(out)

    parts = dict(torque=whole, slots=slots, index=index, integrator=integrator)
    return Widened(dataclasses.replace(model, **parts), point)
