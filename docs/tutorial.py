"""Run the notebook and write its page: python docs/tutorial.py.

nbclient runs the cells in a kernel; the page is written here, because the few lines need none of
the packages of nbconvert.
"""

from __future__ import annotations

import base64
import os
import re
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

DOCS = Path(__file__).parent
NOTEBOOK, PAGE, IMAGES = DOCS / "tutorial.ipynb", DOCS / "tutorial.md", DOCS / "images"


def executed(folder: Path | str) -> nbformat.NotebookNode:
    """Return the notebook with its outputs; it writes its files to the folder.

    Raises nbclient's CellExecutionError for a cell that fails.
    """
    book = nbformat.read(NOTEBOOK, as_version=4)
    before = os.environ["PATH"]
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{before}"  # cello3d
    try:
        where = {"metadata": {"path": str(folder)}}
        return NotebookClient(book, timeout=1800, resources=where).execute()
    finally:
        os.environ["PATH"] = before


def _printed(cell: nbformat.NotebookNode) -> str:
    """Return what a cell has printed, without bars, colours and the place of this folder."""
    text = "".join(o.text for o in cell.outputs if o.output_type == "stream")
    text = re.sub(r"\x1b\[[0-9;]*[A-Za-z]", "", text)  # colours and cursor of a terminal
    lines = [line.rsplit("\r", 1)[-1].rstrip() for line in text.replace("\r\n", "\n").split("\n")]
    return "\n".join(lines).strip("\n").replace(f"{DOCS.parent}{os.sep}", "")


def page(book: nbformat.NotebookNode) -> tuple[str, dict[str, bytes]]:
    """Return the page of an executed notebook, and its pictures by name."""
    parts = ["<!-- made of tutorial.ipynb by docs/tutorial.py -->"]
    pictures: dict[str, bytes] = {}
    for cell in book.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        if text := _printed(cell):
            parts.append(f"```\n{text}\n```")
        for output in cell.outputs:
            if data := output.get("data", {}).get("image/png"):
                name = f"tutorial-{len(pictures) + 1}.png"
                title = re.search(r"plt\.suptitle\(\"(.*?)\"\)", cell.source)
                pictures[name] = base64.b64decode(data)
                parts.append(f"![{title[1] if title else name}](images/{name})")
    return "\n\n".join(parts) + "\n", pictures


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        text, found = page(executed(scratch))
    PAGE.write_text(text)
    for name, data in found.items():
        (IMAGES / name).write_bytes(data)
    print(PAGE)
