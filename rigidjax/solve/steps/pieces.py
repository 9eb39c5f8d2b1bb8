"""Run equal steps on a GPU, several in one kernel, with a reverse mode written by hand.

A GPU kernel that takes a single step mostly waits for its data. With several steps in each
iteration of the loop (unrolling), free bodies take three times as many steps a second. In reverse
mode unrolling does not help, because a backward step has so many numbers that the time of a kernel
grows in proportion to its number of operations. If a loop is unrolled, JAX also unrolls its
transpose. The backward loop is therefore written here by hand, with one step in each iteration. It
stores states on two levels (see `march_on_gpu`). On a CPU neither the unrolling nor this
backward loop saves time.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, PyTree

from rigidjax.solve.programs.batching import Arrays, with_replacements
from rigidjax.solve.programs.linear_map import linear_map
from rigidjax.solve.programs.traced import trace_program

# The loop over the steps takes several steps in each iteration, which is one kernel on a GPU. An
# iteration has about `_LONG` operations, and at most `_MOST` steps. Measured: a kernel twice as
# long takes four times as long to compile and is no faster; with a kernel half as long the run
# takes a third longer.
_LONG, _MOST = 2800, 8


def steps_per_piece(count: int) -> int:
    """Return how many steps are in each piece of a run of `count` steps: about √count.

    The smallest divisor of `count` between √count and 2√count is taken, if there is one: no loop
    for remaining steps has then to be compiled.
    """
    root = math.isqrt(count - 1) + 1
    near = [d for d in range(root, min(2 * root, count) + 1) if count % d == 0]
    return near[0] if near else root


class _Division(NamedTuple):
    """Hold how steps are divided into pieces of equally many steps."""

    firsts: Array  # the number of the first step of each piece
    length: int  # the number of steps in a piece
    left: int  # the number of steps after the last piece, too few for another one


class _PieceStarts(NamedTuple):
    """Hold the states from which reverse mode computes all others once more."""

    of_pieces: Arrays  # at the start of each piece, in a new first axis
    of_left: Arrays  # at the start of the steps after the last piece


@dataclasses.dataclass(frozen=True)
class _Pieces:
    """Take many equal steps, and run them in reverse mode, in pieces of about √count steps.

    Only the states at the starts of the pieces are stored; reverse mode computes those within a
    piece once more. States and constants are lists of arrays.
    """

    # call(constants, y, i) → the state after step number i, which begins with the state y.
    call: Callable[[Arrays, Arrays, Array], Arrays]
    count: int  # the number of steps
    turn: int  # the number of steps in one iteration of the loop in forward direction

    def take_steps(
        self,
        constants: Arrays,
        y: Arrays,
        first_step: Array,
        number: int,
        keep_starts: bool = False,
    ) -> tuple[Arrays, Arrays | None]:
        """Take `number` steps from `y`; return the state at their end and, if wanted, all
        starts.
        """

        def one(y: Arrays, i: Array) -> tuple[Arrays, Any]:
            return self.call(constants, y, i), y if keep_starts else None

        return lax.scan(one, y, first_step + jnp.arange(number, dtype=jnp.int32), unroll=self.turn)

    def run_saving_starts(
        self, constants: Arrays, first_step: Array, y: Arrays
    ) -> tuple[Arrays, _PieceStarts]:
        """Take all steps from the index `first_step` on; return the state at their end, and the
        states at which the pieces start.
        """
        firsts, length, left = self.divide(first_step)

        def piece(y: Arrays, begin: Array) -> tuple[Arrays, Arrays]:
            return self.take_steps(constants, y, begin, length)[0], y

        end, starts = lax.scan(piece, y, firsts)
        last = end
        if left:
            end, _ = self.take_steps(constants, end, first_step + self.count - left, left)
        return end, _PieceStarts(starts, last)

    def pull_back(
        self,
        constants: Arrays,
        has_derivative: Sequence[bool],
        first_step: Array,
        starts: _PieceStarts,
        cotangent_of_end: Arrays,
    ) -> tuple[Arrays, Arrays]:
        """Return the cotangents of the constants with a derivative, and of the start."""
        firsts, length, left = self.divide(first_step)
        chosen = [c for c, m in zip(constants, has_derivative, strict=True) if m]

        def step_of(i: Array) -> Callable[[Arrays, Arrays], Arrays]:
            return lambda some, y: self.call(
                with_replacements(constants, has_derivative, some), y, i
            )

        def one(sums: tuple[Arrays, Arrays], at: tuple[Arrays, Array]) -> tuple[Any, None]:
            (total, bar), (y, i) = sums, at
            more, bar = jax.vjp(step_of(i), chosen, y)[1](bar)
            return ([a + b for a, b in zip(total, more, strict=True)], bar), None

        def piece(sums: tuple[Arrays, Arrays], y: Arrays, begin: Array, many: int) -> Any:
            states: Any
            _, states = self.take_steps(constants, y, begin, many, keep_starts=True)
            steps = begin + jnp.arange(many, dtype=jnp.int32)
            return lax.scan(one, sums, (states, steps), reverse=True)[0]

        sums = [jnp.zeros_like(c) for c in chosen], cotangent_of_end
        if left:
            sums = piece(sums, starts.of_left, first_step + self.count - left, left)

        def whole(sums: tuple[Arrays, Arrays], at: tuple[Arrays, Array]) -> tuple[Any, None]:
            y, begin = at
            return piece(sums, y, begin, length), None

        return lax.scan(whole, sums, (starts.of_pieces, firsts), reverse=True)[0]

    def divide(self, first_step: Array) -> _Division:
        """Return how all steps are divided into pieces; the first has the number `first_step`."""
        length = steps_per_piece(self.count)
        many, left = divmod(self.count, length)
        return _Division(first_step + length * jnp.arange(many, dtype=jnp.int32), length, left)


def march_on_gpu(step: Callable[[Any, Array], Any], first_step: Array, count: int, y: Any) -> Any:
    """Take many equal steps `step(state, i)`, several in one kernel; return the state after them.

    In reverse mode the run is divided into pieces (see `_Pieces`). Second derivatives are forward
    over reverse.
    """
    start, tree = jax.tree.flatten(y)
    one = trace_program(lambda y, i: jax.tree.leaves(step(tree.unflatten(y), i)), start, first_step)
    turn = min(max(_LONG // len(one.closed.jaxpr.eqns), 1), _MOST)
    # `turn` is how many steps are taken in one iteration of the loop over the steps. It is a power
    # of two, because the number of steps in a piece is often a multiple of a power of two.
    turn = 1 << (turn.bit_length() - 1)
    program, constants = _Pieces(one.call, count, turn), one.jax_constants
    number = len(constants)
    smooth = [*[eqx.is_inexact_array(c) for c in constants], False, *[True for _ in start]]

    def end(args: Arrays) -> Arrays:
        return program.run_saving_starts(args[:number], args[number], args[number + 1 :])[0]

    @jax.custom_jvp
    def run(*args: Array) -> Arrays:
        return end(list(args))

    def run_jvp(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> tuple[Arrays, Arrays]:
        both = zip(smooth, tangents, strict=True)
        moving = [s and not isinstance(t, SymbolicZero) for s, t in both]
        size = len(primals)
        out, starts = program.run_saving_starts(
            list(primals[:number]), primals[number], list(primals[number + 1 :])
        )
        rows, shape = jax.tree.flatten(starts)

        def push(*args: Array) -> Arrays:
            given = list(args[:size])
            of = lambda *some: end(with_replacements(given, moving, some))  # noqa: E731
            at = [g for g, m in zip(given, moving, strict=True) if m]
            return jax.jvp(of, at, list(args[size + len(rows) :]))[1]

        def pull(*args: Array) -> Arrays:
            given, kept, bars = args[:number], args[size : size + len(rows)], args[-len(start) :]
            total, bar = program.pull_back(
                list(given), moving[:number], args[number], shape.unflatten(kept), list(bars)
            )
            return [*total, *[b for b, m in zip(bar, moving[number + 1 :], strict=True) if m]]

        along = [t for t, m in zip(tangents, moving, strict=True) if m]
        return out, linear_map(push, pull, [*primals, *rows], along)

    run.defjvp(run_jvp, symbolic_zeros=True)
    return tree.unflatten(run(*constants, first_step, *start))
