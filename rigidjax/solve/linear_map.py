"""A linear function that comes with its own transpose, for forward and for reverse mode.

A loop of unknown length can be differentiated forwards but not transposed, and `jax.custom_vjp`
gives a transpose but no forward mode. Here the rule for tangents is a primitive that knows both
directions, so that `jax.jvp`, `jax.vjp`, `jax.vmap` and forward over reverse all go through.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

Arrays = list[Any]
Map = Callable[..., Arrays]
_ZERO: Any = ad.Zero


def linear_map(function: Map, transposed: Map, given: Arrays, tangents: Arrays) -> Arrays:
    """`function(*given, *tangents)`, whose transpose in `tangents` is `transposed`.

    **Arguments:** `function(*given, *tangents)` linear in the tangents, `transposed(*given,
    *cotangents)` its transpose, both to lists of arrays; neither may close over tracers.
    Derivatives with respect to `given` are taken in forward mode only.
    """
    outs = jax.eval_shape(lambda g, t: function(*g, *t), given, tangents)
    return _linear_map.bind(
        *given,
        *tangents,
        function=function,
        transposed=transposed,
        number=len(given),
        inputs=tuple(_shape(t) for t in tangents),
        results=tuple(_shape(o) for o in outs),
    )


def nan_derivatives(tree: Any, inputs: Any) -> Any:
    """The same numbers; one that is not finite has NaN derivatives by `inputs`, in both modes.

    A state that a run did not reach is NaN by a `where`, whose derivative is 0: a wrong one. A
    number that is not used has the cotangent 0 and leaves the gradient of the others as it is.
    """
    outs, structure = jax.tree.flatten(tree)
    whole = [_is_smooth(a) for a in outs]
    smooth = [a for a, w in zip(outs, whole, strict=True) if w]
    anchors = [a for a in jax.tree.leaves(inputs) if eqx.is_inexact_array(a)]
    told = iter(_with_nan(len(smooth), *smooth, *anchors))
    outs = [next(told) if w else a for a, w in zip(outs, whole, strict=True)]
    return jax.tree.unflatten(structure, outs)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _with_nan(count: int, *numbers: Array) -> Arrays:
    return list(numbers[:count])


@_with_nan.defjvp
def _(count: int, primals: Any, tangents: Any) -> Any:
    outs = list(primals[:count])
    there = [jnp.isfinite(a) for a in outs]
    # What the transpose has to know of the inputs is their shapes.
    given = [*there, *[jnp.zeros_like(a) for a in primals[count:]]]

    def along(*args: Array) -> Arrays:
        moved = args[len(given) : len(given) + count]
        return [jnp.where(t, m, jnp.nan) for t, m in zip(args[:count], moved, strict=True)]

    def back(*args: Array) -> Arrays:
        there, inputs, bars = args[:count], args[count : len(given)], args[len(given) :]
        bad = jnp.asarray(False)
        for t, bar in zip(there, bars, strict=True):
            bad = bad | jnp.any(~t & (bar != 0))
        kept = [jnp.where(t, bar, 0) for t, bar in zip(there, bars, strict=True)]
        return [*kept, *[jnp.where(bad, jnp.full_like(a, jnp.nan), a) for a in inputs]]

    return outs, linear_map(along, back, given, list(tangents))


def _shape(a: Any) -> tuple[tuple[int, ...], Any]:
    return tuple(jnp.shape(a)), jnp.result_type(a)


def _is_smooth(a: Any) -> bool:
    return bool(jnp.issubdtype(jnp.result_type(a), jnp.inexact))


def no_tangent(a: Any) -> Any:
    """The tangent of a number that depends on nothing."""
    return jnp.zeros_like(a) if _is_smooth(a) else np.zeros(jnp.shape(a), jax.dtypes.float0)


def _jvp(function: Map, primals: Any, tangents: Any) -> Arrays:
    return jax.jvp(lambda *p: function(*p), tuple(primals), tuple(tangents))[1]


_linear_map = Primitive("rigidjax_linear_map")
_linear_map.multiple_results = True


@_linear_map.def_impl
def _evaluated(*args: Any, function: Map, **_: Any) -> Arrays:
    return function(*args)


@_linear_map.def_abstract_eval
def _abstract(*_: Any, results: Any, **__: Any) -> Any:
    return [ShapedArray(*result) for result in results]


def _differentiated(primals: Any, tangents: Any, **params: Any) -> Any:
    number, function = params["number"], params["function"]
    out = _linear_map.bind(*primals, **params)
    given, along = primals[:number], primals[number:]
    total: list[Any] = [None] * len(out)

    def add(more: Any) -> None:
        for i, value in enumerate(more):
            total[i] = value if total[i] is None else total[i] + value

    moved = tangents[number:]
    if not all(isinstance(t, ad.Zero) for t in moved):
        moved = [_whole(t, p) for t, p in zip(moved, along, strict=True)]
        add(_linear_map.bind(*given, *moved, **params))
    which = [
        not isinstance(t, ad.Zero) and _is_smooth(p)
        for t, p in zip(tangents[:number], given, strict=True)
    ]
    if any(which):

        def push(*args: Any) -> Arrays:
            given, along = args[:number], args[number : number + len(along_)]
            moved = _filled_zero(given, which, args[number + len(along_) :])
            return _jvp(lambda *g: function(*g, *along), given, moved)

        along_ = along
        moved = [t for t, w in zip(tangents[:number], which, strict=True) if w]
        add(linear_map(push, refuse, [*given, *along], moved))
    return out, [
        _ZERO.from_primal_value(o) if t is None else t for o, t in zip(out, total, strict=True)
    ]


def _filled_zero(primals: Any, which: Any, tangents: Any) -> list[Any]:
    rest, out = iter(tangents), []
    for primal, there in zip(primals, which, strict=True):
        out.append(next(rest) if there else no_tangent(primal))
    return out


def refuse(*_: Any) -> Arrays:
    """The transpose of what has none."""
    raise TypeError(
        "second derivatives through a solver are forward over reverse: wanted "
        "jax.jacfwd(jax.grad(f)) or jax.hessian(f), got reverse mode over a derivative, such as "
        "jax.grad(jax.grad(f))"
    )


def _transposed(cotangents: Any, *args: Any, **params: Any) -> Any:
    number = params["number"]
    given = args[:number]
    if any(ad.is_undefined_primal(g) for g in given):
        refuse()
    whole = [
        jnp.zeros(*result) if isinstance(c, ad.Zero) else c
        for c, result in zip(cotangents, params["results"], strict=True)
    ]
    found = _linear_map.bind(
        *given,
        *whole,
        function=params["transposed"],
        transposed=params["function"],
        number=number,
        inputs=params["results"],
        results=params["inputs"],
    )
    return [None] * number + list(found)


def _batched(args: Any, dims: Any, **params: Any) -> Any:
    number = params["number"]
    size = next(a.shape[d] for a, d in zip(args, dims, strict=True) if d is not None)
    given, own = args[:number], dims[:number]
    along = [
        jnp.broadcast_to(a, (size, *a.shape)) if d is None else jnp.moveaxis(a, d, 0)
        for a, d in zip(args[number:], dims[number:], strict=True)
    ]

    def over(function: Map, count: int) -> Map:
        return jax.vmap(function, in_axes=(*own, *[0] * count), out_axes=0, axis_size=size)

    def longer(shapes: Any) -> Any:
        return tuple(((size, *shape), dtype) for shape, dtype in shapes)

    out = _linear_map.bind(
        *given,
        *along,
        function=over(params["function"], len(params["inputs"])),
        transposed=over(params["transposed"], len(params["results"])),
        number=number,
        inputs=longer(params["inputs"]),
        results=longer(params["results"]),
    )
    return out, [0] * len(out)


def _whole(tangent: Any, primal: Any) -> Any:
    return jnp.zeros_like(primal) if isinstance(tangent, ad.Zero) else tangent


ad.primitive_jvps[_linear_map] = _differentiated
ad.primitive_transposes[_linear_map] = _transposed
batching.primitive_batchers[_linear_map] = _batched
mlir.register_lowering(
    _linear_map,
    mlir.lower_fun(lambda *args, function, **_: function(*args), multiple_results=True),
)
