"""Run equal steps on a GPU, several in one kernel, with a reverse mode of two levels by hand.

A kernel of one step waits for its numbers. With several steps in a turn of the loop, free bodies
take three times as many steps a second. A kernel of a step backward has too many numbers to gain
from this: it takes longer in proportion to its length. JAX's transpose of a loop has as many steps
in a turn as the loop itself, so the loop backward is written here by hand, with one step in a turn.
On a CPU neither the longer kernel nor the loop backward gains anything.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, PyTree

from rigidjax.solve.batching import Arrays
from rigidjax.solve.linear_map import linear_map
from rigidjax.solve.stops import trace_program

# About this many operations, and at most this many steps, are in a turn of the loop. Measured: a
# kernel twice as long takes four times as long to compile and is no faster; with a kernel half as
# long the run takes a third longer.
_LONG, _MOST = 2800, 8


def piece_length(count: int) -> int:
    """Return the number of steps in a piece of a run of `count` steps, about √count.

    If there is a divisor of `count` from √count to 2√count, it is taken: then no steps are left
    over after the pieces, and there is less to compile.
    """
    root = math.isqrt(count - 1) + 1
    near = [d for d in range(root, min(2 * root, count) + 1) if count % d == 0]
    return near[0] if near else root


@dataclasses.dataclass(frozen=True)
class _Program:
    """Run `count` steps of a program, forward and backward; `turn` of them are in a kernel.

    `call(constants, y, i)` returns the state after the step of number `i` from the state `y`.
    Constants and states are lists of arrays.
    """

    call: Callable[[Arrays, Arrays, Array], Arrays]
    count: int
    turn: int

    def some(
        self, constants: Arrays, y: Arrays, first: Array, many: int, keep: bool = False
    ) -> tuple[Arrays, Any]:
        """Return the state after the `many` steps from number `first` on, which begin at `y`.

        With `keep` also return the states at the starts of all these steps, else `None`.
        """

        def one(y: Arrays, i: Array) -> tuple[Arrays, Any]:
            return self.call(constants, y, i), y if keep else None

        return lax.scan(one, y, first + jnp.arange(many, dtype=jnp.int32), unroll=self.turn)

    def forward(self, constants: Arrays, first: Array, y: Arrays) -> tuple[Arrays, Any]:
        """Return the state after all steps from `y`, and the states from which `back` begins.

        These are the starts of the pieces, which have one length, in rows; and the start of the
        steps that are left over after the pieces.
        """
        firsts, length, left = self.pieces(first)

        def piece(y: Arrays, begin: Array) -> tuple[Arrays, Arrays]:
            return self.some(constants, y, begin, length)[0], y

        end, starts = lax.scan(piece, y, firsts)
        last = end
        if left:
            end, _ = self.some(constants, end, first + self.count - left, left)
        return end, (starts, last)

    def back(
        self, constants: Arrays, moving: Sequence[bool], first: Array, starts: Any, bar: Arrays
    ) -> tuple[Arrays, Arrays]:
        """Return the cotangents of the constants that are `moving`, and of the state at the start.

        `moving` says of each constant whether it has a derivative. `starts` are the states that
        `forward` returned, and `bar` is the cotangent of the state at the end.
        """
        firsts, length, left = self.pieces(first)
        chosen = [c for c, m in zip(constants, moving, strict=True) if m]

        def step_of(i: Array) -> Callable[[Arrays, Arrays], Arrays]:
            return lambda some, y: self.call(_with(constants, moving, some), y, i)

        def one(sums: tuple[Arrays, Arrays], at: tuple[Arrays, Array]) -> tuple[Any, None]:
            (total, bar), (y, i) = sums, at
            more, bar = jax.vjp(step_of(i), chosen, y)[1](bar)
            return ([a + b for a, b in zip(total, more, strict=True)], bar), None

        def piece(sums: tuple[Arrays, Arrays], y: Arrays, begin: Array, many: int) -> Any:
            _, states = self.some(constants, y, begin, many, keep=True)
            steps = begin + jnp.arange(many, dtype=jnp.int32)
            return lax.scan(one, sums, (states, steps), reverse=True)[0]

        sums = [jnp.zeros_like(c) for c in chosen], bar
        rows, last = starts
        if left:
            sums = piece(sums, last, first + self.count - left, left)

        def whole(sums: tuple[Arrays, Arrays], at: tuple[Arrays, Array]) -> tuple[Any, None]:
            starts, begin = at
            return piece(sums, starts, begin, length), None

        return lax.scan(whole, sums, (rows, firsts), reverse=True)[0]

    def pieces(self, first: Array) -> tuple[Array, int, int]:
        """Return the number of the first step of each piece, the number of steps in a piece, and
        the number of steps that are left over.
        """
        length = piece_length(self.count)
        many, left = divmod(self.count, length)
        return first + length * jnp.arange(many, dtype=jnp.int32), length, left


def in_pieces(step: Callable[[Any, Array], Any], first: Array, count: int, y: Any) -> Any:
    """Return the state after `count` steps `y = step(y, i)` from the number i = `first` on.

    In reverse mode the states at the starts of about √count pieces are kept, and all states of one
    piece at a time. Second derivatives are forward over reverse.
    """
    start, tree = jax.tree.flatten(y)
    one = trace_program(lambda y, i: jax.tree.leaves(step(tree.unflatten(y), i)), start, first)
    turn = min(max(_LONG // len(one.closed.jaxpr.eqns), 1), _MOST)
    # The number of steps in a turn is a power of two, because the length of a piece is often a
    # whole multiple of a power of two.
    turn = 1 << (turn.bit_length() - 1)
    program, constants = _Program(one.call, count, turn), one.constants
    number = len(constants)
    smooth = [*[eqx.is_inexact_array(c) for c in constants], False, *[True for _ in start]]

    def end(args: Arrays) -> Arrays:
        return program.forward(args[:number], args[number], args[number + 1 :])[0]

    @jax.custom_jvp
    def run(*args: Array) -> Arrays:
        return end(list(args))

    def run_jvp(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> tuple[Arrays, Arrays]:
        both = zip(smooth, tangents, strict=True)
        moving = [s and not isinstance(t, SymbolicZero) for s, t in both]
        size = len(primals)
        out, starts = program.forward(
            list(primals[:number]), primals[number], list(primals[number + 1 :])
        )
        rows, shape = jax.tree.flatten(starts)

        def push(*args: Array) -> Arrays:
            given = list(args[:size])
            of = lambda *some: end(_with(given, moving, some))  # noqa: E731
            at = [g for g, m in zip(given, moving, strict=True) if m]
            return jax.jvp(of, at, list(args[size + len(rows) :]))[1]

        def pull(*args: Array) -> Arrays:
            given, kept, bars = args[:number], args[size : size + len(rows)], args[-len(start) :]
            total, bar = program.back(
                list(given), moving[:number], args[number], shape.unflatten(kept), list(bars)
            )
            return [*total, *[b for b, m in zip(bar, moving[number + 1 :], strict=True) if m]]

        along = [t for t, m in zip(tangents, moving, strict=True) if m]
        return out, linear_map(push, pull, [*primals, *rows], along)

    run.defjvp(run_jvp, symbolic_zeros=True)
    return tree.unflatten(run(*constants, first, *start))


def _with(all_: Sequence[Any], which: Sequence[bool], some: Sequence[Any]) -> list[Any]:
    """Return the list `all_`, in which `some` replace, in order, the arrays `which` selects."""
    rest = iter(some)
    return [next(rest) if w else a for a, w in zip(all_, which, strict=True)]
