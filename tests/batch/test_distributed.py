"""What one process alone can go wrong with: traced arrays, files that are no shares."""

import resource

import jax
import numpy as np
import pytest

from rigidjax.batch import distributed


@pytest.mark.parametrize("name", ["gather", "total"])
def test_traced_arrays_are_refused_in_words(name):
    with pytest.raises(TypeError, match=f"{name}: wanted a tree of known arrays"):
        jax.jit(getattr(distributed, name))(np.ones(2))


@pytest.mark.parametrize("cut", [0, 40, -30])
def test_a_damaged_share_is_named(tmp_path, cut):
    path = distributed.save(np.arange(3.0), tmp_path)
    assert distributed.recover(np.zeros(3), tmp_path)[0].tolist() == [0.0, 1.0, 2.0]
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(ValueError, match=r"recover: .*share-0.npz was not written by save"):
        distributed.recover(np.zeros(3), tmp_path)


def test_a_share_of_another_tree_is_named(tmp_path):
    distributed.save(np.arange(3.0), tmp_path)
    with pytest.raises(
        ValueError, match=r"a file of 2 arrays, as `like` has, got .*share-0.npz with 1"
    ):
        distributed.recover((np.zeros(3), np.zeros(3)), tmp_path)
    with pytest.raises(FileNotFoundError, match="wanted a folder with files share"):
        distributed.recover(np.zeros(3), tmp_path / "none")


@pytest.mark.parametrize("name", ["gather", "total"])
def test_a_share_that_cannot_be_written_is_sent_all_the_same(tmp_path, name):
    taken = tmp_path / "file"
    taken.write_text("no folder")
    with pytest.warns(UserWarning, match=f"share of this process could not be written to {taken}"):
        found = getattr(distributed, name)(np.arange(3.0), taken)
    assert found.tolist() == [0.0, 1.0, 2.0]


def test_a_full_disk_leaves_no_part_of_a_share(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
        with pytest.raises(OSError, match="File too large"):
            distributed.save(np.arange(3.0), tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())
