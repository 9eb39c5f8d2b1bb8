"""README and the guide tell the truth: their Python blocks run, their links lead somewhere."""

import json
import re
from urllib.parse import unquote

import jax
import numpy as np
import pytest
import scipy.integrate
from pages import FENCE, PAGES, README, ROOT, alike, blocks, name_of, run, text_of

import rigidjax as rj

LISTS = (ROOT / "CHANGELOG.md", ROOT / "tests" / "failures" / "README.md")
RUN = (README, *PAGES)
_LINK = re.compile(r"!?\[[^\]\n]*\]\(([^)\s]+)\)")


def prose(path):
    """The page without its blocks and `code`."""
    return re.sub(r"`[^`\n]+`", "", FENCE.sub("", text_of(path)))


def anchors(path):
    """The headings of a page as links name them."""
    if path.suffix != ".md":
        return set()
    titles = re.findall(r"^#+ (.+)$", FENCE.sub("", text_of(path)), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def run_as_shown(path, parts=slice(None)):
    """Run blocks of a page, compare what they print with the page, and return names and outputs."""
    pytest.importorskip("matplotlib")
    names, printed = run(path, parts)
    assert "nan" not in "".join(printed)
    for (block, shown), output in zip(blocks(path)[parts], printed, strict=True):
        assert alike(shown, output), f"{block}\nshown:\n{shown}\nprinted:\n{output}"
    return names, printed


@pytest.mark.parametrize("path", [path for path in PAGES if blocks(path)], ids=name_of)
def test_blocks_print_what_the_page_shows(path):
    # optax multiplies numbers of other dtypes, which strict promotion refuses.
    promotion = "standard" if "import optax" in text_of(path) else "strict"
    with jax.numpy_dtype_promotion(promotion):
        run_as_shown(path)


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("[-0.12 3.]", "[ -0.13  3.0]", True),
        ("error 3e-16", "error -1e-16", True),
        ("85 steps", "86 steps", True),
        ("(64, 4)", "(64, 5)", False),
        ("1.25", "1.27", False),
        ("ok 1.0", "not alone 1.0", False),
    ],
)
def test_outputs_are_compared_by_the_digits_shown(shown, printed, same):
    assert alike(shown, printed) is same


def spun(moments, ts, until=0.0):
    """README's body by SciPy: Euler's equations; until a time a thruster turns it about z, 0.01 N m.

    Each run ends at the switch, where the next one begins.
    """
    moments = np.asarray(moments)
    rows, state = [], [0.02, 6.0, 0.02]
    for begin, end, torque in ((ts[0], until, 0.01), (max(ts[0], until), ts[-1], 0.0)):
        if begin < end:
            push = np.array([0.0, 0.0, torque])
            found = scipy.integrate.solve_ivp(
                lambda _, w, push=push: (np.cross(moments * w, w) + push) / moments,
                [begin, end], state, "DOP853", ts[(ts >= begin) & (ts <= end)], rtol=1e-12, atol=1e-14,
                dense_output=True,
            )  # fmt: skip
            rows.append(found.y.T)
            state = found.sol(end)
    return np.concatenate(rows)


def test_readme_simulates_what_it_says():
    names, _ = run_as_shown(README, slice(1))
    body, sol = names["body"], names["sol"]
    np.testing.assert_allclose(
        sol.ys.omega, spun(np.diag(body.inertia.tensor), np.asarray(sol.ts)), atol=1e-7
    )
    assert sol.ys.omega[:, 1].min() < -5.9


@pytest.mark.long
def test_readme_differentiates_and_fits_what_it_says():
    names, printed = run_as_shown(README)
    moments, h, ends = np.diag(names["body"].inertia.tensor), 1e-5, np.array([0.0, 3.0])
    over, under = (spun(moments, ends, 1.0 + step)[-1, 2] for step in (h, -h))
    slope, error = printed[1].splitlines()
    assert float(slope) == pytest.approx((over - under) / (2 * h), rel=1e-6)
    off = names["run"](1.0).ys.omega[-1] - spun(moments, ends, 1.0)[-1]
    stated = float(re.search(r"omega (\S+),", error)[1])
    assert 0.25 * stated < np.linalg.norm(off) < 4 * stated
    found = names["found"]
    assert found.ok
    for name, ratio in (("Ix/Iz", 1.0 / 2.2), ("Iy/Iz", 1.6 / 2.2)):
        low, high = found.interval(0.95)[name]
        assert low < ratio < high


def test_readme_is_short():
    """The outputs below its blocks do not count."""
    shown = sum(output.count("\n") + 3 for _, output in blocks(README) if output)
    assert len(text_of(README).splitlines()) - shown <= 180


