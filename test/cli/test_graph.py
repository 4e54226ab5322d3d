"""``cello3d graph``: pose graphs as g2o, GTSAM and tables read them."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.cli.main import main
from cello3d_ros.geometry.se3 import exp, inverse, log, pose, transform
from cello3d_ros.recordings import Scan
from cello3d_ros.recordings.poses import tum_line
from cello3d_ros.recordings.writers import write_folder
from cello3d_ros.tracking.warmup import room

N = 5
TRUTH = np.array([exp(k * np.array([0.2, 0.02, 0.0, 0.0, 0.0, 0.05])) for k in range(N)])


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scans of a room without poses."""
    path = tmp_path_factory.mktemp("graph") / "mine"
    scans = [
        Scan(
            stamp_ns=(k + 1) * 10**8, points=transform(inverse(T), room(np.random.default_rng(k)))
        )
        for k, T in enumerate(TRUTH)
    ]
    write_folder(path, scans, ".npy")
    return path


@pytest.fixture(scope="module")
def poses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The poses as a SLAM would give them."""
    path = tmp_path_factory.mktemp("slam") / "slam.tum"
    path.write_text("".join(tum_line((k + 1) * 10**8, T) for k, T in enumerate(TRUTH)))
    return path


def graph(recording: Path, out: Path, *flags: str) -> Path:
    assert main(["graph", str(recording), "--out", str(out), *flags]) == 0
    return out


def test_the_three_files_hold_the_same_edges(recording: Path, poses: Path, tmp_path: Path) -> None:
    flags = ("--poses", str(poses), "--max-gap", "2")
    g2o, gtsam, table = (
        graph(recording, tmp_path / f"g{e}", *flags) for e in (".g2o", ".json", ".csv")
    )
    edges = json.loads(gtsam.read_text())["edges"]
    assert [(edge["i"], edge["j"]) for edge in edges] == [
        (i, j) for j in range(1, N) for i in range(max(0, j - 2), j)
    ]
    rows = list(csv.DictReader(table.read_text().splitlines()))
    lines = [x.split() for x in g2o.read_text().splitlines() if x.startswith("EDGE_SE3:QUAT")]
    assert len(edges) == len(rows) == len(lines)
    order = [3, 4, 5, 0, 1, 2]
    for edge, row, line in zip(edges, rows, lines, strict=True):
        T = np.reshape(edge["T"], (4, 4))
        assert np.abs(log(inverse(T) @ inverse(TRUTH[edge["i"]]) @ TRUTH[edge["j"]])).max() < 0.02
        C = np.reshape(edge["covariance_gtsam"], (6, 6))[np.ix_(order, order)]
        cells = [float(row[f"c{a}{b}"]) for a in range(6) for b in range(6)]
        np.testing.assert_allclose(np.reshape(cells, (6, 6)), C, rtol=1e-12)
        numbers = np.array(line[3:], float)
        np.testing.assert_allclose(pose(numbers[:3], numbers[3:7]), T, atol=1e-12)
        information = np.zeros((6, 6))
        information[np.triu_indices(6)] = numbers[7:]
        information += np.triu(information, 1).T
        # error of g2o for a small xi: translation and half of the rotation vector
        xi = np.random.default_rng(0).normal(size=6) * np.sqrt(np.diag(C))
        error = xi * [1, 1, 1, 0.5, 0.5, 0.5]
        np.testing.assert_allclose(error @ information @ error, xi @ np.linalg.solve(C, xi))


def test_gtsam_ends_at_the_truth_with_these_edges(
    recording: Path, poses: Path, tmp_path: Path
) -> None:
    gtsam = pytest.importorskip("gtsam")
    file = graph(recording, tmp_path / "g.json", "--poses", str(poses), "--max-gap", "2")
    facts = json.loads(file.read_text())
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, vertex in enumerate(facts["vertices"]):
        values.insert(k, gtsam.Pose3(np.reshape(vertex["T"], (4, 4)) @ exp(np.full(6, 0.02 * k))))
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(TRUTH[0]), tight))
    for edge in facts["edges"]:
        noise = gtsam.noiseModel.Gaussian.Covariance(np.reshape(edge["covariance_gtsam"], (6, 6)))
        T = gtsam.Pose3(np.reshape(edge["T"], (4, 4)))
        factors.add(gtsam.BetweenFactorPose3(edge["i"], edge["j"], T, noise))
    found = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    for k in range(N):
        assert np.abs(log(inverse(TRUTH[k]) @ found.atPose3(k).matrix())).max() < 0.02


def test_external_poses_keep_their_values_and_get_covariances(
    recording: Path, poses: Path, tmp_path: Path
) -> None:
    flags = ("--poses", str(poses), "--registration", "external")
    file = graph(recording, tmp_path / "g.json", *flags)
    for edge in json.loads(file.read_text())["edges"]:
        T = np.reshape(edge["T"], (4, 4))
        np.testing.assert_allclose(T, inverse(TRUTH[edge["i"]]) @ TRUTH[edge["j"]], atol=1e-9)
        assert (np.linalg.eigvalsh(np.reshape(edge["covariance_gtsam"], (6, 6))) > 0.0).all()


def test_a_recording_without_poses_says_how_to_get_them(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "g.g2o"
    assert main(["graph", str(recording), "--out", str(out)]) == 1
    assert "find them (--poses joint)" in capsys.readouterr().err
    assert main(["graph", str(recording), "--out", str(tmp_path / "g.txt")]) == 1
    assert "a graph is written as .g2o, .json, .csv" in capsys.readouterr().err
    graph(recording, out, "--poses", "joint")
    told = capsys.readouterr().out
    assert "5 poses, 4 edges" in told
