"""``cello3d graph``: pose graphs as g2o, GTSAM, evo and tables read them."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cello3d_ros as cello
from cello3d_ros.cli.main import main
from cello3d_ros.geometry.gaussian import compound_right
from cello3d_ros.geometry.se3 import Array, exp, inverse, log, pose, quaternion, transform
from cello3d_ros.recordings import Scan
from cello3d_ros.recordings.odometry import Drift
from cello3d_ros.recordings.poses import kitti_line, tum_line
from cello3d_ros.recordings.writers import write_folder
from cello3d_ros.tracking.warmup import room

N = 5
TRUTH = np.array([exp(k * np.array([0.2, 0.02, 0.0, 0.0, 0.0, 0.05])) for k in range(N)])
TRANSLATION_FIRST = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
DRIFT = ("--odometry", "simulated", "--odometry-drift", "0.02", "0.5", "0.05")


def scans() -> list[Scan]:
    """Scans of a room without poses."""
    rngs = [np.random.default_rng(k) for k in range(N)]
    clouds = [transform(inverse(T), room(rng)) for T, rng in zip(TRUTH, rngs, strict=True)]
    return [Scan(stamp_ns=(k + 1) * 10**8, points=points) for k, points in enumerate(clouds)]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("graph") / "mine"
    write_folder(path, scans(), ".npy")
    return path


@pytest.fixture(scope="module")
def poses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The poses as a SLAM would give them."""
    path = tmp_path_factory.mktemp("slam") / "slam.tum"
    path.write_text("".join(tum_line((k + 1) * 10**8, T) for k, T in enumerate(TRUTH)))
    return path


