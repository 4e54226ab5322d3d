"""The examples of docs/integration.md and README for other libraries run as they stand."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import cello3d_ros as cello
from cello3d_ros.cli.main import main
from cello3d_ros.evaluation.graph_files import read_loops
from cello3d_ros.geometry.gaussian import rotation_first
from cello3d_ros.geometry.se3 import Array, exp, inverse, log, pose, quaternion, transform
from cello3d_ros.recordings import Scan
from cello3d_ros.recordings.poses import tum_line
from cello3d_ros.recordings.writers import write_folder
from cello3d_ros.tracking.warmup import room as scan_of_a_room

ROOT = Path(__file__).parents[1]
N = 6
TRUTH = np.array([exp(k * np.array([0.2, 0.02, 0.0, 0.0, 0.0, 0.05])) for k in range(N)])


def example(page: str, word: str) -> str:
    """The first example in Python of a page that has a word."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    return next(block for block in blocks if word in block)


def run(page: str, word: str, names: dict | None = None) -> dict:
    names = {} if names is None else names
    exec(compile(example(page, word), page, "exec"), names)
    return names


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the page's command writes, of six scans of a room with a little drift."""
    folder = tmp_path_factory.mktemp("integration")
    rngs = [np.random.default_rng(k) for k in range(N)]
    clouds = [transform(inverse(T), scan_of_a_room(r)) for T, r in zip(TRUTH, rngs, strict=True)]
    write_folder(folder / "mine", [Scan(stamp_ns=k, points=P) for k, P in stamped(clouds)], ".npy")
    drifted = [T @ exp(k * np.array([0.01, 0, 0, 0, 0, 0.01])) for k, T in enumerate(TRUTH)]
    for name, poses in {"reference": TRUTH, "slam": drifted}.items():
        rows = "".join(tum_line(k, T) for k, T in stamped(poses))
        (folder / f"{name}.tum").write_text(rows)
    (folder / "loops.txt").write_text("0 5\n")
    command = re.search(r"^cello3d (graph my.bag .*)$", text("docs/integration.md"), re.MULTILINE)
    assert command
    words = [w if "." not in w else str(folder / w) for w in shlex.split(command[1])]
    words[words.index(str(folder / "my.bag"))] = str(folder / "mine")
    assert main([*words, "--poses", str(folder / "slam.tum")]) == 0
    return folder


def stamped(items: list) -> list:
    return [((k + 1) * 10**8, item) for k, item in enumerate(items)]


def text(page: str) -> str:
    return (ROOT / page).read_text()


def test_g2o_and_gtsam_find_the_same_poses_with_the_examples(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for library in ("gtsam", "g2opy"):
        pytest.importorskip(library)
    monkeypatch.chdir(folder)
    by_gtsam = run("docs/integration.md", "BetweenFactorPose3")["result"]
    by_g2o = run("docs/integration.md", "g2opy")["T"]
    for k in range(N):
        T = by_gtsam.atPose3(k).matrix()
        np.testing.assert_allclose(by_g2o[k], T, atol=1e-5)
        assert np.abs(log(inverse(TRUTH[0] @ inverse(by_g2o[0]) @ T) @ TRUTH[k])).max() < 0.01


def test_ceres_weighs_an_error_as_the_covariance_does(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The residual of Ceres' pose_graph_3d, written out; to first order in the error."""
    monkeypatch.chdir(folder)
    names = run("docs/integration.md", "ceres.g2o")
    lines = [x.split() for x in (folder / "ceres.g2o").read_text().splitlines()]
    assert [x[0] for x in lines].count("VERTEX_SE3:QUAT") == N
    edges = names["json"].loads((folder / "graph.json").read_text())["edges"]
    rng = np.random.default_rng(0)
    lines = [x for x in lines if x[0] == "EDGE_SE3:QUAT"]
    for line, edge in zip(lines, edges, strict=True):
        numbers = np.array(line[3:], float)
        measured = pose(numbers[:3], numbers[3:7])
        np.testing.assert_allclose(measured, np.reshape(edge["T"], (4, 4)), atol=1e-12)
        upper = np.zeros((6, 6))
        upper[np.triu_indices(6)] = numbers[7:]
        information = upper + np.triu(upper, 1).T
        Y = rotation_first(np.reshape(edge["covariance_gtsam"], (6, 6)))  # its own inverse
        xi = 1e-4 * np.linalg.cholesky(Y) @ rng.normal(size=6)
        estimated = measured @ exp(xi)
        turn = np.eye(4)
        turn[:3, :3] = measured[:3, :3] @ estimated[:3, :3].T
        r = np.concatenate([(estimated - measured)[:3, 3], 2 * quaternion(turn)[:3]])
        assert r @ information @ r == pytest.approx(xi @ np.linalg.solve(Y, xi), rel=1e-3)


def test_evo_and_pandas_read_the_files_with_the_examples(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for library in ("evo", "pandas"):
        pytest.importorskip(library)
    monkeypatch.chdir(folder)
    found = run("docs/integration.md", "evo.core")
    assert found["error"].get_statistic(found["metrics"].StatisticsType.rmse) < 0.05
    assert capsys.readouterr().out.endswith(" m\n")
    edges = run("docs/integration.md", "pandas")["edges"]
    assert len(edges) == 15
    assert edges.sigma_mm.between(0.01, 1000.0).all()
    assert list(edges.novelty.between(0.0, 1.0)) == [True] * 15


def test_the_factor_of_readme_ends_at_the_registration(room: tuple[Array, Array]) -> None:
    gtsam = pytest.importorskip("gtsam")
    r = cello.Estimator("general")(*room)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    run(
        "README.md",
        "covariance_gtsam())\n",
        {"gtsam": gtsam, "graph": graph, "r": r, "i": 0, "j": 1},
    )
    values.insert(0, gtsam.Pose3())
    values.insert(1, gtsam.Pose3())
    graph.add(gtsam.NonlinearEqualityPose3(0, gtsam.Pose3()))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    np.testing.assert_allclose(found.atPose3(1).matrix(), r.T_ref_read, atol=1e-8)
    C = gtsam.Marginals(graph, found).marginalCovariance(1)
    np.testing.assert_allclose(C, r.covariance_gtsam(), atol=1e-6 * np.abs(C).max())


def test_the_file_of_loops_of_the_page_is_one(tmp_path: Path) -> None:
    rows = re.search(r"rows of `(i j x y z qx qy qz qw)`", text("docs/integration.md"))
    assert rows
    (tmp_path / "loops").write_text(f"# {rows[1]}\n7 2 1 0 0 0 0 0 1\n")
    loops = read_loops(tmp_path / "loops")
    assert list(loops) == [(7, 2)]
    np.testing.assert_array_equal(loops[7, 2][:3, 3], [1.0, 0.0, 0.0])
