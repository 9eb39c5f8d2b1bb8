"""What an argument is replaced by: other shapes, other numbers, other kinds of thing."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import rigidjax as rj

SIZES = {"huge": 1e308, "large": 1e100, "small": 1e-100, "tiny": 1e-308}


@dataclasses.dataclass(frozen=True)
class Replacement:
    """One thing in the place of an argument.

    **Fields:** `name`; `value`; `group` one of

    - `same`: the same numbers in another form; refused, or the result is that of the good call;
    - `single`: the same numbers in fewer digits; refused, or the result agrees to those;
    - `whole`: integers; refused, or the result is that of `like`, the same numbers as floats;
    - `stranger`: what cannot be meant: refused;
    - `shape`, `kind`: another shape, another kind of thing; refused, or numbers that are no NaN;
    - `size`: finite numbers that are zero, negative, or as large or small as floats get; as before;
    - `function`: a function of another kind: as `shape`, or Python says that it cannot be called so;
    - `nan`, `inf`: not to be lost: refused, or the result is not finite either.
    """

    name: str
    value: Any
    group: str
    like: Any = None


class Wrong(eqx.Module):
    """A Module that is none of the library's."""

    number: Any = 1.0


def replacements(value: Any) -> Iterator[Replacement]:
    """What may stand in for `value`, by what it is."""
    if isinstance(value, bool):
        yield Replacement("bool_", np.bool_(value), "same")
    elif isinstance(value, int):
        yield from _counts(value)
    elif isinstance(value, str):
        yield from _words()
    elif _is_key(value):
        yield from _keys()
    elif isinstance(value, jax.Array | np.ndarray | float | np.floating):
        yield from _numbers(value)
    elif isinstance(value, Sequence) and value and _all_numbers(value):
        yield from _numbers(np.asarray(value, float))
    elif isinstance(value, eqx.Module) or _is_tree(value):
        yield from _trees(value)
    elif isinstance(value, Sequence | Mapping):
        yield from _several(value)
    elif callable(value):
        yield from _functions()
    else:
        raise TypeError(f"no replacements for a {type(value).__name__}")


def _numbers(value: Any) -> Iterator[Replacement]:
    a = np.asarray(value)
    if a.dtype.kind in "iub":
        yield from _whole_numbers(a)
        return
    half = jnp.float16, jnp.bfloat16
    yield Replacement("list", a.tolist(), "same")
    yield Replacement("numpy", a if a.ndim else np.float64(a), "same")
    yield Replacement("array", jnp.asarray(a), "same")
    if a.ndim:
        yield Replacement("tuple", _tuples(a.tolist()), "same")
        yield Replacement("read-only view", a[::1], "same")
    yield Replacement("float32", jnp.asarray(a, jnp.float32), "single")
    yield Replacement("integers", np.rint(a).astype(int), "whole", np.rint(a))
    yield Replacement("list of integers", np.rint(a).astype(int).tolist(), "whole", np.rint(a))
    yield Replacement("int8", np.rint(a).astype(np.int8), "whole", np.rint(a))
    for kind in half:
        yield Replacement(jnp.dtype(kind).name, jnp.asarray(a, kind), "kind")
    yield Replacement("bool", a > 0, "kind")
    yield Replacement("complex", a + 0j, "stranger")
    yield Replacement("longdouble", a.astype(np.longdouble), "same")

    yield Replacement("empty", np.zeros((0,)), "shape")
    yield Replacement("one element", a.reshape(-1)[:1].copy(), "shape")
    yield Replacement("one row", a[None], "shape")
    yield Replacement("two rows", np.stack([a, a]), "shape")
    if a.ndim:
        yield Replacement("scalar", float(a.reshape(-1)[0]), "shape")
        yield Replacement("longer", np.concatenate([a, a[..., :1]], axis=-1), "shape")
        yield Replacement("shorter", a[..., :-1], "shape")
        yield Replacement("no rows", a[:0], "shape")
    if a.ndim == 2:
        yield Replacement("transposed", a.T.copy(), "kind")

    some = a.copy().reshape(-1)
    some[-1] = np.nan
    yield Replacement("nan", some.reshape(a.shape), "nan")
    yield Replacement("all nan", np.full(a.shape, np.nan), "nan")
    some = a.copy().reshape(-1)
    some[-1] = np.inf
    yield Replacement("inf", some.reshape(a.shape), "inf")
    yield Replacement("all -inf", np.full(a.shape, -np.inf), "inf")
    largest = np.abs(a).max() or 1.0
    for name, size in (SIZES | {"subnormal": 5e-324}).items():
        yield Replacement(name, np.where(a == 0, 1.0, a / largest) * size, "size")
    yield Replacement("zero", np.zeros(a.shape), "size")
    yield Replacement("negative", -a, "size")

    yield from _strangers()
    yield Replacement("ragged", [[1.0], [1.0, 2.0]], "kind")
    yield Replacement("list of None", [None] * max(a.size, 1), "stranger")
    yield Replacement("list of strings", ["1.0"] * max(a.size, 1), "stranger")
    yield Replacement("strings", np.array(["1.0"] * max(a.size, 1)), "stranger")
    yield Replacement("objects", np.array([None] * max(a.size, 1), object), "stranger")
    yield Replacement("dates", np.array(["2020-01-01"], "datetime64[s]"), "stranger")
    yield Replacement("key", jax.random.key(0), "stranger")
    yield Replacement("function", lambda *args: 1.0, "stranger")
    yield Replacement("state", rj.Spin([0.0, 0.0, 1.0]), "stranger")


