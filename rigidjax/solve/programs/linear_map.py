"""Define a linear function together with a transpose of its own.

The function that computes the tangents of a run is such a function. It is called by a JAX primitive
that holds the function and its transpose. Then `jax.jvp`, `jax.vjp`, `jax.vmap` and forward over
reverse mode all work for a loop of unknown length; with `jax.custom_vjp` forward mode would not
work.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.custom_derivatives import zero_from_primal
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from rigidjax.rotation.barrier import match_batch_axes

Arrays = list[Any]
Map = Callable[..., Arrays]
_ZERO: Any = ad.Zero


def linear_map(function: Map, transposed: Map, given: Arrays, tangents: Arrays) -> Arrays:
    """Call a function `(*given, *tangents)`, linear in `tangents`, and give it a transpose.

    Reverse mode calls `transposed(*given, *bars)` for the cotangents of `tangents`. Neither
    function may close over tracers. Derivatives with respect to `given` exist in forward mode only.
    """
    outs = jax.eval_shape(lambda g, t: function(*g, *t), given, tangents)
    inputs, results = (
        tuple((tuple(jnp.shape(a)), jnp.result_type(a)) for a in arrays)
        for arrays in (tangents, outs)
    )
    how = dict(number=len(given), inputs=inputs, results=results)
    return _linear_map.bind(*given, *tangents, function=function, transposed=transposed, **how)


def with_derivatives(known: PyTree, recomputed: PyTree) -> PyTree:
    """Return the numbers of `known`, with the derivatives of every order of `recomputed`.

    Both trees hold the same numbers, computed in two ways; the values of `recomputed` may be NaN.
    """
    return jax.tree.map(_known, known, recomputed)


@jax.custom_jvp
def _known(known: Array, recomputed: Array) -> Array:
    """Return the array `known`, with the derivatives of `recomputed`."""
    return match_batch_axes(known, (known, recomputed))


@_known.defjvp
def _known_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> Any:
    return _known(*primals), tangents[1]


def nan_derivatives(tree: PyTree, inputs: PyTree) -> PyTree:
    """Return `tree`, in which each number that is not finite gets NaN derivatives by all `inputs`.

    A run sets a state that it did not reach to NaN by `jnp.where`, whose derivative 0 is wrong. A
    number that later code does not use has the cotangent 0, and does not change the gradient.
    """
    smooth, rest = eqx.partition(tree, eqx.is_inexact_array)
    outs, structure = jax.tree.flatten(smooth)
    anchors = jax.tree.leaves(eqx.filter(inputs, eqx.is_inexact_array))
    return eqx.combine(structure.unflatten(_nan_derivatives(len(outs), *outs, *anchors)), rest)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _nan_derivatives(count: int, *numbers: Array) -> Arrays:
    """Return the first `count` arrays; those after them are the inputs of derivatives."""
    return match_batch_axes(list(numbers[:count]), numbers)


@_nan_derivatives.defjvp
def _(count: int, primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
    outs = _nan_derivatives(count, *primals)

    def along(*args: Array) -> Arrays:
        moved = args[count : 2 * count]
        return [jnp.where(t, m, jnp.nan) for t, m in zip(args[:count], moved, strict=True)]

    def back(*args: Array) -> Arrays:
        there, bars = args[:count], args[count:]
        kept = [jnp.where(t, bar, 0) for t, bar in zip(there, bars, strict=True)]
        bad = [jnp.any(~t & (bar != 0)) for t, bar in zip(there, bars, strict=True)]
        lost = jnp.where(jnp.any(jnp.stack(bad)), jnp.nan, 0)
        return [*kept, *[jnp.full(a.shape, lost, a.dtype) for a in primals[count:]]]

    return outs, linear_map(along, back, [jnp.isfinite(a) for a in outs], list(tangents))


_linear_map = Primitive("rigidjax_linear_map")
_linear_map.multiple_results = True


# The rules of the primitive follow. `params` are the map, its transpose, the `number` of the
# arguments in which the map may be nonlinear, and the shapes and dtypes of the other arguments
# (`inputs`) and of the results.


def _jvp_rule(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...], **params: Any) -> Any:
    number, function = params["number"], params["function"]
    out, parts = _linear_map.bind(*primals, **params), []
    moving = [not isinstance(t, ad.Zero) for t in tangents]
    if any(moving[number:]):
        whole = [
            t if m else jnp.zeros_like(p) for t, m, p in zip(tangents, moving, primals, strict=True)
        ]
        parts.append(_linear_map.bind(*primals[:number], *whole[number:], **params))
    which = [m and eqx.is_inexact_array(p) for m, p in zip(moving[:number], primals, strict=False)]
    if any(which):

        def push(*args: Any) -> Arrays:
            given, along = args[:number], args[number : len(primals)]
            rest = iter(args[len(primals) :])
            both = zip(given, which, strict=True)
            moved = [next(rest) if w else zero_from_primal(g) for g, w in both]
            return jax.jvp(lambda *g: function(*g, *along), given, tuple(moved))[1]

        moved = [t for t, w in zip(tangents, which, strict=False) if w]
        parts.append(linear_map(push, no_transpose, list(primals), moved))
    if not parts:
        return out, [_ZERO.from_primal_value(o) for o in out]
    return out, [sum(more, first) for first, *more in zip(*parts, strict=True)]


def no_transpose(*_: Any) -> Arrays:
    """Raise the `TypeError` of a map without a transpose: reverse mode over a derivative."""
    raise TypeError(
        "second derivatives through a solver are forward over reverse: wanted "
        "jax.jacfwd(jax.grad(f)) or jax.hessian(f), got reverse mode over a derivative, such as "
        "jax.grad(jax.grad(f))"
    )


def _transpose_rule(cotangents: Any, *args: Any, **params: Any) -> Any:
    number = params["number"]
    given = args[:number]
    if any(ad.is_undefined_primal(g) for g in given):
        no_transpose()
    whole = [
        jnp.zeros(*result) if isinstance(c, ad.Zero) else c
        for c, result in zip(cotangents, params["results"], strict=True)
    ]
    turned = dict(function=params["transposed"], transposed=params["function"])
    turned |= dict(inputs=params["results"], results=params["inputs"])
    return [None] * number + _linear_map.bind(*given, *whole, number=number, **turned)


def _batch_rule(args: Any, dims: Any, **params: Any) -> Any:
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

    inputs, results = params["inputs"], params["results"]
    both = dict(function=over(params["function"], len(inputs)), inputs=longer(inputs))
    both |= dict(transposed=over(params["transposed"], len(results)), results=longer(results))
    return _linear_map.bind(*given, *along, number=number, **both), [0] * len(results)


def _call(*args: Any, function: Map, **_: Any) -> Arrays:
    return function(*args)


_linear_map.def_impl(_call)
_linear_map.def_abstract_eval(lambda *_, results, **__: [ShapedArray(*one) for one in results])
ad.primitive_jvps[_linear_map] = _jvp_rule
ad.primitive_transposes[_linear_map] = _transpose_rule
batching.primitive_batchers[_linear_map] = _batch_rule
mlir.register_lowering(_linear_map, mlir.lower_fun(_call, multiple_results=True))
