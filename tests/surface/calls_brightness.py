"""Good calls: brightness, light curves, two frequencies."""

import numpy as np
from surface.calls import leave_out, row
from surface.scenes import V, W, Y

import rigidjax as rj
from rigidjax import identify, tumblers

HOST = dict(host=True, transforms=())
TIMES = np.linspace(0.0, 50.0, 40)
LIGHT = 2.0 + np.sin(TIMES) + 0.3 * np.sin(0.7 * TIMES)
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])

for law in ("Geometric", "Lambert", "LommelSeeliger"):
    row(f"tumblers.brightness.{law}", transforms=())
leave_out("abstract: made by subclassing", "tumblers.brightness.AbstractScattering")
row("tumblers.brightness.ellipsoid", dict(semi_axes=np.abs(V) + 0.5, sun=W, observer=Y))
row(
    "tumblers.brightness.mesh",
    dict(vertices=CORNERS, faces=FACES, sun=-np.abs(W), observer=-np.abs(Y)),
    traced=("vertices", "sun", "observer"),
)
row(
    "tumblers.Brightness",
    dict(sun=W, observer=Y, noise=0.1, level=2.0, semi_axes=np.abs(V) + 0.5, offset=0.01),
    **HOST,
)
row(
    "tumblers.two_frequencies",
    dict(t=TIMES, values=LIGHT, noise=0.1, order=1, shortest=2.0, count=2),
    **HOST,
)
row(
    "tumblers.fit_light_curve",
    lambda: dict(
        model=identify.Model(
            identify.Recording(TIMES, (tumblers.Brightness(W, Y, noise=0.1), LIGHT)),
            identify.PrincipalRatios(),
        )
    ),
    groups=("stranger", "kind", "function"),
    dear=True,
    **HOST,
)
leave_out(
    "a search of light curves makes it",
    "tumblers.Alias",
    "tumblers.LightCurve",
    "tumblers.TwoFrequencies",
)
row(
    "tumblers.plot.light_curve",
    dict(ts=TIMES, values=LIGHT, periods=np.array([6.0, 8.0]), model=LIGHT),
    run=lambda **given: rj.tumblers.plot.light_curve(**given),
    **HOST,
)
