"""The small pictures of the gallery, cut from the notebooks' own: python notebooks/images/thumbnails.py"""

import base64
import io
import json
from pathlib import Path

from PIL import Image

HERE = Path(__file__).parent
WIDTH, HEIGHT = 420, 280
# Of each notebook which picture, and of it which part: left, top, right, bottom, as fractions.
PARTS = {
    "01_the_notes": (0, (0.18, 0.15, 0.8, 0.7)),
    "02_dzhanibekov": (1, (0.0, 0.0, 0.48, 0.87)),
    "03_identify": (0, (0.0, 0.06, 0.5, 0.625)),
    "04_heavy_tops": (0, (0.66, 0.0, 1.0, 0.48)),
    "05_frames": (0, (0.0, 0.065, 0.455, 1.0)),
    "06_batches": (2, (0.137, 0.17, 0.793, 0.735)),
    "07_extend": (1, (0.0, 0.0, 0.84, 1.0)),
    "08_flyby": (1, (0.0, 0.0, 0.34, 1.0)),
    "09_crossings": (1, (0.075, 0.2, 0.63, 0.79)),
    "10_brightness": (2, (0.0, 0.0, 0.2935, 0.46)),
    "11_unknown_torque": (0, (0.525, 0.0, 1.0, 0.9)),
    "12_posterior": (0, (0.0, 0.217, 0.44, 0.583)),
    "13_polar_motion": (0, (0.0, 0.06, 0.335, 0.94)),
    "15_throws": (1, (0.0, 0.0, 0.383, 0.9)),
    "16_moon": (0, (0.0, 0.14, 0.5, 1.0)),
    "17_digits": (3, (0.0, 0.0, 0.75, 1.0)),
    "18_crazyflie": (0, (0.0, 0.0, 0.5, 1.0)),
    "19_inertia_in_a_workshop": (3, (0.0, 0.0, 1.0, 1.0)),
    "14_slew": (1, (0.0, 0.48, 0.343, 0.95)),
}


def pictures(notebook):
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        for output in cell.get("outputs", []):
            drawn = output.get("data", {}).get("image/png")
            if drawn:
                yield Image.open(io.BytesIO(base64.b64decode("".join(drawn)))).convert("RGB")


def thumbnail(notebook, index, part):
    """The part, on white, as large as it fits."""
    whole = list(pictures(notebook))[index]
    sides = [edge * size for edge, size in zip(part, 2 * whole.size, strict=True)]
    cut = whole.crop(tuple(round(side) for side in sides))
    factor = min(WIDTH / cut.width, HEIGHT / cut.height)
    cut = cut.resize((round(factor * cut.width), round(factor * cut.height)), Image.LANCZOS)
    page = Image.new("RGB", (WIDTH, HEIGHT), "white")
    page.paste(cut, ((WIDTH - cut.width) // 2, (HEIGHT - cut.height) // 2))
    return page.quantize(96, Image.Quantize.FASTOCTREE)


if __name__ == "__main__":
    for name, (index, part) in PARTS.items():
        found = thumbnail(HERE.parent / f"{name}.ipynb", index, part)
        found.save(HERE / "thumbnails" / f"{name}.png", optimize=True)