def _whole_numbers(a: np.ndarray) -> Iterator[Replacement]:
    """Indices, masks."""
    yield Replacement("list", a.tolist(), "same")
    yield Replacement("array", jnp.asarray(a), "same")
    if a.dtype.kind != "b":
        yield Replacement("floats", a.astype(float), "kind")
        yield Replacement("negative", -a - 1, "kind")
        yield Replacement("too large", a + 10**6, "kind")
    yield Replacement("empty", a[:0], "shape")
    yield Replacement("one row", a[None], "shape")
    yield Replacement("scalar", a.reshape(-1)[0], "shape")
    yield from _strangers()
    yield Replacement("ragged", [[1], [1, 2]], "kind")


def _counts(value: int) -> Iterator[Replacement]:
    yield Replacement("numpy integer", np.int64(value), "same")
    yield Replacement("array", jnp.asarray(value), "same")
    yield Replacement("zero", 0, "kind")
    yield Replacement("negative", -1, "kind")
    yield Replacement("a half", 1.5, "kind")
    yield Replacement("nan", float("nan"), "kind")
    yield Replacement("inf", float("inf"), "kind")
    yield Replacement("many", [value, value], "kind")
    yield from _strangers()


def _words() -> Iterator[Replacement]:
    yield Replacement("nonsense", "nonsense", "stranger")
    yield Replacement("empty string", "", "stranger")
    yield Replacement("bytes", b"abc", "stranger")
    yield Replacement("array", np.ones(3), "kind")
    yield from _strangers(strings=False)


def _keys() -> Iterator[Replacement]:
    yield Replacement("old key", jax.random.PRNGKey(0), "kind")
    yield Replacement("number", 3, "kind")
    yield Replacement("floats", np.ones(2), "kind")
    yield Replacement("two keys", jax.random.split(jax.random.key(0)), "kind")
    yield from _strangers()


def _trees(value: Any) -> Iterator[Replacement]:
    """Bodies, states, scenes, recordings: what holds arrays."""
    yield Replacement("on the host", jax.tree.map(_on_host, value), "same")
    floats = [leaf for leaf in jax.tree.leaves(value) if _is_float(leaf)]
    if floats:
        yield Replacement("float32", _with(value, lambda a: a.astype(jnp.float32)), "single")
        yield Replacement("float16", _with(value, lambda a: a.astype(jnp.float16)), "kind")
        yield Replacement("two", _with(value, lambda a: jnp.stack([a, a])), "shape")
        yield Replacement("none", _with(value, lambda a: jnp.zeros((0, *a.shape))), "shape")
        yield Replacement("flat", _with(value, lambda a: a.reshape(-1)[:1]), "shape")
        yield Replacement("nan", _first(value, _with_nan), "nan")
        yield Replacement("all nan", _with(value, lambda a: jnp.full_like(a, jnp.nan)), "nan")
        yield Replacement("all inf", _with(value, lambda a: jnp.full_like(a, jnp.inf)), "inf")
        for name, size in SIZES.items():
            yield from _made(name, _first(value, lambda a, size=size: _scaled(a, size)))
        yield from _made("zero", _first(value, jnp.zeros_like))
        yield from _made("negative", _first(value, jnp.negative))
        yield Replacement("its array", np.asarray(floats[0]), "kind")
    yield from _strangers()
    yield Replacement("its class", type(value), "stranger")
    yield Replacement("a list of it", [value], "kind")
    yield Replacement("another Module", Wrong(), "stranger")
    for stranger in (rj.Point([1.0, 0, 0], [0.0, 1, 0]), rj.Spin([0.0, 0, 1.0])):
        if type(stranger) is not type(value):
            yield Replacement(type(stranger).__name__, stranger, "kind")


