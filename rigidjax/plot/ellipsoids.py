"""Draw a body as an ellipsoid with the same motion, and the uncertainty of a fitted body."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rigidjax import _checks
from rigidjax.body import validation
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.plot.style import AXES, COLOURS, axes_of_shape, escape_formulas

_PLANES = ((0, 1), (0, 2), (1, 2))


def inertia_ellipsoid(
    body: Any,
    *,
    truth: Inertia | MassProperties | None = None,
    samples: int = 200,
    title: str = "",
    ax: Any = None,
) -> Any:
    """Draw the outline of a body's ellipsoid from three sides; for a fit also draw its uncertainty.

    The ellipsoid `r·𝔖⁻¹r = const`, with the body's second moment 𝔖, is long along the body's long
    axis and moves as the body does. For `MassProperties` it is the uniform solid ellipsoid of equal
    mass, in m. An `Inertia` has no size: lengths are then in units of √Tr 𝔖 of the body (of the
    best body of a fit). Thin lines are bodies sampled from the Gaussian approximation of the fit:
    where the lines differ, the data do not determine the shape.

    **Arguments:** `body` an `Inertia`, a `MassProperties` or a `rigidjax.identify.Fit`; `truth` a
    body to compare with, as a broken line; `samples` the number of sampled bodies; `title`; `ax`
    three axes. **Returns** the axes (3,), for the planes xy, xz and yz of the body frame.
    **Raises** `ValueError` for a body without extension.

    >>> [one.get_xlabel() for one in inertia_ellipsoid(rj.shapes.box(1.0, [1.0, 2.0, 3.0]))]
    ['x, m', 'x, m', 'y, m']
    """
    best, drawn = _samples(body, _checks.integer(samples, "samples", 0))
    solid = isinstance(best, MassProperties)
    size = 1.0 if solid else float(np.trace(np.asarray(best.second_moment)))
    if not size > 0:
        raise ValueError(
            "body: wanted a body of non-zero size, got one whose second moment of mass is zero "
            "(a point), which has no ellipsoid"
        )
    shapes = {"body": np.asarray(_matrix(best))[None] / size}
    if drawn is not None:
        shapes["cloud"] = np.asarray(jax.vmap(_matrix)(drawn)) / size
    if truth is not None:
        other = np.asarray(_matrix(truth))
        # An `Inertia` has no size: unless both bodies are `MassProperties`, only the shapes are
        # compared, and the matrix of `truth` is scaled to trace 1.
        own = solid and isinstance(truth, MassProperties)
        shapes["truth"] = other[None] / (1.0 if own else float(np.trace(other)))
    ax = axes_of_shape(ax, (3,), ncols=3, figsize=(10.5, 3.9))
    _draw(ax, shapes, "m" if solid else "relative size")
    if len(shapes) > 1:
        how = dict(loc="outside lower center", ncols=3, frameon=False)
        ax[0].figure.legend(*ax[0].get_legend_handles_labels(), **how)
    ax[1].set_title(escape_formulas(title) or "outline of the body's ellipsoid, body frame")
    return ax


def _samples(body: Any, samples: int) -> tuple[Inertia | MassProperties, Any]:
    """Return the body, and bodies drawn at random from the Gaussian uncertainty of a fit, as one
    body with a leading axis; `None` for no fit.
    """
    if isinstance(body, Inertia | MassProperties):
        return validation.require_single_body(body, (Inertia, MassProperties), "body"), None
    if not hasattr(body, "x") or not hasattr(body, "model"):
        words = "inertia_ellipsoid: wanted an Inertia, a MassProperties or a Fit, got "
        raise TypeError(words + _checks.type_name(body))
    if isinstance(body.body, dict):
        words = "wanted one body, got a Fit of several: give fit.body[name]"
        raise ValueError(f"inertia_ellipsoid: {words}")
    x = body.point.derivative_point
    values, vectors = np.linalg.eigh(np.asarray(body.determined_covariance))
    # The seed is fixed, so that the same fit always gives the same picture.
    steps = np.random.default_rng(0).standard_normal((samples, values.size))
    steps = jnp.asarray(steps * np.sqrt(np.maximum(values, 0.0)) @ vectors.T, x.dtype)
    return body.body, jax.vmap(lambda step: body.model.bodies(x + step))(steps)


def _draw(ax: Any, matrices: dict[str, np.ndarray], unit: str) -> None:
    """Draw the outlines of ellipsoids r·A⁻¹r = 1 on the planes xy, xz and yz; the names of the
    matrices are `body` and perhaps `cloud` (samples) and `truth`.
    """
    # The outline of r·A⁻¹r = 1 reaches √A_ii along axis i. All three panels have the same scale,
    # for comparison.
    reaches = {name: np.sqrt(np.einsum("nii->ni", shape)) for name, shape in matrices.items()}
    reach = 1.1 * max(float(one.max()) for one in reaches.values())
    apart = np.abs(reaches.get("cloud", reaches["body"]) - reaches["body"]).max(initial=0.0)
    wide = apart > 0.01 * reach
    label = "within the uncertainty" if wide else "uncertainty: below a line's width"
    for one, (i, j) in zip(ax, _PLANES, strict=True):
        if "cloud" in matrices:
            for shape in matrices["cloud"]:
                one.plot(*_outline(shape, i, j), color=COLOURS[5], lw=0.5, alpha=0.25)
            one.plot([], [], color=COLOURS[5], lw=1, label=label)
        outline = _outline(matrices["body"][0], i, j)
        one.plot(*outline, color=COLOURS[0], lw=2, label="body")
        if "truth" in matrices:
            outline = _outline(matrices["truth"][0], i, j)
            one.plot(*outline, color=COLOURS[1], lw=1.6, ls="--", label="truth")
        one.set_aspect("equal")
        one.set(xlim=(-reach, reach), ylim=(-reach, reach))
        one.set(xlabel=f"{AXES[i]}, {unit}", ylabel=f"{AXES[j]}, {unit}")
        one.grid(alpha=0.3)


def _matrix(body: Inertia | MassProperties) -> Any:
    """Return A of the ellipsoid r·A⁻¹r = 1: 5𝔖/mass, m², or 𝔖, kg m², of an `Inertia`."""
    if isinstance(body, MassProperties):
        return body.second_moment * (5.0 / body.mass)
    return body.second_moment


def _outline(matrix: np.ndarray, i: int, j: int) -> np.ndarray:
    """Return points on the outline of the ellipsoid r·A⁻¹r = 1, seen along the axis that is not i
    or j: the ellipse of this block of A.
    """
    values, vectors = np.linalg.eigh(matrix[np.ix_((i, j), (i, j))])
    angle = np.linspace(0, 2 * np.pi, 121)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)
