"""What a table or figure leaves behind: data, a picture, and its section in a Markdown file."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.atomic import new_file
from cello3d_ros.geometry.se3 import Array

_HEAD = """# Results

Every section is written by the command that it names; the rest of this file is kept.
"""
_DPI = 130


class Result(NamedTuple):
    """A table or figure, made.

    what: its name on the command line; text: Markdown below the title; data: everything shown,
    for JSON; rows: a table, its heading first, for CSV; figure: matplotlib's.
    """

    what: str
    title: str
    text: str
    data: dict[str, Any]
    rows: list[list[Any]]
    figure: Any


def listing(xi: Array, kept: NDArray[np.bool_]) -> tuple[dict[str, Any], list[list[Any]]]:
    """Return a pair's registrations, and which of them training keeps, as data and as rows.

    xi: (n, 6), errors about the truth, m and rad.  kept: (n,).
    """
    twists, flags = np.round(xi, 6).tolist(), kept.astype(int).tolist()
    data = {"n_samples": len(xi), "n_kept": int(kept.sum()), "xi": twists, "kept": flags}
    heading = ["x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad", "kept"]
    return data, [heading, *([*x, k] for x, k in zip(twists, flags, strict=True))]


def publish(result: Result, out: Path, page: Path, command: str, cpu_s: float) -> None:
    """Write ``<what>.json``, ``.csv`` and ``.png`` into ``out`` and the section into the page.

    The page shows a copy of the picture, in ``images/`` beside it.
    """
    about = {"command": command, "cpu_s": round(cpu_s, 1)}
    text = json.dumps({**about, **result.data}, indent=1, allow_nan=False)
    write(out / f"{result.what}.json", text.encode() + b"\n")
    table = io.StringIO()
    csv.writer(table, lineterminator="\n").writerows(result.rows)
    write(out / f"{result.what}.csv", table.getvalue().encode())
    picture = io.BytesIO()
    result.figure.savefig(picture, format="png", dpi=_DPI)
    write(out / f"{result.what}.png", picture.getvalue())
    write(page.parent / "images" / f"{result.what}.png", picture.getvalue())
    section = (
        f"## {result.title}\n\n{result.text}\n\n"
        f"![{result.title}](images/{result.what}.png)\n\n"
        f"`{command}`, {_duration(cpu_s)} of processor time.\n"
    )
    before = page.read_text(encoding="utf-8") if page.exists() else _HEAD
    write(page, with_section(before, result.what, section).encode())


def with_section(page: str, name: str, section: str) -> str:
    """Return the page with a section between its markers, in place of an older one or at the end.

    What stands outside the markers is kept as it is.
    """
    start, end = f"<!-- reproduce {name} -->", f"<!-- end {name} -->"
    block = f"{start}\n{section}{end}\n"
    pattern = re.compile(re.escape(start) + r".*?" + re.escape(end) + r"\n?", re.DOTALL)
    if pattern.search(page):
        return pattern.sub(lambda _: block, page, count=1)
    return page.rstrip("\n") + "\n\n" + block


def markdown_table(rows: Iterable[Sequence[str]]) -> str:
    """Return rows of cells, the heading first, as a table; all but the first column right."""
    heading, *body = rows
    rule = ["---", *["---:"] * (len(heading) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (heading, rule, *body))


def write(path: Path, content: bytes) -> None:
    """Write a file in one piece, making its folder.  Raises WriteError."""
    with new_file(path) as partial:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(content)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
