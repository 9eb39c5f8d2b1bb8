"""Integrate the mass properties of the solid inside a closed triangle mesh, exactly.

The solid is a sum of tetrahedra, each with its tip at one common point and a face of the mesh as
its base; a tetrahedron on the outer side of its face counts as negative. Over a tetrahedron with
corners 0, a, b, c the integrals of 1, r and r rᵀ are polynomials of a, b, c, so that the result is
exact to round-off and differentiable in the vertices. The mesh is first shifted, so that the common
point, the origin, is inside or near the mesh: for a mesh far from the origin, a sum would subtract
numbers that grow as the fifth power of the distance.
"""

import os
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from rigidjax import _checks
from rigidjax._types import Numbers, ScalarLike
from rigidjax.body.inertia import MassProperties
from rigidjax.body.symmetric3 import PAIRS, from_components


def mesh(
    vertices: Float[ArrayLike, "n 3"] | Numbers,
    faces: Int[ArrayLike, "m 3"] | Numbers,
    density: ScalarLike,
) -> MassProperties:
    """Return the solid of one density inside a closed triangle mesh.

    **Arguments:** `vertices` (n, 3) in metres, body frame; `faces` (m, 3) vertex numbers from 0,
    counter-clockwise seen from outside (the faces around a hole inside the solid are a closed mesh
    with the opposite order); `density` kg/m³. The body is differentiable in `vertices` and
    `density`. Faces without area are allowed. Source: integrals over a tetrahedron, e.g. Tonon
    2004, J. Math. Stat. 1:8.

    **Raises:** `ValueError` for a mesh that is open or inside out, for faces that disagree about
    which side is outside, and for a face with a repeated or missing vertex. Under `jit` the faces
    are checked if they are known.

    >>> corners = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> body = mesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], density=6.0)
    >>> round(float(body.mass), 12), round(float(body.com[0]), 12)
    (1.0, 0.25)
    """
    corners = _checks.array_of_rows(vertices, (3,), "vertices", hint="one row (x, y, z) per vertex")
    if not corners.size:
        raise ValueError("vertices: wanted at least one row (x, y, z), got none")
    _checks.check_if_known(_checks.require_finite, corners, "vertices")
    faces = checked_faces(faces, corners.shape[0])
    density = _checks.array_of_shape(density, (), "density")
    _checks.check_if_known(_checks.require_positive, density, "density", "a positive number, kg/m³")

    centre = jax.lax.stop_gradient(corners.mean(axis=0))
    six, (a, b, c) = _tetrahedra(corners - centre[None, :], faces)
    com = (six[:, None] * (a + b + c)).sum(axis=0) / (4.0 * six.sum())
    volume = six.sum() / 6.0
    # The volume counts as zero if it is below the area of the mesh times a few units of round-off
    # of its longest extent: the mesh is then as thin as the last digit of its length.
    at_a, at_b, at_c = (jax.lax.stop_gradient(corners[faces[:, k]]) for k in range(3))
    area = 0.5 * jnp.sqrt((jnp.cross(at_b - at_a, at_c - at_a) ** 2).sum(axis=1)).sum()
    longest = jax.lax.stop_gradient(jnp.ptp(corners, axis=0).max())
    slack = 4.0 * jnp.finfo(corners.dtype).eps * longest * area
    volume_text = f" (volume {float(volume):.6g} m³)" if _checks.is_known(volume) else ""
    words = f"mesh: it is inside out{volume_text}: its faces are clockwise; give faces[:, ::-1]"
    volume = _checks.error_if(volume, volume < -slack, words)
    words = f"mesh: it encloses no volume{volume_text}; for a flat body use plate"
    volume = _checks.error_if(volume, ~(volume > slack), words)
    # The second moments are summed about the centre of mass itself, so that no large term is
    # subtracted afterwards.
    six, (a, b, c) = _tetrahedra(corners - (centre + com)[None, :], faces)
    rows = (a, b, c, a + b + c)
    entries = ((six * sum(r[:, i] * r[:, j] for r in rows)).sum() / 120.0 for i, j in PAIRS)
    return MassProperties(density * volume, centre + com, density * from_components(*entries))


