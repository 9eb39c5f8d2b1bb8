"""Define the equations of the scenes in plain arithmetic, for other packages and for references.

The equations are independent of the rest of the library. The numbers may be floats, `mpmath` or
`gmpy2` numbers, or the symbols of another package; `sin`, `cos` and `sqrt` are arguments, and
everything else is + − × ÷.
"""

from collections.abc import Callable, Sequence
from typing import Any

Number = Any
# A function of the time, the quaternion of the attitude and the body rate: the torque, body axes.
Torque = Callable[[Number, Any, Any], tuple[Number, Number, Number]]
# A function of the time and the state y: dy/dt.
Field = Callable[[Number, Any], Any]


def heavy_top_torque(
    inertia: Sequence[Number],
    constants: Sequence[Number],
    sin: Callable[[Number], Number],
    cos: Callable[[Number], Number],
    to_body: Callable[..., tuple[Number, Number, Number]],
) -> Torque:
    """Return the torque of the weight, `τ = m c × Rᵀg`, from the six constants m c, body axes, and
    g, world axes; `to_body(q, x, y, z)` returns a vector of the world in body axes.
    """
    cx, cy, cz, gx, gy, gz = constants

    def torque(t, q, w):
        ux, uy, uz = to_body(q, gx, gy, gz)
        return cy * uz - cz * uy, cz * ux - cx * uz, cx * uy - cy * ux

    return torque


def gravity_gradient_torque(
    inertia: Sequence[Number],
    constants: Sequence[Number],
    sin: Callable[[Number], Number],
    cos: Callable[[Number], Number],
    to_body: Callable[..., tuple[Number, Number, Number]],
) -> Torque:
    """Return the torque of gravity on a circular orbit, `τ = 3n² r × I r`, from the orbital rate n,
    rad/s, with the unit vector r along the line between the planet and the body.
    """
    (n,) = constants
    ixx, iyy, izz, ixy, ixz, iyz = inertia

    def torque(t, q, w):
        rx, ry, rz = to_body(q, cos(n * t), sin(n * t), 0.0)
        lx = ixx * rx + ixy * ry + ixz * rz
        ly = ixy * rx + iyy * ry + iyz * rz
        lz = ixz * rx + iyz * ry + izz * rz
        k = 3 * n * n
        return k * (ry * lz - rz * ly), k * (rz * lx - rx * lz), k * (rx * ly - ry * lx)

    return torque


def gyrostat_torque(
    inertia: Sequence[Number],
    constants: Sequence[Number],
    sin: Callable[[Number], Number],
    cos: Callable[[Number], Number],
    to_body: Callable[..., tuple[Number, Number, Number]],
) -> Torque:
    """Return the torque of a wheel at constant speed and of damping, `τ = h × Ω − c Ω`, from the
    six constants h and c.
    """
    hx, hy, hz, cx, cy, cz = constants

    def torque(t, q, w):
        wx, wy, wz = w
        return (
            hy * wz - hz * wy - cx * wx,
            hz * wx - hx * wz - cy * wy,
            hx * wy - hy * wx - cz * wz,
        )

    return torque


def to_body_axes(q, x, y, z):
    """Return Rᵀ(x, y, z) for the rotation matrix R, body → world, of the unit quaternion q."""
    a, b, c, d = q
    return (
        (1 - 2 * (c * c + d * d)) * x + 2 * (b * c + a * d) * y + 2 * (b * d - a * c) * z,
        2 * (b * c - a * d) * x + (1 - 2 * (b * b + d * d)) * y + 2 * (c * d + a * b) * z,
        2 * (b * d + a * c) * x + 2 * (c * d - a * b) * y + (1 - 2 * (b * b + c * c)) * z,
    )


def body_vector_field(inertia: Sequence[Number], torque: Torque | None) -> Field:
    """Return the vector field of a body, whose state is the quaternion of the attitude and the body
    rate; the inertia is Ixx, Iyy, Izz, Ixy, Ixz, Iyz.
    """
    ixx, iyy, izz, ixy, ixz, iyz = inertia
    kxx, kyy, kzz = iyy * izz - iyz * iyz, ixx * izz - ixz * ixz, ixx * iyy - ixy * ixy
    kxy, kxz, kyz = ixz * iyz - ixy * izz, ixy * iyz - ixz * iyy, ixy * ixz - ixx * iyz
    det = ixx * kxx + ixy * kxy + ixz * kxz
    kxx, kyy, kzz, kxy, kxz, kyz = kxx / det, kyy / det, kzz / det, kxy / det, kxz / det, kyz / det

    def rates(t, y):
        a, b, c, d, wx, wy, wz = y
        lx = ixx * wx + ixy * wy + ixz * wz
        ly = ixy * wx + iyy * wy + iyz * wz
        lz = ixz * wx + iyz * wy + izz * wz
        tx, ty, tz = ly * wz - lz * wy, lz * wx - lx * wz, lx * wy - ly * wx
        if torque is not None:
            ux, uy, uz = torque(t, (a, b, c, d), (wx, wy, wz))
            tx, ty, tz = tx + ux, ty + uy, tz + uz
        return (
            0.5 * (-b * wx - c * wy - d * wz),
            0.5 * (a * wx + c * wz - d * wy),
            0.5 * (a * wy + d * wx - b * wz),
            0.5 * (a * wz + b * wy - c * wx),
            kxx * tx + kxy * ty + kxz * tz,
            kxy * tx + kyy * ty + kyz * tz,
            kxz * tx + kyz * ty + kzz * tz,
        )

    return rates


def foucault_vector_field(constants: Sequence[Number], sqrt: Callable[[Number], Number]) -> Field:
    """Return the vector field of a pendulum on the turning Earth, for the position from the pivot
    and the velocity of the bob (east, north, up), from gravity and the Earth's rate along north and
    up.
    """
    g, wn, wu = constants

    def rates(t, y):
        px, py, pz, vx, vy, vz = y
        along, square = wn * py + wu * pz, wn * wn + wu * wu
        ax = square * px + 2 * (wu * vy - wn * vz)
        ay = square * py - along * wn - 2 * wu * vx
        az = square * pz - along * wu + 2 * wn * vx - g
        pull = px * ax + py * ay + pz * az + vx * vx + vy * vy + vz * vz
        pull = pull / (px * px + py * py + pz * pz)
        return vx, vy, vz, ax - pull * px, ay - pull * py, az - pull * pz

    return rates


def three_body_vector_field(constants: Sequence[Number], sqrt: Callable[[Number], Number]) -> Field:
    """Return the vector field of the circular restricted three-body problem, for position and
    velocity in the rotating frame, in the usual units, from the mass μ of the smaller of the large
    bodies.
    """
    (mu,) = constants
    nu = 1 - mu

    def rates(t, y):
        px, py, pz, vx, vy, vz = y
        da, db = px + mu, px - nu
        flat = py * py + pz * pz
        ra, rb = da * da + flat, db * db + flat
        ka, kb = nu / (ra * sqrt(ra)), mu / (rb * sqrt(rb))
        pull = ka + kb
        ax = px + 2 * vy - ka * da - kb * db
        return vx, vy, vz, ax, py - 2 * vx - pull * py, -pull * pz

    return rates
