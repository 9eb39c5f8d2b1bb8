"""Every public callable with every argument replaced, and its good call under every transform.

Run in a process of its own, where nothing checks types: what a user sees.

    python -m surface.fuzz [--only NAME] [--sample] [--json FILE]
"""

import argparse
import collections
import fnmatch
import inspect
import json
import resource
import sys
import time
import warnings
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from surface import accepted, judge, replace
from surface.calls import TABLE, Call

RTOL = {"same": 1e-12, "single": 1e-3, "whole": 1e-12}
# A derivative of a batch, as of a cost of many bodies: of all floats, of the last array alone.
OUTSIDE = ("jvp of vmap", "jvp of vmap of one")


def failures_of(
    call: Call, counts: collections.Counter, transforms: bool = True
) -> Iterator[tuple[str, str]]:
    """What a user would call wrong, as (where, what)."""
    given = call.given()
    good = judge.Outcome({}) if call.dear else judge.outcome(lambda: call.run(**given))
    counts["calls"] += not call.dear
    if good.error is not None:
        yield "good call", str(good)
        return
    if judge.has_nan(good) and accepted.reason(call.name, "good call", str(good)) is None:
        yield "good call", f"gave a NaN: {good}"
    may_be_none = _may_be_none(call)
    for argument, value in given.items():
        if argument == "self" or (call.arguments is not None and argument not in call.arguments):
            continue
        for other in replace.replacements(value):
            if other.group not in call.groups:
                continue
            if other.value is None and argument in may_be_none:
                continue
            counts["calls"] += 1
            counts[other.group] += 1
            what = _judged(call, given, argument, value, other, good)
            if what:
                counts["found"] += 1
                reason = accepted.reason(call.name, f"{argument}: {other.name}", what)
                if reason is None:
                    yield f"{argument}: {other.name}", what
                else:
                    counts[f"accepted: {reason}"] += 1
    if transforms:
        yield from transformed(call, counts)


def _judged(
    call: Call, given: dict, argument: str, value: Any, other: replace.Replacement, good: Any
) -> str | None:
    result = judge.outcome(lambda: call.run(**{**given, argument: other.value}))
    if result.error is not None:
        words = judge.words_for(call.name, argument, value) | set(call.says)
        if other.group == "shape":
            # Of two whose shapes do not agree a message may name either.
            words |= set(given)
        why = judge.raw(result.error, words)
        if other.group == "function" and "positional argument" in str(result.error):
            return None
        return None if why is None else f"{why}: {result}"
    if other.group in ("same", "single"):
        if judge.same(result, good, RTOL[other.group]):
            return None
        return f"{result} where the good call {good}"
    if other.group == "whole":
        like = judge.outcome(lambda: call.run(**{**given, argument: other.like}))
        if judge.same(result, like, RTOL["whole"]):
            return None
        return f"{result} where floats gave: {like}"
    if other.group == "nan":
        # A number that does not depend on the argument is right whatever the argument is.
        if not judge.all_finite(result) or judge.same(result, good, 0.0):
            return None
        return f"NaN is lost: {result}"
    if other.group == "inf":
        if judge.has_nan(result) or not judge.all_finite(result) or judge.same(result, good, 0.0):
            return None
        return f"infinity is lost: {result}"
    if other.group == "stranger":
        return f"taken without a word: {result}"
    if judge.has_nan(result):
        return f"a silent NaN: {result}"
    return None


def _may_be_none(call: Call) -> set[str]:
    parameters = inspect.signature(call.run).parameters
    return {name for name, p in parameters.items() if p.default is None}


def transformed(call: Call, counts: collections.Counter) -> Iterator[tuple[str, str]]:
    """What goes wrong with the good call under the transforms, as (where, what)."""
    given = call.given()
    held = {
        name: value
        for name, value in given.items()
        if (call.traced is None and _holds_floats(value))
        or (call.traced is not None and name in call.traced)
    }
    if not held or not (call.transforms or call.host):
        return
    held = {name: replace.with_floats(value, jnp.asarray) for name, value in held.items()}
    floats, rest = eqx.partition(held, eqx.is_inexact_array_like)
    floats = jax.tree.map(jnp.asarray, floats)

    def run(floats: Any) -> Any:
        return _numbers(call.run(**{**given, **eqx.combine(floats, rest)}))

    if call.host:
        counts["calls"] += 1
        result = judge.outcome(lambda: jax.jit(run)(floats))
        if result.error is not None:
            why = judge.raw(
                result.error, {w for n in held for w in judge.words_for(call.name, n, given[n])}
            )
            if why:
                yield "under jit", f"{why}: {result}"
        return

    programs = _programs(run, floats)
    wanted = [name for name in programs if name in call.transforms]
    if "grad" in call.transforms:
        wanted += ["jvp", *OUTSIDE]
    counts["calls"] += len(wanted)
    counts["transforms"] += len(wanted)
    for name in list(wanted):
        try:
            jax.eval_shape(programs[name], floats)
        except Exception as error:
            wanted.remove(name)
            yield f"under {name}", str(judge.Outcome(error=error))
    # One program of all: compiling is what this costs.
    together = jax.jit(
        lambda x: {name: programs[name](x) for name in wanted},
        compiler_options={"xla_backend_optimization_level": 0},
    )
    try:
        values = jax.block_until_ready(together(floats))
    except Exception as error:
        yield "under transforms", str(judge.Outcome(error=error))
        return
    yield from _compared(values, run(floats))


