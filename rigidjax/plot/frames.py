"""Draw the path of a particle in a moving frame and in the inertial frame."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from rigidjax import _checks
from rigidjax.frames import AbstractScene, MovingFrame, Point
from rigidjax.plot.style import (
    AXES,
    COLOURS,
    axes_of_shape,
    escape_formulas,
    host_rows,
    host_times,
)


def frames(
    frame: MovingFrame | AbstractScene,
    ts: Float[ArrayLike, " times"],
    inside: Point,
    *,
    plane: str = "xy",
    unit: str = "m",
    marks: Mapping[str, Any] | None = None,
    title: str = "",
    ax: Any = None,
) -> Any:
    """Draw a path in the moving frame on the left, and in the inertial frame on the right.

    **Arguments:** `frame` the `MovingFrame`, or a scene (the equations of motion of a particle)
    that has one as its `frame`; `ts` (T,) s; `inside` the path in the moving frame, a `Point`
    (position and velocity) with a leading time axis (`frame.from_inertial` makes it from a path in
    the inertial frame); `plane` the two axes that are drawn, such as `xy`; `unit` of length, for
    the labels; `marks` positions (3,) at rest in the moving frame, by name; `title`; `ax` two axes.
    **Returns** the axes (2,).

    >>> turntable = rj.scenes.turntable(1.0)
    >>> ts = jnp.linspace(0.0, 3.0, 20)
    >>> seen = rj.simulate(None, Point([1.0, 0, 0], [0.0, 0, 0]), ts, turntable).ys
    >>> [one.get_title() for one in frames(turntable, ts, seen)]
    ['seen from the moving frame', 'seen from the inertial frame']
    """
    moving: Any = getattr(frame, "frame", frame)
    wanted = "a MovingFrame, or a scene with one such as scenes.turntable"
    _checks.require_instance(moving, MovingFrame, "frame", requirement=wanted)
    _checks.require_instance(inside, Point, "inside")
    known = isinstance(plane, str) and set(plane) <= set(AXES)
    if not known or len(plane) != 2 or plane[0] == plane[1]:
        raise ValueError(f"plane: wanted two of x, y, z such as 'xz', got {plane!r}")
    i, j = (AXES.index(name) for name in plane)
    path = host_rows(inside.x, 3, "inside.x")
    kind = _checks.numeric_array(inside.x, "inside.x").dtype
    t = jnp.asarray(host_times(ts, path.shape[0], "the path has"), kind)
    outside = np.asarray(jax.vmap(moving.to_inertial)(inside, t).x)
    ax = axes_of_shape(ax, (2,), ncols=2, figsize=(9.6, 4.6))
    names = (("moving", path), ("inertial", outside))
    for one, (name, line) in zip(ax, names, strict=True):
        one.plot(line[:, i], line[:, j], color=COLOURS[0], lw=1.2)
        one.plot(*line[0, [i, j]], color=COLOURS[0], marker="o", ms=6, ls="", label="start")
        one.plot(*line[-1, [i, j]], color=COLOURS[0], marker="^", ms=7, ls="", label="end")
        one.set_title(f"seen from the {name} frame")
        one.set_aspect("equal", adjustable="datalim")
        one.grid(alpha=0.3)
        dash = "'" if name == "moving" else ""
        one.set(xlabel=f"{plane[0]}{dash}, {unit}", ylabel=f"{plane[1]}{dash}, {unit}")
    for number, (name, place) in enumerate((marks or {}).items()):
        colour = COLOURS[1 + number % (len(COLOURS) - 1)]
        here = np.asarray(place, dtype=float)
        if here.shape != (3,):
            raise ValueError(f"marks[{name!r}]: wanted a position (3,), got shape {here.shape}")
        still = jax.tree.map(lambda leaf: jnp.zeros_like(leaf), inside)
        still = Point(still.x + jnp.asarray(here, still.x.dtype)[None], still.v)
        moved = np.asarray(jax.vmap(moving.to_inertial)(still, t).x)
        ax[0].plot(
            here[i], here[j], color=colour, marker="s", ms=6, ls="", label=escape_formulas(name)
        )
        ax[1].plot(
            moved[:, i], moved[:, j], color=colour, lw=0.9, ls="--", label=escape_formulas(name)
        )
    ax[1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=9)
    if title:
        ax[0].figure.suptitle(escape_formulas(title))
    return ax
