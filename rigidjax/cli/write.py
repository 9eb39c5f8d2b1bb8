"""Write a fitted body into the file of a simulator, for `identify --write`."""

import argparse
import contextlib
import difflib
import warnings
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

import rigidjax as rj
from rigidjax import _show
from rigidjax.body.inertials import File, open_file
from rigidjax.cli.logs.errors import LogError
from rigidjax.identify.model.charts import has_mass


class Target(NamedTuple):
    """Hold the body in a file that is to be replaced, and the frame of the log in its frame."""

    file: File
    name: str
    place: np.ndarray
    turn: np.ndarray  # quaternion, log → file

    def before(self, model: rj.identify.Model) -> rj.MassProperties | rj.Inertia | None:
        """Return the body of the file in the frame of the log, or `None` if it is no real body."""
        with contextlib.suppress(ValueError):
            old = self.file.body(self.name).shift(-self.place)
            old = old.rotate(rj.quaternion.conjugate(self.turn))
            return old if has_mass(model.charts[0]) else old.inertia

    def write(self, fit: rj.identify.Fit, yes: bool, rate_unit: str) -> Iterator[str]:
        """Write the body of a fit into the file if `yes`, and yield lines on what changes."""
        path, body, bodies = self.file.path, fit.body.rotate(self.turn), fit.model.index.bodies
        if not np.isfinite(fit.covariance[:bodies, :bodies]).all():
            raise ValueError(
                f"{path} is not changed: the log does not determine the whole body, as said above; "
                "record more motion, or fit fewer numbers (--model)"
            )
        body = body.shift(self.place) if isinstance(body, rj.MassProperties) else body
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            text = self.file.with_body(self.name, body)
        yield from ("", f"{path}: body {self.name!r}")
        old, new = (one.decode(errors="replace").splitlines() for one in (self.file.text, text))
        yield from list(difflib.unified_diff(old, new, n=0, lineterm=""))[2:]
        yield from (str(one.message) for one in said)
        for pair in [] if fit.held_out is None else fit.held_out.pairs:
            scale, unit = _show.shown_unit(pair.unit, rate_unit)
            sizes = (scale * pair.held_out, None if pair.before is None else scale * pair.before)
            new, old = ("none (no real body)" if x is None else f"{x:.3g}" for x in sizes)
            yield (
                f"held-out error of the {pair.sensor}: {new} {unit} by the new body, {old} by that "
                "of the file"
            )
        if not fit.ok:
            yield f"this body is not to be trusted: {fit.status}"
        if yes:
            path.write_bytes(text)
        yield f"{path} is changed" if yes else f"{path} is not changed: --yes changes it"


def open_target(options: argparse.Namespace) -> Target | None:
    """Return what `--write` names, or `None` without it; raise `ValueError` if it is missing."""
    if options.write is None:
        if options.body or options.mount or options.yes:
            raise LogError("--body, --mount, --yes: wanted a --write FILE beside them")
        return None
    file = open_file(options.write, "--write")
    *place, w, x, y, z = options.mount or [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    length = np.linalg.norm([w, x, y, z])
    if not abs(length - 1.0) < 1e-3:
        raise LogError(f"--mount: wanted a unit quaternion QW QX QY QZ, got one of length {length}")
    name = file.named(options.body)
    if not options.wrench:
        file.with_body(name, rj.Inertia(np.eye(3)))  # raises for a body without a mass
    return Target(file, name, np.array(place), np.array([w, x, y, z]) / length)
