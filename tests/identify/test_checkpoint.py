"""What fails beside a search does not end it: a full disk, a second program, a closed output."""

import errno
import os
import resource
import shutil
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.search.checkpoint import Checkpoint, fingerprint
from rigidjax.identify.search.stages import Attempt

TS = np.linspace(0.0, 3.0, 25)


def problem():
    body = rj.Inertia.from_principal(1.0, 1.5, 2.2)
    read = rj.simulate(body, rj.Spin([0.7, -0.3, 1.4]), TS).ys.omega
    record = identify.Recording(TS, (identify.Gyro(0.01), read))
    return identify.Model([record, record], identify.PrincipalRatios())


def attempt(problem):
    return Attempt(problem.start(None, [0.7, -0.3, 1.4]))


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def kept(tmp_path):
    like = attempt(problem())
    return Checkpoint(tmp_path / "fit.npz", like, "print"), like, tmp_path


def test_a_full_disk_is_said_with_the_name_of_the_file(kept):
    keep, like, folder = kept
    keep.save([like])
    before = keep.path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        # The kernel refuses every byte, as a full disk does.
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
        with pytest.warns(UserWarning, match=rf"{keep.path} is not up to date \(File too large\)"):
            keep.save([like] * 2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert names(folder) == ["fit.npz"] and keep.path.read_bytes() == before
    keep.save([like] * 2)
    assert len(Checkpoint(keep.path, like, "print").done) == 2


def test_two_programs_write_to_one_checkpoint(kept, monkeypatch):
    keep, like, folder = kept
    other, write = Checkpoint(keep.path, like, "print"), eqx.tree_serialise_leaves

    def meanwhile(file, tree):
        # In the middle of the first program's writing the second one writes all of its own.
        monkeypatch.setattr(eqx, "tree_serialise_leaves", write)
        other.save([like] * 3)
        write(file, tree)

    monkeypatch.setattr(eqx, "tree_serialise_leaves", meanwhile)
    keep.save([like])
    assert names(folder) == ["fit.npz"]
    assert len(Checkpoint(keep.path, like, "print").done) == 1


def test_a_fit_whose_folder_vanishes_is_not_lost(tmp_path):
    folder = tmp_path / "runs"
    folder.mkdir()
    path, lines = folder / "fit.npz", []

    def progress(line):
        lines.append(line)
        if folder.exists():
            shutil.rmtree(folder)

    with pytest.warns(UserWarning, match=rf"checkpoint {path} is not up to date \(No such file"):
        found = identify.fit(problem(), starts=2, checkpoint=path, progress=progress)
    assert len(lines) == 2 and float(found.chi2) < 1.0


def test_a_closed_output_does_not_end_a_fit():
    def progress(line):
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))

    with pytest.warns(UserWarning, match=r"progress could not be written \(Broken pipe\)"):
        found = identify.fit(problem(), starts=1, progress=progress)
    assert float(found.chi2) < 1.0

    def wrong(line):
        raise KeyError(line)

    # A mistake in the function itself is raised.
    with pytest.raises(KeyError):
        identify.fit(problem(), starts=1, progress=wrong)


def test_a_function_in_a_law_counts_by_its_name():
    def made(scale):
        def named(x):
            return scale * x

        return named

    first, same = made(1.0), made(1.0)
    assert fingerprint((first, jnp.ones(2))) == fingerprint((same, jnp.ones(2)))
    assert fingerprint((first, jnp.ones(2))) != fingerprint((jnp.tanh, jnp.ones(2)))
    assert fingerprint(("odd", 1.0)) != fingerprint(("even", 1.0))


def test_a_checkpoint_that_is_written_says_nothing(kept):
    keep, like, _ = kept
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        keep.save([like])
    assert len(Checkpoint(keep.path, like, "print").done) == 1
