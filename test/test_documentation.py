"""README and docs/: the example in Python runs, and every link leads somewhere."""

import re
from pathlib import Path

import numpy as np
import pytest

import cello3d_ros as cello
from cello3d_ros.geometry import se3

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md"))]
T_INIT = se3.exp([0.1, 0.05, 0.0, 0.0, 0.0, 0.05])


def test_the_example_in_python_runs_as_it_stands(room) -> None:
    block = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert block
    names = {"reading_xyz": room[0], "reference_xyz": room[1], "T_init": T_INIT}
    exec(compile(block[1], "README.md", "exec"), names)
    r = names["r"]
    assert isinstance(r, cello.Estimate)
    assert np.abs(r.T_ref_read - np.eye(4)).max() < 0.02
    np.testing.assert_array_equal(np.diag(r.covariance_gtsam())[:3], np.diag(r.covariance)[3:])
    assert r.trust.converged
    assert r.trust.sentence


def anchors(page: Path) -> set[str]:
    """Names that headings of a page give to links: lower case, hyphens, no punctuation."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings_that_exist(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if "://" in link:
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.exists(), f"{link}: no such file"
        assert not anchor or anchor in anchors(target), f"{link}: no such heading"


def test_pages_that_are_named_exist() -> None:
    for page in PAGES:
        for name in re.findall(r"docs/[\w/]+\.md", page.read_text()):
            assert (ROOT / name).exists(), f"{page.name} names {name}"