def mesh_file(
    path: str | os.PathLike[str], density: ScalarLike, *, scale: float = 1.0
) -> MassProperties:
    """Return the solid inside a closed mesh read from a file, such as STL, OBJ, PLY, OFF or GLB.

    The package `trimesh` is needed (`pip install '.[mesh]'` in the clone); it also merges equal
    vertices.

    **Arguments:** `path` of the file; `density` kg/m³; `scale` metres per unit of the file (most
    STL files are in millimetres: 1e-3). **Raises:** `FileNotFoundError`; `ImportError` without
    trimesh; otherwise as `mesh`.

    >>> import tempfile
    >>> corner = "v 0 0 0;v 1 0 0;v 0 1 0;v 0 0 1;f 1 3 2;f 1 2 4;f 1 4 3;f 2 3 4"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = folder + "/corner.obj"
    ...     with open(path, "w") as file:
    ...         print(*corner.split(";"), sep=chr(10), file=file)
    ...     round(float(mesh_file(path, density=6.0).mass), 12)
    1.0
    """
    path = os.fspath(path)
    if not os.path.isfile(path):
        raise FileNotFoundError(f"mesh_file: there is no file {path!r}")
    trimesh = _checks.import_library("trimesh", "mesh", "mesh_file")
    surface = trimesh.load_mesh(path)
    if not isinstance(surface, trimesh.Trimesh) or len(surface.faces) == 0:
        raise ValueError(f"mesh_file: wanted a file with triangles, {path!r} holds no triangles")
    corners = np.asarray(surface.vertices, dtype=jnp.result_type(float)) * scale
    return mesh(corners, np.asarray(surface.faces), density)


class Tetrahedra(NamedTuple):
    """Hold the tetrahedra between the origin and the faces of a mesh."""

    sixfold: Float[Array, "m"]  # six times the signed volumes, m³
    corners: list[Array]  # the first, second and third corners (m, 3) of the faces


def _tetrahedra(vertices: Float[Array, "n 3"], faces: Int[Array, "m 3"]) -> Tetrahedra:
    """Return the tetrahedra of a mesh."""
    a, b, c = rows = [vertices[faces[:, k]] for k in range(3)]
    return Tetrahedra((a * jnp.cross(b, c)).sum(axis=1), rows)


def checked_faces(faces: Any, vertex_count: int) -> Array:
    """Return the faces of a mesh as an array of vertex numbers, or raise an error if they are known
    and do not enclose a solid.
    """
    if not _checks.is_known(faces):
        return faces
    faces = _checks.without_mask(faces, "faces")
    try:
        table = np.asarray(faces)
    except ValueError as error:
        raise ValueError("faces: wanted shape (m, 3), got rows of different lengths") from error
    if not np.issubdtype(table.dtype, np.integer):
        raise TypeError(f"faces: wanted integers (vertex numbers), got {table.dtype}")
    if table.ndim != 2 or table.shape[1] != 3 or len(table) == 0:
        raise ValueError(f"faces: wanted shape (m, 3), triangles, got {table.shape}")
    if table.min() < 0 or table.max() >= vertex_count:
        got = f"{table.min()} to {table.max()}; OBJ files count from 1"
        raise ValueError(f"faces: wanted vertex numbers from 0 to {vertex_count - 1}, got {got}")
    repeated = (table == np.roll(table, 1, axis=1)).any(axis=1)
    if repeated.any():
        which = int(np.argmax(repeated))
        words = f"mesh: face {which} is degenerate, it names a vertex twice"
        raise ValueError(f"{words}: {_python_integers(table[which])}")
    edges = np.concatenate([table[:, [0, 1]], table[:, [1, 2]], table[:, [2, 0]]])
    number, reverse = (edges[:, k] * np.int64(vertex_count) + edges[:, 1 - k] for k in (0, 1))
    unique, counts = np.unique(number, return_counts=True)
    alone = ~np.isin(number, reverse)
    twice = counts > 1
    if alone.any():
        lonely = edges[np.argmax(alone)]
        if np.isin(number[alone], unique[twice]).any():
            raise ValueError(
                f"mesh: its faces disagree about which side is outside: two of them run along the "
                f"edge {_python_integers(lonely)} in the same direction; turn one of them round"
            )
        raise ValueError(
            f"mesh: it is open: {int(alone.sum())} edges belong to one face only, the first is "
            f"{_python_integers(lonely)}; an open mesh has no inside. Vertices that coincide must "
            "have one number: merge them first (trimesh: merge_vertices)"
        )
    paired = dict(zip(unique.tolist(), counts.tolist(), strict=True)) if twice.any() else {}
    for edge in unique[twice].tolist():
        start, end = edge // vertex_count, edge % vertex_count
        back = end * vertex_count + start
        if paired[edge] != paired.get(back, 0):
            raise ValueError(
                f"mesh: the edge {_python_integers((start, end))} is used {paired[edge]} times one "
                f"way and {paired.get(back, 0)} times the other; both numbers must be equal"
            )
    return jnp.asarray(table)


def _python_integers(numbers: Iterable[Any]) -> tuple[int, ...]:
    """Return integers as messages show them, without a dtype."""
    return tuple(int(k) for k in numbers)
