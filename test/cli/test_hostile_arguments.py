"""Arguments that cannot be: one sentence before any work, and no file is lost."""

from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli.main import main
from cello3d_ros.learning.align import align
from cello3d_ros.recordings.folder import FolderRecording

WITH_A_SEED = {
    "align": "rec --out a.tum",
    "estimate": "a.npy b.npy",
    "evaluate": "ds",
    "graph": "rec --out a.g2o",
    "reproduce": "table1",
    "sample": "rec --out ds",
    "simulate": "rooms --out bag",
}
WITH_JOBS = {"tune": "rec --out m.npz", **WITH_A_SEED}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Inputs by name only: whatever is refused is refused before they are read."""
    for name in ("rec", "ds", "clouds"):
        (tmp_path / name).mkdir()
    for name in ("rec/rec.mcap", "ds/manifest.json", "found.json", "poses.tum", "loops.txt"):
        (tmp_path / name).write_text("kept")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(line: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Run a verb; return its one sentence."""
    assert main(line.split()) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("cello3d: ")
    assert err.count("\n") == 1
    return err


def misused(line: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Run a verb that ends as usage; return the last line."""
    with pytest.raises(SystemExit) as stopped:
        main(line.split())
    assert stopped.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("seed", ["-1", "1.5", "nan"])
@pytest.mark.parametrize("verb", WITH_A_SEED)
def test_a_seed_is_a_whole_number_that_is_not_negative(verb, seed, capsys) -> None:
    assert "--seed" in misused(f"{verb} {WITH_A_SEED[verb]} --seed {seed}", capsys)


@pytest.mark.parametrize("verb", sorted(set(WITH_JOBS) - {"estimate", "simulate"}))
def test_there_is_at_least_one_thread(verb, capsys) -> None:
    assert "must be at least 1: 0" in misused(f"{verb} {WITH_JOBS[verb]} --jobs 0", capsys)


@pytest.mark.parametrize(
    "line",
    [
        "sample rec --out ds --samples -5",
        "sample rec --out ds --max-gap 0",
        "tune rec --out m.npz --samples 0",
        "tune rec --out m.npz --max-gap -1",
        "graph rec --out a.g2o --max-gap 0",
        "simulate rooms --out bag --scans 0",
        "simulate rooms --out bag --seeds -2",
        "demo --domain-id -1",
        "demo --domain-id 100000",
    ],
)
def test_counts_out_of_range_are_usage(line, capsys) -> None:
    assert "must be " in misused(line, capsys)


@pytest.mark.parametrize(
    "line",
    [
        "align rec --out rec/rec.mcap",
        "align rec --out new.tum --report rec/rec.mcap",
        "align rec --out poses.tum --poses poses.tum",
        "graph rec/rec.mcap --out a.g2o --out poses.tum --poses poses.tum",
        "graph rec --out loops.txt --loops loops.txt",
        "tune rec --out rec/rec.mcap",
        "report found.json --out found.json",
        "report found.json --out rec/rec.mcap --recordings rec",
        "evaluate ds --json ds/manifest.json",
        "train ds --out ds/manifest.json",
    ],
)
def test_an_output_never_replaces_an_input(line, folder, capsys) -> None:
    assert "cannot write" in (sentence := refused(line, capsys))
    assert "an input" in sentence
    kept = [p.read_text() for p in folder.rglob("*") if p.is_file()]
    assert kept == ["kept"] * 5


@pytest.mark.parametrize("samples", [1, 49])
def test_a_figure_of_too_few_samples_is_refused(samples, folder, capsys) -> None:
    error = refused(f"reproduce fig-cylinder --out new --samples {samples}", capsys)
    assert f"--samples must be at least 50: {samples}" in error
    assert not (folder / "new").exists()


def test_one_file_is_not_written_twice(capsys) -> None:
    for line in ("align rec --out a.tum --report a.tum", "graph rec --out a.g2o --out ./a.g2o"):
        assert "written twice" in refused(line, capsys)


@pytest.mark.parametrize("out", ["rec", "none/a.tum", "/dev/null", "poses.tum/a.tum"])
def test_an_output_is_a_file_in_a_folder_that_is_there(out, capsys) -> None:
    assert f"cannot write {out}: " in refused(f"align rec --out {out}", capsys)


def test_what_the_system_refuses_is_one_sentence_that_names_the_file(capsys) -> None:
    np.save("clouds/0.npy", np.ones((10, 3)))
    assert refused("align clouds --out /proc/a.tum", capsys).startswith("cello3d: /proc/")


def test_a_recording_that_cannot_be_aligned_leaves_nothing_behind(folder, capsys) -> None:
    rng = np.random.default_rng(0)
    for k in range(2):
        np.save(f"clouds/{k}.npy", rng.normal(size=(500, 3)))
    before = sorted(folder.iterdir())
    assert "clouds has 2 scans" in refused("align clouds --out a.tum", capsys)
    assert "clouds has 2 scans" in refused("sample clouds --out new --poses joint", capsys)
    assert sorted(folder.iterdir()) == before


def test_an_interrupt_before_there_is_a_state_leaves_nothing_behind(folder) -> None:
    for k in range(3):
        np.save(f"clouds/{k}.npy", np.random.default_rng(k).normal(size=(500, 3)))

    def interrupt(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        align(FolderRecording(folder / "clouds"), folder=folder / "state", progress=interrupt)
    assert not (folder / "state").exists()
