"""Show a tumbling body as an animation: a GIF, or an interactive page."""

import base64
import html
import io
import shutil
import subprocess
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Float, PyTree

from rigidjax import _checks
from rigidjax._types import HasAttitude, NumbersLike
from rigidjax.body import validation
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.body.meshes import checked_faces
from rigidjax.body.principal_axes import principal
from rigidjax.plot.style import (
    COLOURS,
    escape_formulas,
    host_attitudes,
    host_times,
    pyplot,
    rotation_matrices,
    set_equal_scales,
    viewpoint,
)

# CORNERS (8, 3) are the corners of the cube from −1 to 1. FACES has, for each face, the indices of
# its four corners, counter-clockwise as seen from outside; the order is −x, +x, −y, +y, −z, +z.
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
# _FULL (3, 3) are the full colours of the axes x, y and z, as red, green and blue from 0 to 1.
# SHADES (6, 3) are the colours of the faces: pale on the negative side of an axis.
_FULL = np.array([[int(c[k : k + 2], 16) / 255 for k in (1, 3, 5)] for c in COLOURS[:3]])
SHADES = np.stack([0.4 * _FULL + 0.6, _FULL], axis=1).reshape(6, 3)


class Film(eqx.Module):
    """Hold an animation in memory: a notebook shows the animation, `save` writes it to a file.

    **Fields:** `data` the bytes of the file; `kind` `gif` or `html`; `height` of the picture in a
    notebook, px.

    >>> Film(b"<p>hello</p>", "html", 100)._repr_html_()[:7]
    '<iframe'
    """

    data: bytes = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    height: int = eqx.field(static=True)

    def __repr__(self) -> str:
        return f"Film({self.kind}, {len(self.data) // 1024} kB)"

    def save(self, path: str | Path) -> Path:
        """Write the animation to a file, and **return** the path of the file.

        **Arguments:** `path` ends in `.gif` or `.html`, or in `.mp4` if the program ffmpeg is
        installed; for the page of `player` it must end in `.html`. **Raises** `ValueError` for
        another suffix, `FileNotFoundError` if ffmpeg is missing.
        """
        path = Path(path)
        suffix = path.suffix.lower()
        kinds = (".gif", ".html", ".mp4") if self.kind == "gif" else (".html",)
        if suffix not in kinds:
            wanted = " or ".join(kinds)
            raise ValueError(f"save: wanted a name that ends in {wanted}, got {path.name}")
        if suffix == ".mp4":
            program = shutil.which("ffmpeg")
            if program is None:
                raise FileNotFoundError(
                    "save: a film in .mp4 needs the program ffmpeg; a .gif needs no other program"
                )
            # The video format needs an even width and height in px.
            even = "scale=trunc(iw/2)*2:trunc(ih/2)*2"
            options = ["-vf", even, "-pix_fmt", "yuv420p", "-movflags", "faststart"]
            run = [program, "-y", "-loglevel", "error", "-f", "gif", "-i", "-", *options, str(path)]
            subprocess.run(run, input=self.data, check=True)
        elif suffix == ".html" and self.kind == "gif":
            path.write_text(f"<!doctype html>\n{self._repr_html_()}\n", encoding="utf-8")
        else:
            path.write_bytes(self.data)
        return path

    def _repr_html_(self) -> str:
        """Return the film as HTML, which a notebook shows."""
        if self.kind == "gif":
            picture = base64.b64encode(self.data).decode("ascii")
            return f'<img alt="tumbling body" src="data:image/gif;base64,{picture}">'
        page = html.escape(self.data.decode("utf-8"), quote=True)
        return (
            f'<iframe srcdoc="{page}" width="100%" height="{self.height}" '
            'style="border:1px solid #ddd"></iframe>'
        )