def _programs(run: Any, floats: Any) -> dict[str, Any]:
    _flat, restore = jax.flatten_util.ravel_pytree(floats)

    def scalar(x: Any) -> Any:
        return _weighed(run(x))

    def twice(x: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), x)

    def of_flat(vector: Any) -> Any:
        return scalar(restore(vector))

    def raveled(x: Any) -> Any:
        return jax.flatten_util.ravel_pytree(x)[0]

    def jvp(function: Any, x: Any) -> Any:
        return jax.jvp(function, (x,), (jax.tree.map(jnp.cos, x),))

    def outside(x: Any, all_of_it: bool) -> Any:
        leaves, tree = jax.tree.flatten(x)
        axes = [0 if all_of_it else None] * (len(leaves) - 1) + [0]
        many = [
            leaf if axis is None else twice(leaf) for axis, leaf in zip(axes, leaves, strict=True)
        ]
        # Within `jit` a batch is made before its derivative.
        one = jax.jit(lambda leaves: run(jax.tree.unflatten(tree, leaves)))
        return jvp(jax.vmap(one, (axes,)), many)

    return {
        "jvp": lambda x: jvp(run, x),
        OUTSIDE[0]: lambda x: outside(x, True),
        OUTSIDE[1]: lambda x: outside(x, False),
        "jit": run,
        "vmap": lambda x: jax.vmap(run)(twice(x)),
        "grad": lambda x: jax.grad(of_flat)(raveled(x)),
        "jacfwd": lambda x: jax.jacfwd(of_flat)(raveled(x)),
        "hessian": lambda x: jax.hessian(of_flat)(raveled(x)),
        "scan": lambda x: jax.lax.scan(lambda c, _: (c, run(c)), x, None, length=2)[1],
        "checkpoint": lambda x: jax.grad(jax.checkpoint(of_flat))(raveled(x)),
    }


def _compared(values: dict[str, Any], eager: Any) -> Iterator[tuple[str, str]]:
    def check(name: str, got: Any, wanted: Any, rtol: float) -> Iterator[tuple[str, str]]:
        a, b = judge.numbers_of(got), judge.numbers_of(wanted)
        for key in b:
            if not judge.close(a[key], b[key], rtol):
                yield f"under {name}", f"{key}: {a[key].tolist()} where {b[key].tolist()} is right"

    if "jit" in values:
        yield from check("jit", values["jit"], eager, 1e-9)
    for name in ("vmap", "scan"):
        if name in values:
            for i in range(2):
                one = jax.tree.map(lambda leaf, i=i: leaf[i], values[name])
                yield from check(name, one, eager, 1e-9)
    for name in OUTSIDE:
        if name in values and "jvp" in values:
            for i in range(2):
                one = jax.tree.map(lambda leaf, i=i: leaf[i], values[name])
                yield from check(name, one, values["jvp"], 1e-7)
    if "grad" in values:
        slope = np.asarray(values["grad"])
        if not np.isfinite(slope).all():
            yield "under grad", f"not finite: {slope.tolist()}"
        for name in ("jacfwd", "checkpoint"):
            if name in values:
                yield from check(name, values[name], slope, 1e-7)
    if "hessian" in values:
        second = np.asarray(values["hessian"])
        if not np.isfinite(second).all():
            yield "under hessian", f"not finite: {second.tolist()}"
        yield from check("hessian (is it symmetric)", second, second.T, 1e-7)


def _weighed(numbers: Any) -> Any:
    """One number of all that came back, of no particular direction."""
    total = 0.0
    for i, leaf in enumerate(jax.tree.leaves(numbers)):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            weights = jnp.cos(1.0 + i + jnp.arange(leaf.size, dtype=leaf.dtype)).reshape(leaf.shape)
            total = total + jnp.sum(jnp.where(jnp.isfinite(leaf), leaf, 0.0) * weights)
    return total


def _numbers(value: Any) -> Any:
    return [jnp.asarray(leaf) for leaf in jax.tree.leaves(value) if eqx.is_array_like(leaf)]


def _holds_floats(value: Any) -> bool:
    if isinstance(value, str | int | bool) or (
        callable(value) and not isinstance(value, eqx.Module)
    ):
        return False
    return any(
        eqx.is_inexact_array_like(leaf) and not isinstance(leaf, complex)
        for leaf in jax.tree.leaves(value)
    )


def run(patterns: list[str], say: bool, transforms: bool) -> dict[str, Any]:
    """Go through the table."""
    import surface.table  # noqa: F401

    counts: collections.Counter = collections.Counter()
    found, times = [], {}
    for name, call in sorted(TABLE.items()):
        if patterns and not any(fnmatch.fnmatch(name, p) for p in patterns):
            continue
        before = time.process_time()
        for where, what in failures_of(call, counts, transforms):
            found.append([name, where, what])
            if say:
                print(f"{name} | {where} | {what[:400]}", flush=True)
        times[name] = round(time.process_time() - before, 2)
        counts["rows"] += 1
        if counts["rows"] % 20 == 0:
            # Linux lets a process have 65530 memory maps, and every program takes some.
            jax.clear_caches()
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        print(f"{name}: {times[name]} s, {memory} MB", file=sys.stderr)
    return dict(counts=dict(counts), failures=found, times=times)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", action="append", default=[])
    parser.add_argument("--json")
    parser.add_argument("--no-transforms", action="store_true")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    out = run(arguments.only, say=True, transforms=not arguments.no_transforms)
    slow = sorted(out["times"].items(), key=lambda item: -item[1])[:12]
    print(out["counts"], "failures:", len(out["failures"]))
    print("slowest:", slow, "CPU s:", round(time.process_time(), 1), file=sys.stderr)
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(out, file, indent=1)