@pytest.fixture(scope="module")
def files(recording: Path, poses: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one graph in each format: registrations over 1 and 2 scans, and a loop."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "loops.txt").write_text("# scans that meet again\n0 4\n")
    out = [flag for e in FORMATS for flag in ("--out", str(folder / f"graph{e}"))]
    flags = ["--poses", str(poses), "--max-gap", "2", "--loops", str(folder / "loops.txt")]
    assert main(["graph", str(recording), *out, *flags]) == 0
    return folder


FORMATS = (".g2o", ".json", ".csv", ".tum", ".txt")


def graph(recording: Path, out: Path, *flags: str) -> list[dict]:
    assert main(["graph", str(recording), "--out", str(out), *flags]) == 0
    return json.loads(out.read_text())["edges"] if out.suffix == ".json" else []


def edges_of(folder: Path) -> list[dict]:
    return json.loads((folder / "graph.json").read_text())["edges"]


def matrices(edge: dict) -> tuple[Array, Array]:
    """The pose and the covariance, translation first, of an edge of the JSON."""
    C = np.reshape(edge["covariance_gtsam"], (6, 6))
    return np.reshape(edge["T"], (4, 4)), C[TRANSLATION_FIRST]


def test_the_files_hold_the_same_edges(files: Path) -> None:
    edges = edges_of(files)
    near = [(i, j, "registration") for j in range(1, N) for i in range(max(0, j - 2), j)]
    assert [(e["i"], e["j"], e["kind"]) for e in edges] == [*near, (0, 4, "loop")]
    rows = list(csv.DictReader((files / "graph.csv").read_text().splitlines()))
    lines = [x.split() for x in (files / "graph.g2o").read_text().splitlines()]
    lines = [line for line in lines if line[0] == "EDGE_SE3:QUAT"]
    for edge, row, line in zip(edges, rows, lines, strict=True):
        T, C = matrices(edge)
        i, j = edge["i"], edge["j"]
        assert np.abs(log(inverse(T) @ inverse(TRUTH[i]) @ TRUTH[j])).max() < 0.02
        assert [int(row[k]) for k in ("i", "j")] == [int(x) for x in line[1:3]] == [i, j]
        assert int(row["stamp_j_ns"]) == (j + 1) * 10**8
        assert row["kind"] == edge["kind"]
        assert float(row["novelty"]) == edge["trust"]["novelty"]
        assert bool(int(row["is_lost"])) == edge["trust"]["is_lost"]
        cells = [float(row[f"c{a}{b}"]) for a in range(6) for b in range(6)]
        np.testing.assert_array_equal(np.reshape(cells, (6, 6)), C)
        numbers = np.array(line[3:10], float)
        np.testing.assert_allclose(pose(numbers[:3], numbers[3:]), T, atol=1e-12)
        assert numbers.tolist() == [float(row[k]) for k in ("x", "y", "z", "qx", "qy", "qz", "qw")]


def test_the_poses_come_out_as_they_went_in(files: Path, poses: Path) -> None:
    rows = (np.loadtxt(path) for path in (files / "graph.tum", poses))
    np.testing.assert_allclose(*rows, atol=1e-12)
    rows = np.loadtxt(files / "graph.txt").reshape(N, 3, 4)
    np.testing.assert_allclose(rows, TRUTH[:, :3], atol=1e-12)


def test_an_edge_is_what_the_estimator_says_of_its_two_scans(files: Path) -> None:
    found = scans()
    estimator = cello.Estimator("general")
    for edge in edges_of(files):
        i, j = edge["i"], edge["j"]
        T = np.ascontiguousarray(inverse(TRUTH[i]) @ TRUTH[j])
        r = estimator(found[j].points, found[i].points, T)
        np.testing.assert_allclose(matrices(edge)[0], r.T_ref_read, atol=1e-9)
        np.testing.assert_allclose(matrices(edge)[1], r.covariance, rtol=1e-6, atol=1e-12)


def test_g2o_weighs_an_error_as_the_covariance_does(files: Path) -> None:
    """Of g2o itself: chi2 of an edge is ``xi^T Y^-1 xi``, to first order in xi."""
    g2o = pytest.importorskip("g2opy")
    solver = g2o.SparseOptimizer()
    assert solver.load(str(files / "graph.g2o"))
    found = {tuple(v.id() for v in edge.vertices()): edge for edge in solver.edges()}
    rng = np.random.default_rng(0)
    for edge in edges_of(files):
        T, Y = matrices(edge)
        factor = found[edge["i"], edge["j"]]
        xi = 1e-4 * np.linalg.cholesky(Y) @ rng.normal(size=6)
        T_i = exp([5.0, -3.0, 1.0, 0.4, -0.2, 2.0])
        for vertex, estimate in zip(factor.vertices(), (T_i, T_i @ T @ exp(xi)), strict=True):
            vertex.set_estimate(g2o.Isometry3d(estimate))
        factor.compute_error()
        np.testing.assert_allclose(factor.error, xi * [1, 1, 1, 0.5, 0.5, 0.5], atol=1e-9)
        assert factor.chi2() == pytest.approx(xi @ np.linalg.solve(Y, xi), rel=1e-3)


def chain(folder: Path) -> tuple[Array, Array]:
    """Compound the edges from scan to scan: the pose and its covariance to second order."""
    steps = [matrices(e) for e in edges_of(folder) if e["j"] == e["i"] + 1]
    T, Y = steps[0]
    for step in steps[1:]:
        T, Y = compound_right(T, Y, *step, order=2)
    return T, Y


def test_g2o_compounds_a_chain_to_the_same_pose(files: Path, tmp_path: Path) -> None:
    g2o = pytest.importorskip("g2opy")
    lines = (files / "graph.g2o").read_text().splitlines(keepends=True)
    kept = [x for x in lines if x.startswith("VERTEX") or is_step(x)]
    (tmp_path / "chain.g2o").write_text("".join(kept))
    solver = g2o.SparseOptimizer()
    block = g2o.BlockSolverSE3(g2o.LinearSolverEigenSE3())
    solver.set_algorithm(g2o.OptimizationAlgorithmGaussNewton(block))
    solver.load(str(tmp_path / "chain.g2o"))
    vertices = solver.vertices()
    vertices[0].set_fixed(True)
    solver.initialize_optimization()
    solver.optimize(20)
    found = inverse(vertices[0].estimate().matrix()) @ vertices[N - 1].estimate().matrix()
    np.testing.assert_allclose(found, chain(files)[0], atol=1e-6)


def is_step(line: str) -> bool:
    """Whether a line of a g2o file is an edge from a scan to the next."""
    words = line.split()
    return words[0].startswith("EDGE") and int(words[2]) == int(words[1]) + 1


def test_gtsam_compounds_a_chain_to_the_same_pose_and_covariance(files: Path) -> None:
    gtsam = pytest.importorskip("gtsam")
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    exact = gtsam.noiseModel.Isotropic.Sigma(6, 1e-9)
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), exact))
    values.insert(0, gtsam.Pose3())
    for edge in (e for e in edges_of(files) if e["j"] == e["i"] + 1):
        T = gtsam.Pose3(np.reshape(edge["T"], (4, 4)))
        noise = gtsam.noiseModel.Gaussian.Covariance(np.reshape(edge["covariance_gtsam"], (6, 6)))
        factors.add(gtsam.BetweenFactorPose3(edge["i"], edge["j"], T, noise))
        values.insert(edge["j"], values.atPose3(edge["i"]).compose(T))
    found = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    C = gtsam.Marginals(factors, found).marginalCovariance(N - 1)[TRANSLATION_FIRST]
    T, Y = chain(files)
    np.testing.assert_allclose(found.atPose3(N - 1).matrix(), T, atol=1e-6)
    np.testing.assert_allclose(C, Y, atol=1e-6 * np.abs(Y).max())


