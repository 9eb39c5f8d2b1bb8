"""What the constructors take: an array, or nested lists of numbers."""

from collections.abc import Sequence
from typing import Any

from jaxtyping import ArrayLike, Float

from rigidjax._types import Mat3Like, QuatLike, Vec3Like

Numbers = Sequence[Any]
Vector = Vec3Like | Numbers
Matrix = Mat3Like | Numbers
Quaternion = QuatLike | Numbers
Vectors = Float[ArrayLike, "*batch 3"] | Numbers
Matrices = Float[ArrayLike, "*batch 3 3"] | Numbers
Scalars = Float[ArrayLike, "*batch"] | Numbers | float
