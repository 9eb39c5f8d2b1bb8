"""A check that the fitted numbers belong to a real body, which a traced fit cannot make."""

from typing import Any

from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.identify.body_charts import AbstractBodyChart


def unreal(body: Any) -> str | None:
    """The error in a body's numbers, in words; `None` for a real body."""
    try:
        if isinstance(body, MassProperties):
            MassProperties(body.mass, body.com, body.second_moment)
        else:
            Inertia.from_tensor(body.tensor)
    except ValueError as refused:
        return f"no real body has these numbers: {refused}"
    return None


def of_charts(charts: list[tuple[str, AbstractBodyChart]], bodies: list[Any]) -> list[str]:
    """`unreal` for the bodies of charts by users: every point of our charts is a real body."""
    out = []
    for (name, chart), body in zip(charts, bodies, strict=True):
        ours = type(chart).__module__ == AbstractBodyChart.__module__
        wrong = None if ours else unreal(body)
        if wrong is not None:
            out.append(wrong + name)
    return out
