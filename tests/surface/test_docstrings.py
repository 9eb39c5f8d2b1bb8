"""Public docstrings are whole: every argument is named, all have an example that runs.

`test_doctests.py` runs the examples.
"""

import inspect
import re

from surface import public

PUBLIC = {name: inspect.unwrap(thing) for name, thing in public.functions().items()}
FUNCTIONS = {name: thing for name, thing in PUBLIC.items() if not inspect.isclass(thing)}

# Each with the reason. The guide and the notebooks use them, and each has tests.
WITHOUT_EXAMPLE = {
    **dict.fromkeys(
        (f"datasets.toutatis.{name}" for name in ("rows", "rms_degrees", "remarks")),
        "takes the fit of real observations, tens of seconds: `python -m rigidjax demo` is it",
    ),
    **dict.fromkeys(
        ("tumblers.fit_light_curve", "tumblers.LightCurve", "tumblers.Alias"),
        "a search of minutes: the guide's page on brightness has it",
    ),
    **dict.fromkeys(
        (f"workprecision.{name}" for name in ("draw", "measure")),
        "compiles and times many solvers: `python -m rigidjax workprecision` is it",
    ),
    **dict.fromkeys(
        (
            "frames.FrameWrench",
            "solve.AdaptiveRun",
            "lagrangian.LiePoisson",
            "identify.ExtendedState",
            "lagrangian.LiePoissonWithDirection",
            "identify.Belief",
            "motion.torques.Kinematics",
            "identify.Filtered",
            "identify.Push",
            "identify.Posterior",
            "identify.ReadNumbers",
            "identify.Refit",
            "identify.Sampled",
            "identify.Smoothed",
            "identify.Comparison",
            "identify.Limit",
            "identify.Freedom",
            "identify.BestPoint",
            "identify.Uncertainty",
            "identify.Assessment",
            "identify.HeldOut",
            "identify.Pair",
        ),
        "is given by a function or is part of what is given, whose example is it",
    ),
    "plot.player": "viser writes a page of megabytes: the notebook on the Dzhanibekov effect has it",
}


def unnamed(thing):
    """The arguments that a docstring leaves out; "as for `filter`" names them there."""
    text = inspect.getdoc(thing).partition(">>>")[0]
    if re.search(r"\bas (for )?`\w+`", text):
        return []
    named = [one for one in inspect.signature(thing).parameters if not one.startswith("_")]
    return [one for one in named if not re.search(rf"\b{one}\b", text)]


# What a user makes, or is given: not what is only subclassed or raised.
CLASSES = {
    name: thing
    for name, thing in PUBLIC.items()
    if inspect.isclass(thing)
    and not inspect.isabstract(thing)
    and not getattr(thing, "_is_protocol", False)
    and not issubclass(thing, Exception)
}


def test_every_argument_and_field_is_named():
    missing = {name: unnamed(thing) for name, thing in (FUNCTIONS | CLASSES).items()}
    assert len(FUNCTIONS) > 200 and len(CLASSES) > 100
    assert not {name: left for name, left in missing.items() if left}


def test_every_function_and_class_has_an_example():
    missing = {name for name, thing in PUBLIC.items() if ">>>" not in inspect.getdoc(thing)}
    assert missing == set(WITHOUT_EXAMPLE)


def test_no_example_shows_only_a_name():
    shown = {name: inspect.getdoc(thing).partition(">>>")[2] for name, thing in PUBLIC.items()}
    assert not [name for name, text in shown.items() if "__name__" in text]