@pytest.mark.parametrize("path", PAGES, ids=name_of)
def test_a_page_says_first_what_one_learns(path):
    lines = text_of(path).splitlines()
    assert lines[0].startswith("# ")
    # The landing page begins with what the library is.
    assert lines[2].startswith("*You learn: ") or path.name == "index.md"


@pytest.mark.parametrize("path", [*RUN, *LISTS], ids=name_of)
def test_links_lead_to_files(path):
    for link in _LINK.findall(prose(path)):
        place, _, heading = unquote(link).partition("#")
        # The reference is made by the build of the site, which checks links to it.
        if re.match(r"[a-z]+:|reference/", place):
            continue
        there = (path.parent / place) if place else path
        assert there.exists(), link
        assert not heading or heading in anchors(there), link


def test_every_page_can_be_found():
    """README names each page of the guide, the site's contents each page there is."""
    contents = "\n".join(found[3] for found in FENCE.finditer(text_of(ROOT / "notebooks/index.md")))
    for path in PAGES:
        page = path.relative_to(ROOT / "notebooks").with_suffix("").as_posix()
        assert page == "index" or page in contents.split(), page
    named = {(ROOT / link.partition("#")[0]).resolve() for link in _LINK.findall(prose(README))}
    assert named >= set((ROOT / "notebooks" / "guide").glob("*.md"))


def test_the_guide_stands_in_the_same_groups_in_readme_and_on_the_site():
    lines = text_of(README).partition("## Guide")[2].splitlines()
    groups = {}
    for line in lines:
        if found := re.match(r"\| \*\*(.+)\*\* \|", line):
            pages = groups[found[1].lower()] = []
        elif found := re.match(r"\| \[.+\]\(notebooks/(guide/\w+)\.md\) \| .", line):
            pages.append(found[1])
    trees = re.findall(
        r'^:caption: "Guide: (.+)"\n(?::.+\n)+([^`]+)```',
        text_of(ROOT / "notebooks/index.md"),
        re.M,
    )
    assert len(trees) == 4 and groups == {name: found.split() for name, found in trees}


@pytest.mark.parametrize("path", [*RUN, *LISTS], ids=name_of)
def test_tables_are_rectangular(path):
    rows = []
    for line in [*FENCE.sub("", text_of(path)).splitlines(), ""]:
        if line.startswith("|"):
            rows.append(len(re.findall(r"(?<!\\)\|", line)))
        else:
            assert len(set(rows)) <= 1, line or path
            rows = []


@pytest.mark.parametrize("path", RUN, ids=name_of)
def test_names_exist(path):
    missing = []
    for name in sorted(set(re.findall(r"`rj\.([a-zA-Z_][\w.]*)", text_of(path)))):
        thing = rj
        for part in name.rstrip(".").split("."):
            thing = getattr(thing, part, None)
        if thing is None:
            missing.append(name)
    assert not missing


def test_tests_and_files_that_pages_mention_exist():
    tests = ROOT / "tests"
    sources = "\n".join(text_of(path) for path in tests.rglob("test_*.py"))
    text = "\n".join(text_of(path) for path in RUN)
    for name in re.findall(r"`(?:[\w/]+\.py::)?(test_\w+)…?`", text):
        assert f"def {name}" in sources, name
    files = re.findall(r"\b((?:tests|notebooks)/[\w/]+\.(?:py|md|ipynb))\b", text)
    assert len(files) > 20
    for path in files:
        assert (ROOT / path).exists(), path


def test_pictures_are_small():
    pictures = sorted((ROOT / "notebooks" / "images").rglob("*.png"))
    assert pictures and all(path.stat().st_size <= 60_000 for path in pictures)


def test_blocks_fit_on_the_site():
    for path in RUN:
        lines = [line for block, _ in blocks(path) for line in block.splitlines()]
        assert not [line for line in lines if len(line) > 100]


def test_the_gallery_shows_every_notebook():
    text = text_of(ROOT / "notebooks" / "gallery.md")
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        assert f"](images/thumbnails/{path.stem}.png)" in text
        assert f"]({path.name})" in text and f"\n{path.stem}\n" in text


def test_a_notebook_opens_with_its_title_and_ends_with_where_to_go_on():
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        cells = json.loads(text_of(path))["cells"]
        assert cells[0]["cell_type"] == "markdown" and cells[0]["source"][0].startswith("# ")
        assert cells[-1]["source"][0].startswith("**Continue from here:** ")


def test_a_page_of_the_guide_ends_with_where_to_go_on():
    for path in (ROOT / "notebooks" / "guide").glob("*.md"):
        assert text_of(path).rstrip().rpartition("\n\n")[2].startswith("**Continue from here:** ")
