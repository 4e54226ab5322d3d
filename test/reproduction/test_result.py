"""The page's sections, the ledger of processor time, and tables."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cello3d_ros.reproduction.costs import Costs
from cello3d_ros.reproduction.drawing import figure
from cello3d_ros.reproduction.result import Result, markdown_table, publish, with_section


def test_a_section_replaces_its_own_and_nothing_else() -> None:
    page = with_section("# Mine\n\nkept\n", "a", "old\n")
    page = with_section(page, "b", "other\n")
    page = page.replace("<!-- end a -->\n", "<!-- end a -->\nby hand \\1\n")
    again = with_section(page, "a", "new \\1\n")
    assert "old" not in again
    assert again.count("<!-- reproduce a -->") == 1
    assert again.index("new \\1") < again.index("by hand \\1") < again.index("other")
    assert again.startswith("# Mine\n\nkept\n")
    assert with_section(again, "a", "new \\1\n") == again


def test_publishing_twice_leaves_the_same_files(tmp_path: Path) -> None:
    result = Result("fig-x", "X", "Words.", {"n": 3}, [["a", "b"], [1, "2,5"]], figure(2, 2))
    for _ in range(2):
        publish(result, tmp_path / "out", tmp_path / "docs" / "r.md", "cello3d x", 12.34)
    page = (tmp_path / "docs" / "r.md").read_text()
    assert page.count("## X") == 1
    assert "![X](images/fig-x.png)" in page
    assert "`cello3d x`, 12 s of processor time" in page
    assert json.loads((tmp_path / "out" / "fig-x.json").read_text()) == {
        "command": "cello3d x",
        "cpu_s": 12.3,
        "n": 3,
    }
    assert (tmp_path / "out" / "fig-x.csv").read_text() == 'a,b\n1,"2,5"\n'
    picture = (tmp_path / "docs" / "images" / "fig-x.png").read_bytes()
    assert picture[:4] == b"\x89PNG"
    assert picture == (tmp_path / "out" / "fig-x.png").read_bytes()


def test_a_table_is_aligned_for_figures() -> None:
    assert markdown_table([["a", "b"], ["x", "1"]]) == "| a | b |\n| --- | ---: |\n| x | 1 |"


def test_earlier_costs_are_those_of_the_steps_that_are_used(tmp_path: Path) -> None:
    path = tmp_path / "costs.json"
    path.write_text('{"sampling a": 100.0, "sampling b": 7.0}')
    costs = Costs(path)
    with pytest.raises(KeyboardInterrupt):
        _interrupted(costs)
    assert costs.earlier() == 100.0  # what was spent now, the caller has measured
    assert json.loads(path.read_text())["sampling a"] > 100.0
    assert costs.earlier() == 0.0


def _interrupted(costs: Costs) -> None:
    with costs.of("sampling a"):
        sum(k * k for k in range(300_000))
        raise KeyboardInterrupt


def test_a_damaged_ledger_counts_as_none(tmp_path: Path) -> None:
    (tmp_path / "costs.json").write_text("[1")
    costs = Costs(tmp_path / "costs.json")
    with costs.of("a"):
        pass
    assert costs.earlier() == 0.0