def tumble(
    body: Inertia | MassProperties,
    ts: Float[ArrayLike, " times"],
    states: HasAttitude,
    *,
    surface: Any = None,
    seconds: float | int | None = None,
    fps: float | int = 15,
    size: int = 400,
    title: str = "",
) -> Film:
    """Return a GIF of the body as it tumbles; a line shows the path of the end of its longest axis.

    Without a `surface`, a body is numbers only, and a box is drawn: it is solid and uniform, and
    has the second moment 𝔖 of the body (the integral of r rᵀ over the mass), hence the same motion.
    Faces across x, y and z (of a box: its shortest, middle and longest axis) are blue, orange and
    green; those on the negative side of an axis are pale, so that a flip is seen. The origin of the
    body axes is fixed.

    **Arguments:**

    - `body`; `ts` (T,) s; `states` of one body with a leading time axis, with less than a quarter
      turn between consecutive states.
    - `surface`: what is drawn: a mesh, `(vertices, faces)` as `shapes.mesh` takes, or an object
      with these two, such as a mesh of trimesh; a list of meshes for a body of several parts. It is
      in metres and body axes, about the point that the body turns about: the tip of a top is at the
      origin.
    - `seconds`: the duration of the film, by default the duration of the motion, but at most 20 s;
      `fps` pictures a second; `size` the width and the height, px; `title`.

    **Returns** a `Film`, which a notebook shows and `.save(path)` writes. A `UserWarning` says if
    the body makes half a turn or more between two pictures, which then show another motion.
    **Raises** `ValueError` if `seconds`, `fps` or `size` is not positive.

    >>> body = rj.shapes.box(1.0, [0.1, 0.2, 0.3])
    >>> sol = rj.simulate(body.inertia, rj.Attitude([1.0, 0, 0, 0], [0, 1, 0.1]), [0.0, 0.5, 1.0])
    >>> tumble(body, sol.ts, sol.ys, fps=2).data[:6]
    b'GIF89a'
    """
    seconds, pictures = _duration_and_count(ts, seconds, fps)
    body = validation.require_single_body(body, (Inertia, MassProperties), "body")
    moments, q = resampled_attitudes(ts, states, pictures)
    _warn_of_aliases(ts, states, moments, seconds)
    size = _checks.integer(size, "size", 64)
    solid = _solid(body, surface)
    pyplot()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection
    from PIL import Image

    # The figure is made without pyplot: a film must not keep a figure, nor open a window.
    figure = Figure(figsize=(3.6, 3.6), dpi=size / 3.6)
    canvas = FigureCanvasAgg(figure)
    ax: Any = figure.add_axes((0.0, 0.08, 0.86, 0.84), projection="3d")
    # The path goes through every given state: through the states of the few pictures alone it would
    # be a zigzag.
    when = np.asarray(ts, dtype=float)
    tips = rotation_matrices(host_attitudes(states)) @ solid.tip
    unit = ", m" if surface is not None or isinstance(body, MassProperties) else ""
    set_equal_scales(ax, solid.reach, (f"x{unit}", f"y{unit}", f"z{unit}"))
    edges: dict[str, Any] = {"linewidths": 0.3}
    if surface is None:
        edges = {"edgecolor": "0.2", "linewidths": 0.8}
    towards = viewpoint(ax)
    drawn = Poly3DCollection([], alpha=0.85 if surface is None else 1.0, **edges)
    ax.add_collection3d(drawn)
    (trail,) = ax.plot([], [], [], color="0.3", lw=0.9)
    shots = []
    for moment, rotation in zip(moments, rotation_matrices(q), strict=True):
        placed, colours = solid.polygons @ rotation.T, solid.colours
        if surface is not None:
            # Of an opaque surface only what faces the viewer is drawn: matplotlib sorts whole
            # triangles by their depth, so that others would shine through.
            a, b, c = (placed[:, k] for k in range(3))
            front = np.cross(b - a, c - a) @ towards > 0
            placed, colours = placed[front], colours[front]
        drawn.set_verts(placed)
        drawn.set_facecolor(colours)
        if surface is not None:
            drawn.set_edgecolor(colours)
        trail.set_data_3d(*tips[when <= moment].T)
        ax.set_title(escape_formulas(f"{title}  t = {moment:.3g} s".strip()), fontsize=10)
        canvas.draw()
        shots.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    # All pictures share one palette: with a palette for each picture the grey background flickers.
    # The palette is made from a dozen pictures: from a single picture it would lack colours.
    sample = shots[:: max(len(shots) // 12, 1)]
    joined = Image.fromarray(np.concatenate([np.asarray(shot) for shot in sample]))
    palette = joined.quantize(64)
    shots = [shot.quantize(64, palette=palette, dither=Image.Dither.NONE) for shot in shots]
    out = io.BytesIO()
    how = dict(save_all=True, append_images=shots[1:], loop=0)
    shots[0].save(out, "GIF", duration=int(1000 * seconds / pictures), **how)
    return Film(out.getvalue(), "gif", size)


def _duration_and_count(
    ts: NumbersLike, seconds: float | int | None, fps: float | int
) -> tuple[float, int]:
    """Return the duration of a film, s, by default that of the motion, but at most 20 s; and the
    number of its pictures, at least 2.
    """
    if seconds is None:
        when = _checks.host_array(ts, "ts")
        seconds = min(abs(float(when[-1] - when[0])), 20.0) if when.ndim == 1 and when.size else 1.0
    seconds = _checks.positive_float(seconds, "seconds")
    return seconds, max(round(seconds * _checks.positive_float(fps, "fps")), 2)


def player(
    body: Inertia | MassProperties,
    ts: Float[ArrayLike, " times"],
    states: HasAttitude,
    *,
    surface: Any = None,
    seconds: float | int | None = None,
    fps: float | int = 20,
    height: int = 420,
) -> Film:
    """Return a page that plays the motion in 3-D; you can turn and zoom the view while it plays.

    The picture is as in `tumble`: the body, and the path of the end of its longest axis. The page
    contains everything, also the program of the 3-D viewer viser (0.8 MB): a notebook shows it
    without a network or a running kernel, and `.save("tumble.html")` writes it to a file.
    **Arguments:** as `tumble`; `height` px in a notebook. **Returns** a `Film`. **Raises** as
    `tumble`.
    """
    seconds, pictures = _duration_and_count(ts, seconds, fps)
    moments, q = resampled_attitudes(ts, states, pictures)
    _warn_of_aliases(ts, states, moments, seconds)
    solid = _solid(validation.require_single_body(body, (Inertia, MassProperties), "body"), surface)
    viser = _checks.import_library("viser", "view", "plot.player")
    import rich

    # The server of viser only records the commands that it gets; no browser has to connect to it.
    # The console of the package rich is quiet meanwhile, so that nothing about the server is
    # printed.
    console = rich.get_console()
    was_quiet, console.quiet = console.quiet, True
    try:
        server = viser.ViserServer(host="127.0.0.1", verbose=False)
        try:
            page = _page(server, solid, q, seconds)
        finally:
            server.stop()
    finally:
        console.quiet = was_quiet
    return Film(page.encode("utf-8"), "html", height)


def _page(server: Any, solid: "_Solid", q: np.ndarray, seconds: float) -> str:
    """Return a page that plays attitudes over `seconds`, drawn by viser without browsers."""
    scene = server.scene
    scene.set_up_direction("+z")
    server.initial_camera.position = tuple(1.8 * solid.reach * np.array([1.0, -1.2, 0.7]))
    server.initial_camera.look_at = (0.0, 0.0, 0.0)
    scene.add_frame("/world", axes_length=1.1 * solid.reach, axes_radius=0.008 * solid.reach)
    attitude = scene.add_frame("/body", show_axes=False, wxyz=tuple(q[0]))
    for side, shade in enumerate(SHADES):
        polygons = solid.polygons[solid.sides == side]
        corners = polygons.shape[1]
        # Each polygon is cut into triangles from its first corner.
        fan = np.array([(0, k, k + 1) for k in range(1, corners - 1)])
        faces = (corners * np.arange(len(polygons))[:, None, None] + fan).reshape(-1, 3)
        how = dict(color=tuple(round(255 * part) for part in shade), flat_shading=True)
        vertices = polygons.reshape(-1, 3).astype(np.float32)
        if len(faces):
            name = f"/body/side{side}"
            scene.add_mesh_simple(name, vertices, faces.astype(np.uint32), side="double", **how)
    tips = (rotation_matrices(q) @ solid.tip).astype(np.float32)
    lines = np.stack([tips[:-1], tips[1:]], axis=1)
    scene.add_line_segments(
        "/trail", points=lines, colors=(90, 90, 90), thickness=0.01 * solid.reach
    )
    recording = server.get_scene_serializer()
    for one in q:
        attitude.wxyz = tuple(one)
        recording.insert_sleep(seconds / len(q))
    return recording.as_html()


def resampled_attitudes(
    ts: NumbersLike, states: PyTree, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return evenly spaced times, s, and attitudes there, along the shorter arcs."""
    q = host_attitudes(states)
    t = host_times(ts, q.shape[0])
    if t.size < 2:
        raise ValueError(f"ts: wanted at least two times, got {t.size}")
    # q and −q are the same attitude: signs are chosen so that consecutive quaternions are near each
    # other.
    signs = np.where(np.einsum("ti,ti->t", q[1:], q[:-1]) < 0, -1.0, 1.0)
    q = q * np.concatenate([[1.0], np.cumprod(signs)])[:, None]
    when = np.linspace(t[0], t[-1], count)
    between = np.stack([np.interp(when, t, column) for column in q.T], axis=-1)
    return when, between / np.linalg.norm(between, axis=1, keepdims=True)


class _Solid(NamedTuple):
    """Hold the polygons that a film draws, in body axes."""

    polygons: np.ndarray  # (m, k, 3)
    sides: np.ndarray  # (m,) which of the colours `SHADES` is nearest
    colours: np.ndarray  # (m, 3) one RGB colour for each polygon
    tip: np.ndarray  # (3,) the end of the longest axis
    reach: float  # the largest distance of a corner from the origin


def _solid(body: Inertia | MassProperties, surface: Any) -> _Solid:
    """Return the polygons of a body: its `surface`, or the uniform box that moves as it does."""
    half, axes = equal_box(body)
    if surface is None:
        polygons = ((CORNERS * half) @ axes.T)[np.array(FACES)]
    else:
        parts = surface if isinstance(surface, list) else [surface]
        polygons = np.concatenate([_triangles(part) for part in parts])
    a, b, c = (polygons[:, k] for k in range(3))
    normal = np.cross(b - a, c - a) @ (axes if surface is None else np.eye(3))
    weights = normal**2 / np.maximum((normal**2).sum(1, keepdims=True), 1e-300)
    sides = 2 * np.arange(3) + (normal > 0)
    colours = (weights[..., None] * SHADES[sides]).sum(1)
    main = sides[np.arange(len(sides)), weights.argmax(1)]
    corners, long = polygons.reshape(-1, 3), axes[:, np.argmax(half)]
    along = corners @ long
    tip = along[np.argmax(np.abs(along))] * long
    reach = float(np.linalg.norm(corners, axis=1).max())
    return _Solid(polygons, main, colours, tip, reach)


def _triangles(mesh: Any) -> np.ndarray:
    """Return the corners of the triangles of a mesh."""
    if hasattr(mesh, "vertices") and hasattr(mesh, "faces"):
        mesh = (mesh.vertices, mesh.faces)
    if not isinstance(mesh, tuple) or len(mesh) != 2:
        words = "surface: wanted (vertices, faces), or a list of such meshes, got "
        raise TypeError(words + _checks.type_name(mesh))
    vertices = _checks.host_array(_checks.array_of_rows(mesh[0], (3,), "vertices"), "vertices")
    return vertices[np.asarray(checked_faces(mesh[1], len(vertices)))]


def _warn_of_aliases(ts: NumbersLike, states: PyTree, moments: np.ndarray, seconds: float) -> None:
    """Warn of half a turn between two pictures of a film, or a quarter between two states."""
    t, rates = host_times(ts, len(states.omega)), np.linalg.norm(states.omega, axis=-1)
    turns = np.abs(np.diff(t)) * 0.5 * (rates[1:] + rates[:-1]) / (2 * np.pi)
    sign = np.sign(t[-1] - t[0])
    total = np.interp(sign * moments, sign * t, np.concatenate([[0.0], np.cumsum(turns)]))
    most = np.diff(total).max()
    if turns.max() >= 0.25:
        words = f"the body makes {turns.max():.2g} turns between two of ts: give more times"
    elif most >= 0.5:
        words = (
            f"the body makes {most:.2g} turns between two pictures, which show another motion: "
            f"give a larger fps, or seconds={seconds * most / 0.1:.2g} and more"
        )
    else:
        return
    warnings.warn(f"film: {words}", stacklevel=3)


def equal_box(body: Inertia | MassProperties) -> tuple[np.ndarray, np.ndarray]:
    """Return half-lengths and axes (columns, body axes) of the box that moves as the body does.

    Of the mass m and the principal second moments λ = m a²/3 follow the half-lengths a, in metres;
    for an `Inertia` they are scaled so that the longest is 1.
    """
    second, q = principal(body.second_moment)
    size = np.sqrt(np.maximum(np.asarray(second, dtype=float), 0.0))
    if not size.max() > 0:
        raise ValueError(
            "body: wanted a body of non-zero size, got one whose second moment of mass is zero "
            "(a point), which has no box"
        )
    if isinstance(body, MassProperties):
        size = size * np.sqrt(3 / float(body.mass))
    else:
        size = size / size.max()
    # A plate or a rod gets a little thickness, so that it is visible.
    axes = rotation_matrices(np.asarray(q, dtype=float)[None])[0]
    return np.maximum(size, 0.02 * size.max()), axes