def test_gtsam_reads_the_g2o_file_with_rotations_at_half_their_deviation(files: Path) -> None:
    """Its reader takes the information for that of rotation vectors: hence the JSON."""
    gtsam = pytest.importorskip("gtsam")
    factors, values = gtsam.readG2o(str(files / "graph.g2o"), True)
    edges = edges_of(files)
    assert (factors.size(), values.size()) == (len(edges), N)
    half = np.diag([0.5, 0.5, 0.5, 1.0, 1.0, 1.0])
    for k, edge in enumerate(edges):
        factor = factors.at(k)
        assert list(factor.keys()) == [edge["i"], edge["j"]]
        np.testing.assert_allclose(factor.measured().matrix(), matrices(edge)[0], atol=1e-9)
        C = half @ np.reshape(edge["covariance_gtsam"], (6, 6)) @ half
        np.testing.assert_allclose(factor.noiseModel().covariance(), C, rtol=1e-6, atol=1e-15)


def test_a_loop_starts_at_the_pose_that_it_gives(
    recording: Path, tmp_path: Path, poses: Path
) -> None:
    """Where the poses have drifted half a radian, the loop is closed all the same."""
    drifted = tmp_path / "drifted.tum"
    drift = [exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.12 * k]) for k in range(N)]
    drifted.write_text(
        "".join(
            tum_line((k + 1) * 10**8, T @ D)
            for k, (T, D) in enumerate(zip(TRUTH, drift, strict=True))
        )
    )
    T = inverse(TRUTH[4]) @ TRUTH[0]
    numbers = " ".join(map(str, [*T[:3, 3], *quaternion(T)]))
    (tmp_path / "loops.txt").write_text(f"4 0 {numbers}\n")
    flags = ("--poses", str(drifted), "--loops", str(tmp_path / "loops.txt"))
    loop = next(
        e for e in graph(recording, tmp_path / "g.json", *flags) if (e["i"], e["j"]) == (4, 0)
    )
    assert loop["kind"] == "loop"
    assert np.abs(log(inverse(matrices(loop)[0]) @ T)).max() < 0.02


