"""``cello3d align``: files, words and errors."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli.main import main
from cello3d_ros.geometry.se3 import exp, inverse, log, pose, transform
from cello3d_ros.recordings import Scan
from cello3d_ros.recordings.poses import read_poses, read_tum, tum_line
from cello3d_ros.recordings.writers import write_folder
from cello3d_ros.tracking.warmup import room

N = 5


def truth(n: int = N) -> np.ndarray:
    step = exp(np.array([0.2, 0.02, 0.0, 0.0, 0.0, 0.03]))
    T = [np.eye(4)]
    for _ in range(n - 1):
        T.append(T[-1] @ step)
    return np.array(T)


def recorded(path: Path, T: np.ndarray) -> Path:
    """Write scans of one room without any poses."""
    scans = []
    for k, T_world_sensor in enumerate(T):
        points = transform(inverse(T_world_sensor), room(np.random.default_rng(k)))
        scans.append(Scan(stamp_ns=(k + 1) * 10**8, points=points))
    write_folder(path, scans, ".npy")
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("align") / "mine", truth())


def test_poses_come_out_of_clouds_alone(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, report = tmp_path / "poses.tum", tmp_path / "report.json"
    assert main(["align", str(recording), "--out", str(out), "--report", str(report)]) == 0
    found = read_tum(out.read_bytes(), out)
    assert found.stamps_ns == [(k + 1) * 10**8 for k in range(N)]
    T = pose(found.rows[:, :3], found.rows[:, 3:])
    steps, exact = (inverse(P[:-1]) @ P[1:] for P in (T, truth()))
    assert np.abs(log(inverse(exact) @ steps)).max() < 0.005
    told = capsys.readouterr().out
    assert "mine: 5 of 5 scans aligned in" in told
    assert "a step is known to" in told
    facts = json.loads(report.read_text())
    assert facts["n_aligned"] == N
    assert [scan["reason"] for scan in facts["scans"]] == [""] * N
    assert 0.0 < facts["step_sigma_m"] < 0.01
    assert sorted(p.name for p in tmp_path.iterdir()) == ["poses.tum", "report.json"]


def test_poses_given_by_file_are_the_start(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given, out = tmp_path / "slam.tum", tmp_path / "poses.tum"
    M = exp(np.array([5.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    T = M @ truth() @ exp(np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.0]))
    given.write_text("".join(tum_line((k + 1) * 10**8, T[k]) for k in range(N)))
    assert main(["align", str(recording), "--poses", str(given), "--out", str(out)]) == 0
    rows = read_tum(out.read_bytes(), out).rows
    np.testing.assert_allclose(rows[0, :3], T[0, :3, 3], atol=1e-6)
    given.write_text("".join(tum_line((k + 90) * 10**9, T[k]) for k in range(N)))
    assert main(["align", str(recording), "--poses", str(given), "--out", str(out)]) == 1
    assert "no pose has the time of any scan of mine" in capsys.readouterr().err


def test_a_txt_file_has_a_row_of_kitti_for_each_scan(recording: Path, tmp_path: Path) -> None:
    tum, kitti = tmp_path / "poses.tum", tmp_path / "poses.txt"
    for out in (tum, kitti):
        assert main(["align", str(recording), "--out", str(out)]) == 0
    rows = read_tum(tum.read_bytes(), tum).rows
    found, _ = read_poses(kitti)
    np.testing.assert_allclose(found, pose(rows[:, :3], rows[:, 3:]), atol=1e-12)


def test_a_cloud_without_a_finite_point_is_counted_and_kitti_rows_would_shift(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, out = tmp_path / "copy", tmp_path / "poses.txt"
    shutil.copytree(recording, copy)
    clouds = sorted(copy.glob("*.npy"))
    np.save(clouds[2], np.full((100, 3), np.nan))
    assert main(["align", str(copy), "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert f"{tmp_path / 'poses.tum'}; 1 message left out: malformed" in told
    assert "poses.txt is not written: KITTI's format has a row for each scan, and 4 of 5" in told
    assert not out.exists()
    stamps = read_tum((tmp_path / "poses.tum").read_bytes(), out).stamps_ns
    assert stamps == [(k + 1) * 10**8 for k in range(N) if k != 2]


def test_too_few_scans_and_a_missing_folder_are_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = recorded(tmp_path / "short", truth(2))
    assert main(["align", str(short), "--out", str(tmp_path / "poses.tum")]) == 1
    assert capsys.readouterr().err == ("cello3d: short has 2 scans; aligning needs at least 3\n")
    assert main(["align", str(short), "--out", str(tmp_path / "no" / "poses.tum")]) == 1
    assert "not a file in an existing folder" in capsys.readouterr().err
    assert not (tmp_path / "poses.tum").exists()
