"""The tutorial: its notebook runs on the demo bag, and its page is made of it."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

DOCS = Path(__file__).parents[1] / "docs"
N_PICTURES = 3


@pytest.fixture(scope="module")
def maker() -> ModuleType:
    pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    spec = importlib.util.spec_from_file_location("tutorial_maker", DOCS / "tutorial.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def run(maker: ModuleType, tmp_path_factory: pytest.TempPathFactory):
    """The notebook after all of its cells have run; a cell that fails is an error."""
    pytest.importorskip("gtsam")
    return maker.executed(tmp_path_factory.mktemp("tutorial"))


def blocks(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page, re.DOTALL)


def test_the_page_has_the_cells_of_the_notebook(maker: ModuleType) -> None:
    book = maker.nbformat.read(maker.NOTEBOOK, as_version=4)
    page = maker.PAGE.read_text()
    cells = [cell.source + "\n" for cell in book.cells if cell.cell_type == "code"]
    assert blocks(page) == cells, "write the page again: python docs/tutorial.py"
    texts = [cell.source for cell in book.cells if cell.cell_type == "markdown"]
    assert all(text in page for text in texts), "write the page again: python docs/tutorial.py"
    assert page.count("](images/tutorial-") == N_PICTURES


def test_no_cell_keeps_its_output(maker: ModuleType) -> None:
    """The page has the pictures; a notebook with them changes with every run."""
    book = maker.nbformat.read(maker.NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in book.cells)


def test_the_notebook_runs_and_ours_ends_nearest_to_the_truth(maker: ModuleType, run) -> None:
    page, pictures = maker.page(run)
    assert len(pictures) == N_PICTURES
    assert "Traceback" not in page
    assert "a step is known to" in page
    assert re.search(r"on the blocks of time that were held back: D2/6", page)
    assert re.search(r"On these 24 pairs the model's covariances are", page)
    found = dict(re.findall(r"^(odometry|a constant|this package) +([\d.]+) mm", page, re.M))
    assert float(found["this package"]) < 0.8 * float(found["a constant"])
    assert float(found["a constant"]) < float(found["odometry"])
