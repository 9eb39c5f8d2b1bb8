"""Define the equations of the scenes in plain arithmetic, for other packages and for references.

The equations are independent of the rest of the library. The numbers may be floats, `mpmath` or
`gmpy2` numbers, or the symbols of another package; `sin`, `cos` and `sqrt` are arguments, and
everything else is + − × ÷.
"""

from collections.abc import Callable, Sequence
from typing import Any

Number = Any
Torque = Callable[[Number, Any, Any], tuple[Number, Number, Number]]


def heavy_top_torque(
    inertia: Sequence[Number],
    constants: Sequence[Number],
    sin: Callable[[Number], Number],
    cos: Callable[[Number], Number],
    to_body: Callable[..., tuple[Number, Number, Number]],
) -> Torque:
    """Return a function that gives the torque of the weight in body axes, `τ = m c × Rᵀg`, for a
    time, the quaternion of the attitude R, and a body rate.

    - `constants`: six numbers, the mass m times the centre of mass c (3), body axes, and gravity g
      (3), world axes.
    - `to_body`: a function (q, x, y, z) that returns the vector (x, y, z) of the world in body
      axes, for the quaternion q.
    - `inertia`, `sin`, `cos`: not used here; all torques of this module have the same arguments.
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
    """Return a function that gives the torque of gravity on a body on a circular orbit about a
    planet, `τ = 3n² r × I r`, for a time, the quaternion of the attitude, and a body rate.

    Here n is the orbital rate, I the inertia tensor, and r the unit vector along the line between
    the planet and the body; τ and r are in body axes.

    - `inertia`: the entries Ixx, Iyy, Izz, Ixy, Ixz, Iyz of the inertia tensor I.
    - `constants`: one number, the orbital rate n, rad/s.
    - `sin`, `cos`: the sine and the cosine for the kind of number that is used (floats, numbers of
      high precision, or symbols of another package).
    - `to_body`: a function (q, x, y, z) that returns the vector (x, y, z) of the world in body
      axes, for the quaternion q.
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
    """Return a function that gives the torque of a wheel at constant speed and of damping, `τ = h ×
    Ω − c Ω`, in body axes, for a time, the quaternion of the attitude, and the body rate Ω.

    - `constants`: six numbers, the angular momentum h (3) of the wheel and the damping coefficients
      c (3), one for each body axis.
    - `inertia`, `sin`, `cos`, `to_body`: not used here; all torques of this module have the same
      arguments.
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
    """Return the vector (x, y, z) of the world in body axes, Rᵀ(x, y, z), as three numbers, where R
    is the rotation matrix, body → world, of the unit quaternion q.
    """
    a, b, c, d = q
    return (
        (1 - 2 * (c * c + d * d)) * x + 2 * (b * c + a * d) * y + 2 * (b * d - a * c) * z,
        2 * (b * c - a * d) * x + (1 - 2 * (b * b + d * d)) * y + 2 * (c * d + a * b) * z,
        2 * (b * d + a * c) * x + 2 * (c * d - a * b) * y + (1 - 2 * (b * b + c * c)) * z,
    )


def body_vector_field(
    inertia: Sequence[Number], torque: Torque | None
) -> Callable[[Number, Any], Any]:
    """Return the vector field `(t, y) → dy/dt` of a body, where y has 7 numbers: the quaternion q
    (w, x, y, z) of the attitude, and the body rate Ω.

    - `inertia`: the entries Ixx, Iyy, Izz, Ixy, Ixz, Iyz of the inertia tensor.
    - `torque`: a function of t, q and Ω that returns the torque in body axes, or `None` for a free
      body.
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


def foucault_vector_field(
    constants: Sequence[Number], sqrt: Callable[[Number], Number]
) -> Callable[[Number, Any], Any]:
    """Return the vector field `(t, y) → dy/dt` of a pendulum on the turning Earth, where y has 6
    numbers: the position of the bob from the pivot, and its velocity, in the axes east, north, up.

    - `constants`: three numbers, the gravity g, and the components of the angular velocity of the
      Earth along north and up.
    - `sqrt`: not used here; the other vector field of a point in this module needs a square root.
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


def three_body_vector_field(
    constants: Sequence[Number], sqrt: Callable[[Number], Number]
) -> Callable[[Number, Any], Any]:
    """Return the vector field `(t, y) → dy/dt` of the circular restricted three-body problem, where
    y has 6 numbers: the position and the velocity in the rotating frame, in the usual units (the
    distance of the two large bodies, their total mass and the rate of the frame are 1).

    - `constants`: one number μ, the mass of the smaller of the two large bodies.
    - `sqrt`: the square root for the kind of number that is used (floats, numbers of high
      precision, or symbols of another package).
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
