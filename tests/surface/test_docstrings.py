"""Public docstrings are whole: every argument is named, every function has an example that runs.

`test_doctests.py` runs the examples.
"""

import inspect
import re

from surface import public

FUNCTIONS = {
    name: inspect.unwrap(thing)
    for name, thing in public.functions().items()
    if not inspect.isclass(thing)
}

# An example would need a fit, a file of meshes, several processes, a window or minutes. The guide
# and the notebooks use them, and each has tests.
WITHOUT_EXAMPLE = {
    *(
        f"identify.report.{name}"
        for name in ("rows", "verdict", "as_dict", "write_json", "write_html")
    ),
    *(f"datasets.toutatis.{name}" for name in ("rows", "rms_degrees", "remarks")),
    *(f"plot.{name}" for name in ("fit", "residuals", "player")),
    *(f"workprecision.{name}" for name in ("draw", "measure", "worked_out", "read_csv")),
    "identify.fit_light_curve",
    "batch.distributed.recover",  # in that of `save`
    "body.shapes.mesh_file",
}


def unnamed(thing):
    """The arguments that a docstring leaves out; "as for `filter`" names them there."""
    text = inspect.getdoc(thing).partition(">>>")[0]
    if re.search(r"\bas (for )?`\w+`", text):
        return []
    return [
        one for one in inspect.signature(thing).parameters if not re.search(rf"\b{one}\b", text)
    ]


def test_every_argument_is_named():
    missing = {name: unnamed(thing) for name, thing in FUNCTIONS.items()}
    assert len(missing) > 200
    assert not {name: left for name, left in missing.items() if left}


def test_every_function_has_an_example():
    missing = {name for name, thing in FUNCTIONS.items() if ">>>" not in inspect.getdoc(thing)}
    assert missing == WITHOUT_EXAMPLE
