"""Run `python -m rigidjax workprecision`: measure, print, draw, compare with a stored table."""

import argparse
import math
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rigidjax.workprecision import chart, pareto
from rigidjax.workprecision.measurement import long_drift, measure, to_float32
from rigidjax.workprecision.peers import methods
from rigidjax.workprecision.record import (
    Measurement,
    changes,
    in_base_time,
    read_csv,
    write_csv,
)
from rigidjax.workprecision.standard_scenes import scenes

STORED = Path("tests/workprecision/record.csv")
QUICK = ("free-top", "heavy-top", "damped-gyrostat")
# The methods of a quick run. For each method: the ways to compute a gradient (the adjoints) that
# are measured; with none, only the value is measured.
SMALL = {
    "closed form": ("forward",),
    "simulate": ("forward",),
    "DormandPrince8": (),
    "Tsitouras5": (),
    "diffrax Tsit5": (),
    "diffrax Dopri8": ("forward",),
}
DRIFT = "long-drift"
# Compiling gradients takes most of the time of a run: gradients are measured only for these scenes,
# and for every scene that is named on the command line.
GRADED = (*QUICK, "asymmetric-top", "gravity-gradient", "arenstorf")
_FILE: dict[str, Any] = {"type": Path, "metavar": "FILE"}
_FLAG: dict[str, Any] = {"action": "store_true"}
_STORED = _FILE | {"nargs": "?", "const": STORED}
OPTIONS: dict[str, dict[str, Any]] = {
    "scene": dict(nargs="*", metavar="SCENE", help="which scenes (default: all)"),
    "--quick": _FLAG | dict(help="three scenes, few settings"),
    "--no-peers": _FLAG | dict(help="only what runs in JAX"),
    "--float32": _FLAG | dict(help="in single precision, only what runs in JAX"),
    "--no-gradients": _FLAG | dict(help="values only"),
    "--thin": dict(type=int, default=1, metavar="N", help="every N-th setting"),
    "--csv": _FILE | dict(help="keep the records"),
    "--figure": _FILE | dict(help="draw the charts"),
    "--from": _FILE | dict(dest="stored", help="measure nothing, read the records of --csv"),
    "--choose": _FLAG | dict(help="scene × error → method"),
    "--keep": _STORED
    | dict(help=f"store the table that --check compares with (default: {STORED}); a quick run"),
    "--check": _STORED
    | dict(
        help=f"say what moved since a stored table (default: {STORED}); a quick run; exit code 1 "
        "if an error or a number of steps did"
    ),
}


def add_subcommand(commands: argparse._SubParsersAction) -> None:
    """Add the subcommand `workprecision` to the subcommands of an `argparse` parser."""
    parser = commands.add_parser(
        "workprecision",
        help="error against cost of each method, of values and gradients",
        description="Run methods (ours, diffrax's, and SciPy, numba, MuJoCo, heyoka where "
        "installed) on standard scenes, in one process, in turn, and compare error and time. "
        "Times are of this machine: only their ratios carry over.",
        epilog=f"Scenes: {', '.join(scenes())}, {DRIFT} (a million steps). Without a scene: all "
        "but the slow ones.",
    )
    for name, how in OPTIONS.items():
        parser.add_argument(name, **how)


