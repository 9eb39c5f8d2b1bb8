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

Arrays = list[Any]

# Bodies that go through a loop together on CPU: few, so that one step's numbers stay in the first
# cache and no body waits long for another.
BLOCK = 16


class Layout(NamedTuple):
    """Which axes the arrays of a program have beyond those of one body.

    **Fields:** `bodies` a last axis of bodies; `directions` an axis of tangents or cotangents
    before it, in what is linear; `shared` which constants have no axis of bodies all the same.
    """

    bodies: bool
    directions: bool
    shared: tuple[bool, ...]


# `program(layout, constants, each, linear)` returns two lists: what each body has, what is linear.
Program = Callable[[Layout, Arrays, Arrays, Arrays], tuple[Arrays, Arrays]]


def one(constants: Arrays) -> Layout:
    """The layout of one body."""
    return Layout(False, False, (True,) * len(constants))


def in_lanes(
    program: Program, layout: Layout, constants: Arrays, each: Arrays, linear: Arrays
) -> tuple[Arrays, Arrays]:
    """The program, whose `jax.vmap` is itself on longer last axes.

    **Arguments:** `constants` arrays that bodies may share; `each` arrays that every body has its
    own of; `linear` tangents or cotangents. No `None` among them.
    """

    def plain(constants: Arrays, each: Arrays, linear: Arrays) -> Any:
        if layout.bodies:
            return _in_blocks(program, layout, constants, each, linear)
        return program(layout, constants, each, linear)

    call = jax.custom_batching.custom_vmap(plain)

    @call.def_vmap
    def _(size: int, batched: Any, constants: Arrays, each: Arrays, linear: Arrays) -> Any:
        of_constants, of_each, of_linear = batched
        if any(of_constants) or any(of_each):
            new = layout._replace(
                bodies=True,
                shared=tuple(s and not b for s, b in zip(layout.shared, of_constants, strict=True)),
            )
            count = each[0].shape[-1] if layout.bodies else 1

            def last(a: Any, is_batched: bool, has_bodies: bool) -> Any:
                a = jnp.moveaxis(a, 0, -1) if is_batched else a[..., None]
                if not layout.bodies:
                    return jnp.broadcast_to(a, (*a.shape[:-1], size))
                a = a if has_bodies else a[..., None, :]
                a = jnp.broadcast_to(a, (*a.shape[:-2], count, size))
                return a.reshape(*a.shape[:-2], count * size)

            constants = [
                c if s else last(c, b, not before)
                for c, s, b, before in zip(
                    constants, new.shared, of_constants, layout.shared, strict=True
                )
            ]
            each = [last(a, b, True) for a, b in zip(each, of_each, strict=True)]
            linear = [last(a, b, True) for a, b in zip(linear, of_linear, strict=True)]
            out = in_lanes(program, new, constants, each, linear)

            def first(a: Any) -> Any:
                if layout.bodies:
                    a = a.reshape(*a.shape[:-1], count, size)
                return jnp.moveaxis(a, -1, 0)

            return jax.tree.map(first, out), jax.tree.map(lambda _: True, out)
        if not any(of_linear):
            # JAX asks for this where only tangents of second derivatives are batched.
            out = plain(constants, each, linear)
            return out, jax.tree.map(lambda _: False, out)
        # Only what is linear: many directions of one motion.
        new = layout._replace(directions=True)
        place = -2 if layout.bodies else -1
        before = 1
        if layout.directions:
            whole = linear[-1].shape[1:] if of_linear[-1] else linear[-1].shape
            before = whole[place]

        def beside(a: Any, is_batched: bool) -> Any:
            if not is_batched:
                a = jnp.broadcast_to(a, (size, *a.shape))
            a = jnp.moveaxis(a, 0, place)
            if layout.directions:
                axis = a.ndim + place
                a = a.reshape(*a.shape[: axis - 1], before * size, *a.shape[axis + 1 :])
            return a

        def apart(a: Any) -> Any:
            axis = a.ndim + place
            if layout.directions:
                a = a.reshape(*a.shape[:axis], before, size, *a.shape[axis + 1 :])
                axis += 1
            return jnp.moveaxis(a, axis, 0)

        linear = [beside(a, b) for a, b in zip(linear, of_linear, strict=True)]
        own, found = in_lanes(program, new, constants, each, linear)
        found = [apart(a) for a in found]
        return (own, found), ([False] * len(own), [True] * len(found))

    return call(constants, each, linear)


def _in_blocks(
    program: Program, layout: Layout, constants: Arrays, each: Arrays, linear: Arrays
) -> tuple[Arrays, Arrays]:
    count = each[0].shape[-1]
    if jax.default_backend() != "cpu" or count <= BLOCK:
        return program(layout, constants, each, linear)
    number = -(-count // BLOCK)
    size = -(-count // number)

    def cut(a: Any) -> Any:
        room = number * size - count
        if room:
            a = jnp.concatenate([a, jnp.repeat(a[..., -1:], room, -1)], -1)
        return jnp.moveaxis(a.reshape(*a.shape[:-1], number, size), -2, 0)

    own = [None if s else cut(c) for c, s in zip(constants, layout.shared, strict=True)]

    def block(part: Any) -> Any:
        own, each, linear = part
        mixed = [c if o is None else o for c, o in zip(constants, own, strict=True)]
        return program(layout, mixed, each, linear)

    out = lax.map(block, (own, [cut(a) for a in each], [cut(a) for a in linear]))

    def joined(a: Any) -> Any:
        a = jnp.moveaxis(a, 0, -2)
        return a.reshape(*a.shape[:-2], number * size)[..., :count]

    return jax.tree.map(joined, out)
