"""Add torques whose numbers may be free to a model."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.tree_util import GetAttrKey, SequenceKey

from rigidjax.identify.data import stacking
from rigidjax.identify.model.build import Extended, chosen_integrator, extended
from rigidjax.identify.model.free import Free, added_slots
from rigidjax.identify.model.model import Model, starting_scene
from rigidjax.motion.torques import Sum
from rigidjax.motion.torques.base import Torque


def with_torques(model: Model, torques: Sequence[Torque]) -> Model:
    """Return a `model` of one kind of recordings with further torques of its state type.

    A torque that was there before becomes the first part of the sum of all.
    """
    first = () if model.torque is None else (model.torque,)
    into = (GetAttrKey("parts"), SequenceKey(0))
    slots = tuple(
        dataclasses.replace(one, path=(one.path[0], *into, *one.path[1:]))
        if getattr(one.path[0], "name", "") == "torque"
        else one
        for one in model.slots
    )
    integrator = model.integrator
    if integrator is None:
        widest = float(np.diff(np.asarray(model.records.t), axis=1).max())
        integrator = chosen_integrator(widest, model.reference)
    parts: Any = dict(torque=Sum(*first, *torques), slots=slots, integrator=integrator)
    return dataclasses.replace(model, **parts)


def with_slots(model: Model, free: Sequence[Free]) -> Extended:
    """Return a `model` of one kind of recordings with a slot for each `Free`."""
    scene = starting_scene(model, stacking.pick(model.records, 0))
    slots = added_slots(free, scene, model.body_names, model.slots)
    return extended(model, slots[len(model.slots) :])
