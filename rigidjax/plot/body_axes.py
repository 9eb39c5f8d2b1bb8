"""Where the body axes point, on the unit sphere."""

from typing import Any

from rigidjax._types import HasAttitude
from rigidjax.plot.style import (
    COLOURS,
    around_ball,
    attitudes,
    cube,
    globe,
    matrices,
    plain,
    solid_axes,
)


def body_axes(states: HasAttitude, *, title: str = "", ax: Any = None) -> Any:
    """The paths of the three body axes on the unit sphere, world frame.

    A dot marks the start, a triangle the end; what lies behind the sphere is faint.

    **Arguments:** `states` of one body with a leading time axis; `title`; `ax` 3-D axes of yours,
    turned as you like (`view_init`) before the call. **Returns** the axes.

    **Raises** `TypeError` for states without an attitude or flat axes, `ValueError` for a batch.

    >>> import rigidjax as rj
    >>> sol = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 3.0),
    ...                   rj.Attitude([1.0, 0, 0, 0], [0, 1, 0.1]), [0.0, 1.0, 2.0])
    >>> body_axes(sol.ys).get_zlabel()
    'z'
    """
    m = matrices(attitudes(states))
    ax = solid_axes(ax)
    globe(ax, (1.0, 1.0, 1.0), "0.8", 0.12)
    for axis, colour in enumerate(COLOURS[:3]):
        path = m[:, :, axis]
        around_ball(ax, path, path, color=colour, lw=1.6, label=f"body {'xyz'[axis]} axis")
        ax.plot(*path[:1].T, color=colour, marker="o", ms=6, ls="")
        ax.plot(*path[-1:].T, color=colour, marker="^", ms=7, ls="")
    cube(ax, 1.0, ("x", "y", "z"))
    ax.legend(loc="upper left", fontsize=9)
    ax.set_title(plain(title) or "body axes on the unit sphere, world frame")
    return ax
