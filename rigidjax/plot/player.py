"""A tumbling body on a page of its own, turned with the mouse: viser's recorded scene, offline."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float

from rigidjax._types import HasAttitude
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.plot.animation import CORNERS, FACES, Film, box_of, evenly
from rigidjax.plot.style import COLOURS, matrices


def player(
    body: Inertia | MassProperties,
    ts: Float[ArrayLike, " times"],
    states: HasAttitude,
    *,
    pictures: int = 200,
    seconds: float = 10.0,
    height: int = 420,
) -> Film:
    """A page that plays the motion in 3-D, to be turned and zoomed while it runs.

    The box is the uniform solid one with the same 𝔖, the line the path of its longest axis. The
    page holds everything, viser's program too (0.8 MB): a notebook shows it without a network or a
    running kernel, `.save("tumble.html")` makes it a file.

    **Arguments:** as `tumble`; `height` px in a notebook. **Returns** a `Film`.

    **Raises** `ModuleNotFoundError` where viser is missing (extra `view`); else as `tumble`.
    """
    times, q = evenly(ts, states, pictures)
    half, turn = box_of(body)
    try:
        import viser
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "rigidjax.plot.player needs viser: pip install 'rigidjax[view]'"
        ) from error
    import rich

    # Viser records what a server is told; nobody has to connect to it, or to be told its address.
    console = rich.get_console()
    told, console.quiet = console.quiet, True
    try:
        server = viser.ViserServer(host="127.0.0.1", verbose=False)
        try:
            page = _record(server, half, turn, times, q, seconds)
        finally:
            server.stop()
    finally:
        console.quiet = told
    return Film(page.encode("utf-8"), "html", height)


def _record(
    server: Any,
    half: np.ndarray,
    turn: np.ndarray,
    times: np.ndarray,
    q: np.ndarray,
    seconds: float,
) -> str:
    scene = server.scene
    reach = float(np.linalg.norm(half))
    scene.set_up_direction("+z")
    server.initial_camera.position = tuple(1.8 * reach * np.array([1.0, -1.2, 0.7]))
    server.initial_camera.look_at = (0.0, 0.0, 0.0)
    scene.add_frame("/world", axes_length=1.1 * reach, axes_radius=0.008 * reach)
    attitude = scene.add_frame("/body", show_axes=False, wxyz=tuple(q[0]))
    corners = ((CORNERS * half) @ turn.T).astype(np.float32)
    for axis, colour in enumerate(COLOURS[:3]):
        faces = FACES[2 * axis : 2 * axis + 2]
        triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
        scene.add_mesh_simple(
            f"/body/side{axis}",
            vertices=corners,
            faces=np.array(triangles, dtype=np.uint32),
            color=tuple(int(colour[k : k + 2], 16) for k in (1, 3, 5)),
            flat_shading=True,
            side="double",
        )
    longest = np.argmax(half)
    tips = (matrices(q) @ turn[:, longest] * half[longest]).astype(np.float32)
    scene.add_line_segments(
        "/trail",
        points=np.stack([tips[:-1], tips[1:]], axis=1),
        colors=(90, 90, 90),
        thickness=0.01 * reach,
    )
    recording = server.get_scene_serializer()
    for one in q:
        attitude.wxyz = tuple(one)
        recording.insert_sleep(seconds / len(times))
    return recording.as_html()
