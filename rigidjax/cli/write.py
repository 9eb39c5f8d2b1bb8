"""Write a fitted body into the file of a simulator, for `identify --write`."""

import argparse
import difflib
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
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
    old: rj.MassProperties | str  # or why there is none
    place: np.ndarray
    turn: np.ndarray  # quaternion, log → file

    def before(self, model: rj.identify.Model) -> rj.MassProperties | rj.Inertia | None:
        """Return the body of the file in the frame of the log, or `None` if it is no real body."""
        if isinstance(self.old, str):
            return None
        old = self.old.shift(-self.place).rotate(rj.quaternion.conjugate(self.turn))
        return old if has_mass(model.charts[0]) else old.inertia

    def write(self, fit: rj.identify.Fit, yes: bool, rate_unit: str) -> Iterator[str]:
        """Write the body of a fit into the file if `yes`, and yield lines on what changes."""
        path, body = self.file.path, fit.body.rotate(self.turn)
        bodies = fit.model.index.bodies
        if not np.isfinite(fit.covariance[:bodies, :bodies]).all():
            raise ValueError(
                f"{path} is not changed: the log does not determine the whole body, as said above; "
                "record more motion, or fit fewer numbers (--model)"
            )
        body = body.shift(self.place) if isinstance(body, rj.MassProperties) else body
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            draft = Path(folder, path.name)
            rj.body.write_inertials(draft, {self.name: body}, path)
            text = draft.read_bytes()
        yield from ("", f"{path}: body {self.name!r}")
        old, new = (one.decode(errors="replace").splitlines() for one in (self.file.text, text))
        yield from list(difflib.unified_diff(old, new, n=0, lineterm=""))[2:]
        yield from (str(one.message) for one in said)
        if isinstance(self.old, str):
            yield f"no error by that of the file: {self.old}"
        for pair in [] if fit.held_out is None else fit.held_out.pairs:
            scale, unit = _show.shown_unit(pair.unit, rate_unit)
            old = "" if pair.before is None else f", {scale * pair.before:.3g} by that of the file"
            new = f"{scale * pair.held_out:.3g} {unit} by the new body"
            yield f"held-out error of the {pair.sensor}: {new}{old}"
        if not fit.ok:
            yield f"this body is not to be trusted: {fit.status}"
        if yes:
            path.write_bytes(text)
        yield f"{path} is changed" if yes else f"{path} is not changed: --yes changes it"


def open_target(options: argparse.Namespace) -> Target | None:
    """Return what `--write` names, or `None` without it; raise `ValueError` if it is missing."""
    if options.write is None:
        for name in ("body", "mount", "yes"):
            if getattr(options, name):
                raise LogError(f"--{name}: wanted a --write FILE beside it")
        return None
    file = open_file(options.write, "--write")
    mount = np.array(options.mount or [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    length = np.linalg.norm(mount[3:])
    if not abs(length - 1.0) < 1e-3:
        raise LogError(f"--mount: wanted a unit quaternion QW QX QY QZ, got one of length {length}")
    name = file.named(options.body)
    try:
        old = file.body(name)
    except ValueError as error:
        old = str(error)
    if not options.wrench:
        file.with_body(name, rj.Inertia(np.eye(3)))  # raises for a body without a mass
    return Target(file, name, old, mount[:3], mount[3:] / length)
