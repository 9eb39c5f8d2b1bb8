"""Batches of a program: bodies in the last axis of every array, whatever `jax.vmap` is outside.

XLA on CPU makes vector instructions of arrays whose last axis is the batch; `jax.vmap` puts it
first, which is many times slower in a loop over small states. So each program is written for
arrays with a trailing axis of bodies (or none), and `custom_vmap` brings them there.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from rigidjax.solve.linear_map import forward_only, is_smooth

Arrays = list[Any]

# Bodies that go through a loop together on CPU: few, so that one step's numbers stay in the first
# cache and no body waits long for another.
BLOCK = 16


class Layout(NamedTuple):
    """Which axes the arrays of a program have beyond those of one body.

    **Fields:** `bodies` a last axis of bodies; `shared` which constants have none all the same.
    """

    bodies: bool
    shared: tuple[bool, ...]


# `program(layout, constants, each)` returns a list of what each body has.
Program = Callable[[Layout, Arrays, Arrays], Arrays]


def one(constants: Arrays) -> Layout:
    """The layout of one body."""
    return Layout(False, (True,) * len(constants))


def in_lanes(program: Program, layout: Layout, constants: Arrays, each: Arrays) -> Arrays:
    """The program, whose `jax.vmap` is itself on longer last axes, and forward mode, too.

    **Arguments:** `constants` arrays that bodies may share; `each` arrays that every body has its
    own of. No `None` among them. Many tangents of one body are lanes, as many bodies are.
    """
    number = len(constants)

    @jax.custom_batching.custom_vmap
    def call(*args: Any) -> Arrays:
        constants, each = list(args[:number]), list(args[number:])
        if layout.bodies:
            return _in_blocks(program, layout, constants, each)
        return program(layout, constants, each)

    @call.def_vmap
    def _(size: int, batched: Any, *args: Any) -> Any:
        own = batched[:number]
        new = Layout(True, tuple(s and not b for s, b in zip(layout.shared, own, strict=True)))
        count = each[0].shape[-1] if layout.bodies else 1

        def last(a: Any, is_batched: bool, has_bodies: bool) -> Any:
            a = jnp.moveaxis(a, 0, -1) if is_batched else a[..., None]
            if not layout.bodies:
                return jnp.broadcast_to(a, (*a.shape[:-1], size))
            a = a if has_bodies else a[..., None, :]
            a = jnp.broadcast_to(a, (*a.shape[:-2], count, size))
            return a.reshape(*a.shape[:-2], count * size)

        constants = [
            a if now else last(a, b, not before)
            for a, b, before, now in zip(args, own, layout.shared, new.shared, strict=False)
        ]
        rest = zip(args[number:], batched[number:], strict=True)
        out = in_lanes(program, new, constants, [last(a, b, True) for a, b in rest])

        def first(a: Any) -> Any:
            if layout.bodies:
                a = a.reshape(*a.shape[:-1], count, size)
            return jnp.moveaxis(a, -1, 0)

        return [first(a) for a in out], [True] * len(out)

    if layout.bodies:
        return call(*constants, *each)
    smooth = [is_smooth(a) for a in [*constants, *each]]

    def moved(layout: Layout, constants: Arrays, rest: Arrays) -> Arrays:
        layout, constants = spread(layout, constants, rest[0])
        args, along = [*constants, *rest[: len(each)]], rest[len(each) :]

        def of_smooth(*real: Any) -> Arrays:
            queue = iter(real)
            full = [next(queue) if s else a for a, s in zip(args, smooth, strict=True)]
            return [a for a in program(layout, full[:number], full[number:]) if is_smooth(a)]

        real = [a for a, s in zip(args, smooth, strict=True) if s]
        return jax.jvp(of_smooth, tuple(real), tuple(along))[1]

    def push(*args: Any) -> Arrays:
        return in_lanes(moved, layout, list(args[:number]), list(args[number:]))

    return forward_only(call, push)(*constants, *each)


def spread(layout: Layout, constants: Arrays, like: Any) -> tuple[Layout, Arrays]:
    """Constants that have derivatives, one a body of `like`."""
    if not layout.bodies:
        return layout, constants
    own = [
        jnp.broadcast_to(c[..., None], (*c.shape, like.shape[-1])) if s and is_smooth(c) else c
        for c, s in zip(constants, layout.shared, strict=True)
    ]
    shared = (s and not is_smooth(c) for c, s in zip(constants, layout.shared, strict=True))
    return Layout(True, tuple(shared)), own


def _in_blocks(program: Program, layout: Layout, constants: Arrays, each: Arrays) -> Arrays:
    count = each[0].shape[-1]
    if jax.default_backend() != "cpu" or count <= BLOCK:
        return program(layout, constants, each)
    number = -(-count // BLOCK)
    size = -(-count // number)

    def cut(a: Any) -> Any:
        room = number * size - count
        if room:
            a = jnp.concatenate([a, jnp.repeat(a[..., -1:], room, -1)], -1)
        return jnp.moveaxis(a.reshape(*a.shape[:-1], number, size), -2, 0)

    own = [None if s else cut(c) for c, s in zip(constants, layout.shared, strict=True)]

    def block(part: Any) -> Any:
        own, each = part
        mixed = [c if o is None else o for c, o in zip(constants, own, strict=True)]
        return program(layout, mixed, each)

    def joined(a: Any) -> Any:
        a = jnp.moveaxis(a, 0, -2)
        return a.reshape(*a.shape[:-2], number * size)[..., :count]

    return [joined(a) for a in lax.map(block, (own, [cut(a) for a in each]))]