def run_subcommand(options: argparse.Namespace) -> int:
    """Run the subcommand `workprecision` and return its exit code.

    The code is 0 for success; 1 if, with `--check`, an error or a number of steps differs from the
    stored table of measurements; and 2 for wrong options or files.
    """
    try:
        known = [*scenes(), DRIFT]
        for name in options.scene:
            if name not in known:
                raise ValueError(f"scene: wanted one of {', '.join(known)}, got {name!r}")
        if options.thin < 1:
            raise ValueError(f"--thin: wanted 1 or more, got {options.thin}")
        before = None if options.check is None else read_csv(options.check)
        records = _measure_scenes(options) if options.stored is None else read_csv(options.stored)
        if options.stored is not None and options.scene:
            records = [r for r in records if r.scene in options.scene]
        if options.csv is not None:
            write_csv(records, options.csv)
            print(f"records: {options.csv}")
        if options.keep is not None:
            write_csv(in_base_time(records), options.keep)
            print(f"kept: {options.keep}")
        print(summary(records))
        timed = [r for r in records if not r.scene.startswith(DRIFT)]
        if options.choose:
            print(f"\n{pareto.table(pareto.choose(timed))}")
        if options.figure is not None:
            chart.draw(timed).savefig(options.figure, dpi=110)
            print(f"figure: {options.figure}")
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if before is None:
        return 0
    moved = changes(records, before)
    lines = [*(f"moved: {line}" for line in moved.accuracy)]
    lines += [f"time: {line}" for line in moved.speed]
    print("\n".join(lines or ["nothing moved"]))
    return 1 if moved.accuracy else 0


def _measure_scenes(options: argparse.Namespace) -> list[Measurement]:
    """Measure the methods on the scenes that the options name."""
    quick = options.quick or options.check is not None or options.keep is not None
    names = options.scene or (QUICK if quick else [n for n, m in scenes().items() if not m().slow])
    records: list[Measurement] = []
    begin = time.perf_counter()

    def say(line: str) -> None:
        print(f"{time.perf_counter() - begin:6.1f} s  {line}", file=sys.stderr, flush=True)

    for name in names:
        if name == DRIFT:
            records += long_drift(progress=say)
            continue
        alone = options.no_peers or options.float32
        chosen = [m for m in methods() if not (alone and m.group == "peer")]
        if quick:
            chosen = [m for m in chosen if m.name in SMALL]
            slopes = [{n: m.gradients[n] for n in SMALL[m.name]} for m in chosen]
            chosen = [m._replace(gradients=s) for m, s in zip(chosen, slopes, strict=True)]
        graded = not options.no_gradients and (name in GRADED or bool(options.scene))
        scene, thin = scenes()[name](), 4 if quick else options.thin
        scene = to_float32(scene, graded) if options.float32 else scene
        records += measure(scene, chosen, gradients=graded, progress=say, thin=thin)
    return records


def summary(records: Iterable[Measurement]) -> str:
    """Return a text with a table for each scene, for values and for gradients: a line for each
    method has the times, µs, in which it reaches the errors `pareto.WANTED`, its least error, and
    its compile time, s; for `long_drift` it has the drifts.

    A * marks the methods on the Pareto front of error and time; a + marks the methods on the front
    of the methods in JAX alone.
    """
    records = list(records)
    lines: list[str] = []
    for scene in dict.fromkeys(r.scene for r in records):
        if scene.startswith(DRIFT):
            lines.append(f"\n{scene}: largest drift of energy, of momentum along gravity; s")
            lines += [
                f"  {r.label:38s} h = {r.setting:<5g} {r.energy:10.1e} {r.momentum:10.1e} "
                f"{r.time:10.2f}"
                for r in records
                if r.scene == scene
            ]
            continue
        for kind in ("value", "gradient"):
            of = [r for r in records if (r.scene, r.kind) == (scene, kind)]
            if not of:
                continue
            best = {r.label for r in pareto.pareto_front(of)}
            near = {r.label for r in pareto.pareto_front(r for r in of if r.group != "peer")}
            wanted = "".join(f"{f'{e:.0e}':>10s}" for e in pareto.WANTED)
            lines.append(f"\n{scene}, {kind}: µs to an error of{wanted}   best error  compile, s")
            for label in dict.fromkeys(r.label for r in of):
                mine = [r for r in of if r.label == label]
                times = [1e6 * pareto.time_to(mine, e) for e in pareto.WANTED]
                spent = "".join(f"{'-' if math.isnan(t) else f'{t:.4g}':>10s}" for t in times)
                least = min(r.error for r in mine)
                mark = "*" if label in best else "+" if label in near else " "
                lines.append(f"{mark} {label:38s}{spent}   {least:10.1e}  {mine[0].compile:10.1f}")
    return "\n".join(lines)
