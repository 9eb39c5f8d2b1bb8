"""Draw the phase portrait of a heavy symmetric top: the tilt and its time derivative."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rigidjax import _checks
from rigidjax._types import HasAttitude
from rigidjax.body import validation
from rigidjax.body.energy import spatial_angular_momentum
from rigidjax.body.inertia import Inertia
from rigidjax.motion.torques import HeavyTop
from rigidjax.plot import style
from rigidjax.plot.style import COLOURS, escape_formulas, host_rows


def phase_portrait(
    inertia: Inertia,
    top: HeavyTop,
    states: HasAttitude,
    *,
    levels: int = 14,
    title: str = "",
    ax: Any = None,
) -> Any:
    """Draw the motion of a symmetric top in the plane of the tilt θ and its rate θ̇, with curves of
    equal energy.

    The energy is `E = ½ I₁ θ̇² + (p_φ − p_ψ cos θ)²/(2 I₁ sin²θ) + m g l cos θ`, with the moment of
    inertia I₁ across the axis, the mass m, gravity g, and the distance l of the centre of mass from
    the pivot. Two angular momenta are taken from the initial state: p_φ about the vertical, and p_ψ
    about the axis of the top. The cross marks steady precession, where the energy is least. Source:
    Landau and Lifshitz, Mechanics, § 35, problem 1.

    **Arguments:** `inertia` about the pivot; `top` the weight and the centre of mass, which is on
    the axis of symmetry; `states` of one body with a leading time axis; `levels` the number of thin
    curves; `title`; `ax`. **Returns** the axes. **Raises** `ValueError` for a body that is not
    symmetric about the axis through the centre of mass, and for one without weight.

    >>> body = rj.Inertia.from_principal(2.0, 2.0, 1.0)
    >>> top = rj.torques.HeavyTop(1.0, [0.0, 0, 1.0], [0, 0, -9.81])
    >>> start = rj.Attitude(rj.quaternion.exp(jnp.array([0.4, 0.0, 0.0])), [0, 0, 20.0])
    >>> phase_portrait(body, top, rj.simulate(body, start, [0.0, 0.1, 0.2], top).ys).get_xlabel()
    'tilt θ, deg'
    """
    inertia = validation.require_single_body(inertia, Inertia, "inertia")
    for name, size in (("mass", ()), ("com", (3,)), ("gravity", (3,))):
        _checks.array_of_shape(
            getattr(_checks.require_instance(top, HeavyTop, "top"), name), size, f"top.{name}"
        )
    levels = _checks.integer(levels, "levels", 1)
    across, along, axis, weight, up = _constants(inertia, top)
    m = style.rotation_matrices(style.host_attitudes(states))
    omega = np.einsum("tij,tj->ti", m, host_rows(states.omega, 3, "states.omega"))
    first = jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], states)
    about_up = float(np.asarray(spatial_angular_momentum(inertia, first)) @ up)
    about_axis = along * float(np.asarray(first.omega) @ axis)
    pointing = m @ axis
    cosine = np.clip(pointing @ up, -1.0, 1.0)
    tilt = np.arccos(cosine)
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = -np.cross(omega, pointing) @ up / np.sin(tilt)

    def potential(theta: np.ndarray) -> np.ndarray:
        turning = (about_up - about_axis * np.cos(theta)) ** 2 / (2 * across * np.sin(theta) ** 2)
        return turning + weight * np.cos(theta)

    ax = style.axes_2d_or_new(ax)
    seen = np.isfinite(rate)
    reach = 1.6 * max(float(np.abs(rate[seen]).max(initial=0.0)), 0.2 * np.sqrt(weight / across))
    middle, half = 0.5 * (tilt.max() + tilt.min()), 0.5 * np.ptp(tilt)
    wide = max(1.8 * half, 0.15)
    # The grid excludes θ = 0 and θ = π, where the axis is vertical: the effective potential is
    # infinite there.
    grid = np.linspace(max(middle - wide, 1e-3), min(middle + wide, np.pi - 1e-3), 400)
    rates = np.linspace(-reach, reach, 301)
    energy = 0.5 * across * rates[:, None] ** 2 + potential(grid)
    floor = energy.min()
    own = 0.5 * across * rate[seen] ** 2 + potential(tilt[seen])
    top_level = max(float(np.median(own)) * 2 - floor, floor + 1e-3 * weight)
    # The levels are evenly spaced in the amplitude of the nutation, not in energy.
    steps = np.linspace(0, 1.5, levels + 1)[1:] ** 2
    heights = floor + steps * (top_level - floor) / 2
    ax.contour(np.degrees(grid), rates, energy, levels=heights, colors="0.6", linewidths=0.7)
    ax.plot(np.degrees(tilt), rate, color=COLOURS[0], lw=2.0, label="this motion")
    ax.plot(np.degrees(tilt[:1]), rate[:1], color=COLOURS[0], marker="o", ls="", label="start")
    lowest = grid[np.argmin(potential(grid))]
    if grid[0] < lowest < grid[-1]:
        ax.plot(np.degrees(lowest), 0, color=COLOURS[1], marker="x", ms=8, ls="", label="steady")
    ax.set(xlabel="tilt θ, deg", ylabel="dθ/dt, rad/s", ylim=(-reach, reach))
    ax.set_title(escape_formulas(title) or "phase portrait; thin: equal energy, same momenta")
    style.draw_legend_below(ax)
    return ax


class _Constants(NamedTuple):
    """Hold the constants of a heavy symmetric top."""

    # The moments of inertia across and about the axis of symmetry, kg m².
    across: float
    along: float
    # From the pivot to the centre of mass, body frame.
    axis: np.ndarray
    # The weight times the distance of the centre of mass from the pivot, N m.
    weight: float
    # Upwards, world frame.
    up: np.ndarray


def _constants(inertia: Inertia, top: HeavyTop) -> _Constants:
    """Return the constants of a heavy symmetric top; raise `ValueError` for a body that is not
    symmetric about the axis to its centre of mass, and for a weight that does not act.
    """
    tensor = np.asarray(inertia.tensor, dtype=float)
    com, gravity = np.asarray(top.com, dtype=float), np.asarray(top.gravity, dtype=float)
    lever, pull = np.linalg.norm(com), np.linalg.norm(gravity)
    weight = float(top.mass) * float(lever * pull)
    if not weight > 0:
        raise ValueError(
            "top: wanted a weight away from the pivot, got zero for mass times gravity times the "
            "distance of the centre of mass from the pivot"
        )
    axis = com / lever
    along = float(axis @ tensor @ axis)
    across = 0.5 * (float(np.trace(tensor)) - along)
    symmetric = across * (np.eye(3) - np.outer(axis, axis)) + along * np.outer(axis, axis)
    if np.abs(tensor - symmetric).max() > 1e-6 * np.abs(tensor).max():
        raise ValueError(
            "phase_portrait: wanted a body symmetric about the axis through its centre of mass "
            f"(two equal moments across {axis.round(3).tolist()}); other tops have no such portrait"
        )
    return _Constants(across, along, axis, weight, -gravity / pull)