def test_steps_of_odometry_err_as_the_user_says(
    recording: Path, poses: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = tmp_path / "bag"
    assert main(["convert", str(recording), str(bag), "--poses", str(poses)]) == 0
    capsys.readouterr()
    edges = graph(bag, tmp_path / "g.json", *DRIFT)
    assert "4 steps of odometry" in capsys.readouterr().out
    steps = [e for e in edges if e["kind"] == "odometry"]
    assert [(e["i"], e["j"]) for e in steps] == [(k, k + 1) for k in range(N - 1)]
    for edge in steps:
        T, Y = matrices(edge)
        assert edge["trust"] is None
        np.testing.assert_allclose(np.sqrt(np.diag(Y)), Drift().sigma(T), rtol=1e-6)
        xi = log(inverse(T) @ inverse(TRUTH[edge["i"]]) @ TRUTH[edge["j"]])
        assert xi @ np.linalg.solve(Y, xi) < 30.0
    graph(bag, tmp_path / "g.csv", *DRIFT)
    rows = list(csv.DictReader((tmp_path / "g.csv").read_text().splitlines()))
    assert {row["novelty"] == "" for row in rows if row["kind"] == "odometry"} == {True}


def test_a_scale_widens_registrations_and_nothing_else(
    recording: Path, poses: Path, tmp_path: Path
) -> None:
    flags = ("--poses", str(poses))
    plain = graph(recording, tmp_path / "one.json", *flags)
    wide = graph(recording, tmp_path / "two.json", *flags, "--scale", "1.5")
    for one, two in zip(plain, wide, strict=True):
        assert one["T"] == two["T"]
        np.testing.assert_allclose(matrices(two)[1], 1.5 * matrices(one)[1], rtol=1e-6)


def test_external_poses_keep_their_values_and_get_covariances(
    recording: Path, poses: Path, tmp_path: Path
) -> None:
    flags = ("--poses", str(poses), "--registration", "external")
    for edge in graph(recording, tmp_path / "g.json", *flags):
        T, Y = matrices(edge)
        np.testing.assert_allclose(T, inverse(TRUTH[edge["i"]]) @ TRUTH[edge["j"]], atol=1e-9)
        assert (np.linalg.eigvalsh(Y) > 0.0).all()


def test_poses_go_in_by_kitti_rows_and_by_the_word_joint(
    recording: Path, poses: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kitti = tmp_path / "poses.txt"
    kitti.write_text("".join(kitti_line(T) for T in TRUTH))
    by_order = graph(recording, tmp_path / "k.json", "--poses", str(kitti))
    by_stamp = graph(recording, tmp_path / "t.json", "--poses", str(poses))
    for one, other in zip(by_order, by_stamp, strict=True):
        np.testing.assert_allclose(matrices(one)[0], matrices(other)[0], atol=1e-9)
    graph(recording, tmp_path / "g.g2o", "--poses", "joint")
    assert "5 poses, 4 registrations" in capsys.readouterr().out


def test_scans_without_a_pose_and_pairs_without_an_answer_are_counted(
    poses: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Scan 1 shows another place and scan 4 has no pose: their numbers stay as they are."""
    found = scans()
    found[1] = replace(found[1], points=found[1].points + 1000.0)
    write_folder(tmp_path / "mine", found, ".npy")
    (tmp_path / "short.tum").write_text("".join(poses.read_text().splitlines(True)[:4]))
    flags = ("--poses", str(tmp_path / "short.tum"))
    edges = graph(tmp_path / "mine", tmp_path / "g.json", *flags)
    assert [(e["i"], e["j"]) for e in edges] == [(2, 3)]
    told = capsys.readouterr().out
    assert "4 poses, 1 registration," in told
    assert "1 no pose" in told
    assert "falls into 3 parts that no edge connects" in told
    out = ("--out", tmp_path / "g.txt")
    assert "1 have no pose: write .tum" in refused(capsys, tmp_path / "mine", *flags, *out)


def refused(capsys: pytest.CaptureFixture[str], *flags: object) -> str:
    assert main(["graph", *map(str, flags)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_what_cannot_be_is_one_sentence(
    recording: Path, poses: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ("--out", tmp_path / "g.g2o")
    posed = (recording, "--poses", poses)
    assert "find them (--poses joint)" in refused(capsys, recording, *out)
    wrong = refused(capsys, *posed, "--out", tmp_path / "g.abc")
    assert "a graph is written as .g2o, .json, .csv, .tum, .txt" in wrong
    assert "existing folder" in refused(capsys, *posed, "--out", tmp_path / "no" / "g.g2o")
    for scale in (0, "nan", 1e300):
        assert "--scale must be in" in refused(capsys, *posed, *out, "--scale", scale)
    assert "has no odometry" in refused(capsys, *posed, *out, "--odometry-drift", 1, 1, 1)
    for drift in (-1, "nan", 1e200):
        error = refused(capsys, *posed, *out, "--odometry-drift", drift, 1, 1)
        assert "three numbers from 0 to 100" in error
    for text, sentence in {
        "0 9\n": "has scans 0 to 4: there is no loop from 0 to 9",
        "1 1\n": "there is no loop from 1 to 1",
        "0 1.5\n": "row 1 has no whole numbers",
        "0\n": "expected rows of i j",
        "0 4 0 0 0 0 0 0 0\n": "row 1 has no unit quaternion",
    }.items():
        (tmp_path / "loops").write_text(text)
        assert sentence in refused(capsys, *posed, *out, "--loops", tmp_path / "loops")
    assert not (tmp_path / "g.g2o").exists()


def test_one_scan_and_scans_that_do_not_meet_are_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng, poses = np.random.default_rng(0), tmp_path / "poses.tum"
    poses.write_text("".join(tum_line((k + 1) * 10**8, np.eye(4)) for k in range(2)))
    apart = [Scan(stamp_ns=(k + 1) * 10**8, points=room(rng) + 1000.0 * k) for k in range(2)]
    for n, sentence in ((1, "there is only one scan"), (2, "1 ")):
        write_folder(tmp_path / f"{n}", apart[:n], ".npy")
        told = refused(capsys, tmp_path / f"{n}", "--poses", poses, "--out", tmp_path / "g.g2o")
        assert f"no pair of {n} has an answer: {sentence}" in told