def _made(name: str, value: Any) -> Iterator[Replacement]:
    """A body of other numbers, if its constructor makes one: what it refuses is its own row's."""
    if isinstance(value, rj.MassProperties):
        try:
            value = rj.MassProperties(value.mass, value.com, value.second_moment)
        except ValueError:
            return
    yield Replacement(name, value, "size")


def _several(value: Any) -> Iterator[Replacement]:
    if type(value) in (list, tuple, dict):
        yield Replacement("nothing in it", type(value)(), "kind")
    yield Replacement("list of None", [None], "stranger")
    yield Replacement("list of strings", ["a"], "stranger")
    yield Replacement("array", np.ones(3), "kind")
    yield from _strangers()


def _functions() -> Iterator[Replacement]:
    yield Replacement("takes nothing", lambda: 0.0, "function")
    yield Replacement("returns None", lambda *args: None, "function")
    yield Replacement("returns words", lambda *args: "abc", "function")
    yield Replacement("returns seven", lambda *args: jnp.ones(7), "function")
    yield Replacement("returns nan", lambda *args: jnp.full((3,), jnp.nan), "function")
    yield Replacement("array", np.ones(3), "stranger")
    yield from _strangers()


def _strangers(strings: bool = True) -> Iterator[Replacement]:
    yield Replacement("None", None, "stranger")
    if strings:
        yield Replacement("string", "abc", "stranger")
        yield Replacement("number in words", "1.0", "stranger")
    yield Replacement("object", object(), "stranger")
    yield Replacement("dict", {}, "stranger")
    yield Replacement("class", dict, "stranger")
    yield Replacement("empty list", [], "stranger")
    if not strings:
        yield Replacement("number", 3.0, "stranger")


def with_floats(value: Any, change: Callable[[Any], Any]) -> Any:
    """The tree with every floating array changed."""
    return _with(value, change)


def _with(value: Any, change: Callable[[Any], Any]) -> Any:
    return jax.tree.map(lambda leaf: change(jnp.asarray(leaf)) if _is_float(leaf) else leaf, value)


def _first(value: Any, change: Callable[[Any], Any]) -> Any:
    """The tree with its first floating array changed."""
    done = False

    def one(leaf: Any) -> Any:
        nonlocal done
        if done or not _is_float(leaf):
            return leaf
        done = True
        return change(jnp.asarray(leaf))

    return jax.tree.map(one, value)


def _with_nan(a: jax.Array) -> jax.Array:
    return a.reshape(-1).at[-1].set(jnp.nan).reshape(a.shape)


def _scaled(a: jax.Array, size: float) -> jax.Array:
    largest = jnp.abs(a).max()
    return a / jnp.where(largest > 0, largest, 1.0) * size


def _on_host(leaf: Any) -> Any:
    return np.asarray(leaf) if isinstance(leaf, jax.Array) and not _is_key(leaf) else leaf


def _is_float(leaf: Any) -> bool:
    return eqx.is_inexact_array_like(leaf) and not isinstance(leaf, complex)


def _is_key(value: Any) -> bool:
    return isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key)


def _all_numbers(value: Any) -> bool:
    try:
        return np.asarray(value, float).dtype.kind == "f"
    except (TypeError, ValueError):
        return False


def _is_tree(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(part) for part in value) if isinstance(value, list) else value
