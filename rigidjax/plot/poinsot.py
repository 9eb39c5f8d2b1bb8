"""Draw the paths of the body axes, and Poinsot's polhode and herpolhode."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasSpin
from rigidjax.body.energy import spatial_angular_momentum
from rigidjax.body.inertia import Inertia
from rigidjax.plot import style
from rigidjax.plot.style import COLOURS, escape_formulas, host_rows


def body_axes(states: HasAttitude, *, title: str = "", ax: Any = None) -> Any:
    """Draw the paths of the three body axes on the unit sphere, world frame.

    A dot marks the start, a triangle the end; the path behind the sphere is faint. **Arguments:**
    `states` of one body with a leading time axis; `title`; `ax` your 3-D axes; set the viewing
    direction (`view_init`) before the call. **Returns** the axes.

    >>> sol = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 3.0),
    ...                   rj.Attitude([1.0, 0, 0, 0], [0, 1, 0.1]), [0.0, 1.0, 2.0])
    >>> body_axes(sol.ys).get_zlabel()
    'z'
    """
    m = style.rotation_matrices(style.host_attitudes(states))
    ax = style.axes_3d_or_new(ax)
    style.draw_sphere(ax, "0.8", 0.12)
    for axis, colour in enumerate(COLOURS[:3]):
        path = m[:, :, axis]
        style.draw_on_sphere(ax, path, color=colour, lw=1.6, label=f"body {'xyz'[axis]} axis")
        ax.plot(*path[:1].T, color=colour, marker="o", ms=6, ls="")
        ax.plot(*path[-1:].T, color=colour, marker="^", ms=7, ls="")
    # The marks in the legend are grey, since every body axis has such marks.
    for mark, name in (("o", "start"), ("^", "end")):
        ax.plot([], [], [], color="0.4", marker=mark, ms=6, ls="", label=name)
    style.set_equal_scales(ax, 1.0, ("x", "y", "z"))
    style.draw_legend_below(ax, distance=0.06)
    ax.set_title(escape_formulas(title) or "body axes on the unit sphere, world frame")
    return ax


def polhode(
    inertia: Inertia,
    states: HasSpin,
    *,
    energies: int = 9,
    title: str = "",
    ax: Any = None,
) -> Any:
    """Draw the path of the angular momentum Π = IΩ in the body.

    The path of a free body lies on the sphere |Π| = h and on the ellipsoid ΣΠᵢ²/Iᵢ = 2T, with the
    principal moments Iᵢ and the kinetic energy T.

    The coordinate axes are the principal axes, with the smallest moment first; the unit of Π is h,
    the length of the initial Π. Thin lines are the paths of other energies at the same h; broken
    lines are the separatrix through the middle axis. Behind the sphere the path of this motion is
    dotted, and all other lines are faint. Source: Landau and Lifshitz, Mechanics, § 37.

    **Arguments:** `inertia`; `states` of one body with a leading time axis; `energies` the number
    of thin lines; `title`; `ax` your 3-D axes. **Returns** the axes. **Raises** `ValueError`
    for a body at rest or with a zero moment of inertia.

    >>> body = rj.Inertia.from_principal(1.0, 2.0, 3.0)
    >>> sol = rj.simulate(body, rj.Spin([0.1, 1.0, 0.0]), [0.0, 1.0, 2.0])
    >>> polhode(body, sol.ys).get_zlabel()
    'Π₃ / h'
    """
    _checks.require_unbatched_instance(inertia, Inertia, "inertia")
    _checks.require_instance(
        states, HasSpin, "states", requirement="a Spin, an Attitude or a Rigid"
    )
    energies = _checks.integer(energies, "energies", 0)
    moments, q = inertia.require_invertible().principal()
    i = np.asarray(moments, dtype=float)
    turn = style.rotation_matrices(np.asarray(q, dtype=float)[None])[0]
    omega = host_rows(states.omega, 3, "states.omega")
    pi = omega @ turn * i
    size = float(np.linalg.norm(pi[0]))
    if not size > 0:
        raise ValueError(
            "polhode: wanted a body that turns, got one at rest, which has no sphere of constant "
            "angular momentum"
        )
    pi = pi / size
    twice_energy = float(np.sum(pi[0] ** 2 / i))

    ax = style.axes_3d_or_new(ax)
    # The drawing order is set here, since matplotlib gives a whole surface a single depth and would
    # draw the sphere over the path.
    ax.computed_zorder = False
    style.draw_sphere(ax, COLOURS[5], 0.15)
    semi_axes = np.sqrt(twice_energy * i)
    # The ellipsoid is drawn as meridians and parallels, so that the sphere inside it stays visible.
    how: dict[str, Any] = dict(color=COLOURS[4], lw=0.5, alpha=0.8, zorder=2)
    ax.plot_wireframe(
        *(semi_axes[:, None, None] * style.sphere_grid()), rstride=4, cstride=6, **how
    )
    # If all moments are equal, the energy is constant on the sphere, and there are no lines to
    # draw.
    if i[2] - i[0] > 1e-9 * i[2]:
        _draw_energies(ax, i, energies)
    how = dict(hidden_style={"ls": (0, (1, 1)), "lw": 1.8}, label="this motion", zorder=5)
    style.draw_on_sphere(ax, pi, color=COLOURS[1], lw=2.6, **how)
    ax.plot(*pi[:1].T, color=COLOURS[1], marker="o", ms=6, ls="", label="start", zorder=6)
    style.set_equal_scales(ax, max(1.0, float(semi_axes.max())), ("Π₁ / h", "Π₂ / h", "Π₃ / h"))
    handles, names = ax.get_legend_handles_labels()
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles += [Patch(color=COLOURS[5], alpha=0.4), Line2D([], [], color=COLOURS[4], lw=0.8)]
    names += ["momentum sphere", "energy ellipsoid"]
    style.draw_legend_below(ax, handles, names, distance=0.06)
    ax.set_title(escape_formulas(title) or "polhode, principal axes of the body")
    return ax


def _draw_energies(ax: Any, moments: np.ndarray, curve_count: int) -> None:
    """Draw curves of equal energy on the unit sphere of the angular momentum, and the separatrix
    through the middle axis; moments ascend.
    """
    import contourpy

    def on_sphere(around: np.ndarray, down: np.ndarray) -> np.ndarray:
        # The pole of the longitude and colatitude is on the axis of the middle moment. No closed
        # curve goes round this axis, so that no curve is cut where the longitude jumps by 2π.
        return style.sphere_points(around, down)[[1, 2, 0]]

    inverse = 1 / moments
    around, down = np.linspace(0, 2 * np.pi, 181), np.linspace(0, np.pi, 91)
    level = np.einsum("i,ijk->jk", inverse, on_sphere(around, down[:, None]) ** 2)
    lines = contourpy.contour_generator(around, down, level)
    values = np.linspace(inverse[2], inverse[0], curve_count + 2)[1:-1]
    drawn: list[Any] = [(value, dict(lw=0.6, color="0.35", zorder=3)) for value in values]
    if min(moments[1] - moments[0], moments[2] - moments[1]) > 1e-9 * moments[2]:
        how = dict(lw=1.2, color="0.1", ls="--", label="separatrix", zorder=4)
        drawn.append((inverse[1], how))
    for value, how in drawn:
        for curve in lines.lines(value):
            style.draw_on_sphere(ax, on_sphere(*np.asarray(curve).T).T, **how)
            how.pop("label", None)


def herpolhode(inertia: Inertia, states: HasAttitude, *, title: str = "", ax: Any = None) -> Any:
    """Draw the path of ω, the angular velocity in world axes, on the invariable plane.

    The invariable plane is perpendicular to the angular momentum. The motion must be free: the
    component of ω along the angular momentum h is then constant, 2T/h with the kinetic energy T.
    The radii of the two circles are the least and the largest distance of the path from the line
    along h. **Arguments:** `inertia`; `states` (`Attitude`) of one body with a leading time axis;
    `title`; `ax`. **Returns** the axes. **Raises** `ValueError` for a body at rest, and for an
    angular momentum whose direction changes by more than 1e-3 rad.

    >>> body = rj.Inertia.from_principal(1.0, 2.0, 3.0)
    >>> sol = rj.simulate(body, rj.Attitude([1.0, 0, 0, 0], [0.1, 1.0, 0.0]), [0.0, 1.0, 2.0])
    >>> herpolhode(body, sol.ys).get_xlabel()
    'ω along e₁, rad/s'
    """
    m = style.rotation_matrices(style.host_attitudes(states))
    omega = np.einsum("tij,tj->ti", m, host_rows(states.omega, 3, "states.omega"))
    each = jax.vmap(lambda state: spatial_angular_momentum(inertia, state))
    momenta = np.asarray(each(jax.tree.map(jnp.asarray, states)), dtype=float)
    size = np.linalg.norm(momenta, axis=1)
    if not size[0] > 0:
        raise ValueError(
            "herpolhode: wanted a body that turns, got one at rest; it has no invariable plane"
        )
    up = momenta[0] / size[0]
    turned = np.linalg.norm(np.cross(momenta, up), axis=1) / size
    if turned.max() > 1e-3:
        words = f"herpolhode: the angular momentum turned by {turned.max():.2g} rad: "
        raise ValueError(words + "a torque acts, and there is no invariable plane")
    first = omega[0] - (omega[0] @ up) * up
    if np.linalg.norm(first) < 1e-9 * np.linalg.norm(omega[0]):
        # Here ω is parallel to the angular momentum: the body spins about a principal axis, and any
        # direction perpendicular to the momentum serves as the axis e₁ of the picture.
        first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first = first / np.linalg.norm(first)
    path = np.stack([omega @ first, omega @ np.cross(up, first)], axis=-1)

    ax = style.axes_2d_or_new(ax, figsize=(5.2, 5.0))
    ax.plot(*path.T, color=COLOURS[0], lw=1.2)
    ax.plot(*path[0], color=COLOURS[1], marker="o", ms=6, ls="", label="start")
    distance = np.linalg.norm(path, axis=1)
    angle = np.linspace(0, 2 * np.pi, 200)
    for radius in (distance.min(), distance.max()):
        ax.plot(radius * np.cos(angle), radius * np.sin(angle), color="0.5", lw=0.8, ls=":")
    ax.plot(0, 0, color="0.2", marker="+", ms=8, ls="", label="momentum")
    ax.set_aspect("equal")
    ax.set(xlabel="ω along e₁, rad/s", ylabel="ω along e₂, rad/s")
    ax.set_title(escape_formulas(title) or "herpolhode, across the angular momentum")
    style.draw_legend_below(ax)
    return ax
