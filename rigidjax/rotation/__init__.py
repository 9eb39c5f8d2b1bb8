"""How a thing can be turned: matrices, quaternions, and charts."""

from rigidjax.rotation import quaternion as quaternion, so3 as so3
