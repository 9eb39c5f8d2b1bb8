"""A body as the ellipsoid that moves as it does, and how sure a fit is of it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from rigidjax import _checks
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.plot.style import AXES, COLOURS, plain, row_of_axes

_PLANES = ((0, 1), (0, 2), (1, 2))


def inertia_ellipsoid(
    body: Any,
    *,
    truth: Inertia | MassProperties | None = None,
    samples: int = 200,
    title: str = "",
    ax: Any = None,
) -> Any:
    """The outline of a body's ellipsoid from three sides; of a fit, with its uncertainty.

    The ellipsoid `r·𝔖⁻¹r = const` is long where the body is long and moves as the body does. Of a
    `MassProperties` it is the uniform solid one of the same mass, in m; of an `Inertia`, which has
    no size, it is drawn in units of √Tr 𝔖 of the body given (of the fit's best). Thin lines are
    bodies drawn from the fit's Gaussian: where they lie apart, the data do not say.

    **Arguments:** `body` an `Inertia`, a `MassProperties` or a `rigidjax.identify.Fit`; `truth` a
    body to compare with, drawn broken; `samples` how many thin lines; `title`; `ax` three axes of
    yours. **Returns** the axes (3,), planes xy, xz and yz of the body frame.

    **Raises** `TypeError` for what is none of these, `ValueError` for a body without extension.

    >>> import rigidjax as rj
    >>> [one.get_xlabel() for one in inertia_ellipsoid(rj.shapes.box(1.0, [1.0, 2.0, 3.0]))]
    ['x, m', 'x, m', 'y, m']
    """
    samples = _checks.whole(samples, "samples", 0)
    if isinstance(body, Inertia | MassProperties):
        _checks.single(body, (Inertia, MassProperties), "body")
        best, drawn = body, None
    elif hasattr(body, "parameters") and hasattr(body, "problem"):
        if isinstance(body.body, dict):
            raise ValueError(
                "inertia_ellipsoid: wanted one body, got a Fit of several: give fit.body[name]"
            )
        best, drawn = body.body, _drawn(body, samples)
    else:
        raise TypeError(
            "inertia_ellipsoid: wanted an Inertia, a MassProperties or a Fit, got "
            f"{type(body).__name__}"
        )
    size = 1.0
    if isinstance(best, Inertia):
        size = float(np.trace(np.asarray(best.second_moment)))
        if not size > 0:
            raise ValueError("inertia_ellipsoid: the body has no extension, its 𝔖 is zero")
    unit = "relative size" if isinstance(best, Inertia) else "m"
    ax = row_of_axes(ax, 3, figsize=(10.5, 3.9))
    middle = np.asarray(_shape(best)) / size
    cloud = None if drawn is None else np.asarray(jax.vmap(_shape)(drawn)) / size
    other = None
    if truth is not None:
        other = np.asarray(_shape(truth))
        # A body known up to scale only is compared in shape.
        own = isinstance(best, MassProperties) and isinstance(truth, MassProperties)
        other = other / (1.0 if own else float(np.trace(other)))
    # The outline reaches √A_ii along axis i. One scale for all three: the panels can be compared.
    shown = [
        s for s in (middle[None], cloud, None if other is None else other[None]) if s is not None
    ]
    reach = 1.1 * max(float(np.sqrt(np.einsum("nii->ni", s).max())) for s in shown)
    told = "within the uncertainty"
    if cloud is not None:
        apart = np.sqrt(np.einsum("nii->ni", cloud)) - np.sqrt(np.diag(middle))
        told = (
            told
            if np.abs(apart).max(initial=0.0) > 0.01 * reach
            else "uncertainty: below a line's width"
        )
    for one, (i, j) in zip(ax, _PLANES, strict=True):
        if cloud is not None:
            for shape in cloud:
                one.plot(*_outline(shape, i, j), color=COLOURS[5], lw=0.5, alpha=0.25)
            one.plot([], [], color=COLOURS[5], lw=1, label=told)
        one.plot(*_outline(middle, i, j), color=COLOURS[0], lw=2, label="body")
        if other is not None:
            one.plot(*_outline(other, i, j), color=COLOURS[1], lw=1.6, ls="--", label="truth")
        one.set_aspect("equal")
        one.set(xlim=(-reach, reach), ylim=(-reach, reach))
        one.grid(alpha=0.3)
        one.set(xlabel=f"{AXES[i]}, {unit}", ylabel=f"{AXES[j]}, {unit}")
    if cloud is not None or other is not None:
        ax[0].figure.legend(
            *ax[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False
        )
    ax[1].set_title(plain(title) or "outline of the body's ellipsoid, body frame")
    return ax


def _shape(body: Inertia | MassProperties) -> Any:
    """The matrix whose ellipsoid r·A⁻¹r = 1 is drawn."""
    if isinstance(body, MassProperties):
        return body.second_moment * (5.0 / body.mass)
    return body.second_moment


def _drawn(found: Any, samples: int) -> Any:
    """Bodies drawn from the fit's Gaussian, with a leading axis."""
    flat, restore = ravel_pytree(found.parameters)
    values, vectors = np.linalg.eigh(np.asarray(found.seen))
    # A fixed seed: the same fit gives the same picture.
    steps = np.random.default_rng(0).standard_normal((samples, values.size))
    steps = steps * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    return jax.vmap(lambda step: found.problem.unpack(restore(flat + step))[0])(
        jnp.asarray(steps, flat.dtype)
    )


def _outline(shape: np.ndarray, i: int, j: int) -> np.ndarray:
    """The silhouette of r·A⁻¹r = 1 on a coordinate plane: the ellipse of the 2 × 2 block of A."""
    block = shape[np.ix_((i, j), (i, j))]
    values, vectors = np.linalg.eigh(block)
    angle = np.linspace(0, 2 * np.pi, 121)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)
