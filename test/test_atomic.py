"""A file or folder appears under its name when it is complete, or not at all."""

import contextlib
from pathlib import Path

import pytest

from cello3d_ros.atomic import new_file, new_folder
from cello3d_ros.errors import WriteError


def test_a_file_replaces_the_old_one_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with new_file(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupted_write_keeps_the_old_file_and_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with contextlib.suppress(KeyboardInterrupt), new_file(path) as partial:
        partial.write_text("ne")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("target", ["missing/a.txt", "", "/dev/full"])
def test_a_place_that_takes_no_file_is_one_sentence(tmp_path: Path, target: str) -> None:
    with pytest.raises(WriteError, match="cannot write"), new_file(tmp_path / target) as partial:
        partial.write_text("new")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    with contextlib.suppress(ValueError), new_folder(tmp_path / "b") as folder:
        folder.mkdir()
        raise ValueError("broke")
    assert list(tmp_path.iterdir()) == []
    with new_folder(tmp_path / "b") as folder:
        folder.mkdir()
        (folder / "one").write_text("1")
        assert not (tmp_path / "b").exists()
    assert (tmp_path / "b" / "one").read_text() == "1"


def test_a_folder_gives_way_only_where_that_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "old").write_text("")
    with pytest.raises(WriteError, match="exists already"), new_folder(tmp_path / "b"):
        pass
    with new_folder(tmp_path / "b", replace=True) as folder:
        folder.mkdir()
    assert list((tmp_path / "b").iterdir()) == []
