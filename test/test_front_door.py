"""The interface for Python: quick to import, and one answer wherever it is asked for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import cello3d_ros as cello
from cello3d_ros.cli.main import main
from cello3d_ros.config import COVARIANCE_MODES, Config, NodeConfig
from cello3d_ros.covariance.case import DEFAULTS
from cello3d_ros.errors import CloudError, ConfigError, ModelError, RegistrationError
from cello3d_ros.geometry.gaussian import to_fixed_axes
from cello3d_ros.geometry.se3 import Array, exp, inverse, log, transform
from cello3d_ros.recordings.bag_writer import write_bag
from cello3d_ros.recordings.recording import Scan
from cello3d_ros.tracking.tracker import estimator_of

T_TRUE = exp([0.3, -0.2, 0.05, 0.01, 0.02, 0.15])
T_INIT = T_TRUE @ exp([0.05, 0.02, 0.0, 0.0, 0.0, 0.02])


@pytest.fixture
def scans(room: tuple[Array, Array]) -> tuple[Array, Array]:
    """Reading and reference as a lidar gives them: single precision."""
    reading = transform(inverse(T_TRUE), room[0])
    return reading.astype(np.float32).astype(float), room[1].astype(np.float32).astype(float)


def test_the_import_is_quick_and_loads_neither_open3d_nor_ros_nor_numba() -> None:
    code = "import cello3d_ros, sys; print([m for m in sys.modules if m.split('.')[0] in wrong])"
    code = "wrong = ('numba', 'open3d', 'rclpy', 'numpy'); " + code
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_every_name_is_there_and_no_other() -> None:
    for name in cello.__all__:
        assert getattr(cello, name) is not None
        assert name in dir(cello)
    with pytest.raises(AttributeError, match="no attribute 'estimate'"):
        cello.estimate  # noqa: B018


def test_two_arrays_and_a_guess_give_a_pose_its_covariance_and_what_to_think_of_it(
    scans: tuple[Array, Array],
) -> None:
    r = cello.Estimator("general")(*scans, T_INIT)
    assert np.linalg.norm(log(inverse(T_TRUE) @ r.T_ref_read)) < 0.03
    assert np.linalg.eigvalsh(r.covariance)[0] > 0.0
    assert r.trust.converged
    assert 0.5 < r.trust.overlap <= 1.0
    assert 0.0 <= r.trust.novelty <= 1.0
    assert r.trust.is_unknown == (r.trust.novelty > DEFAULTS.unknown_quantile)
    assert not r.trust.is_lost
    assert r.trust.sentence.endswith(".")
    again = cello.Estimator("general")(*scans, T_INIT)
    np.testing.assert_array_equal(again.covariance, r.covariance)
    other = cello.Estimator("general")(*scans, T_INIT, seed=1)
    assert (other.covariance != r.covariance).any()


def test_the_two_other_orders_are_the_same_covariance(scans: tuple[Array, Array]) -> None:
    r = cello.Estimator()(*scans, T_INIT)
    np.testing.assert_array_equal(
        r.covariance_ros(), to_fixed_axes(r.T_ref_read[:3, :3], r.covariance)
    )
    order = [3, 4, 5, 0, 1, 2]
    np.testing.assert_array_equal(r.covariance_gtsam(), r.covariance[order][:, order])


def test_the_error_of_a_between_factor_is_the_twist_that_the_covariance_is_of(
    scans: tuple[Array, Array],
) -> None:
    """Errors drawn from the covariance have, as GTSAM whitens them, unit covariance."""
    gtsam = pytest.importorskip("gtsam")
    r = cello.Estimator()(*scans, T_INIT)
    noise = gtsam.noiseModel.Gaussian.Covariance(r.covariance_gtsam())
    factor = gtsam.BetweenFactorPose3(0, 1, gtsam.Pose3(r.T_ref_read), noise)
    rng = np.random.default_rng(0)
    whitened = []
    for xi in rng.multivariate_normal(np.zeros(6), r.covariance, 2000):
        values = gtsam.Values()
        T_world_ref = exp([5.0, -3.0, 1.0, 0.4, -0.2, 2.0])
        values.insert(0, gtsam.Pose3(T_world_ref))
        values.insert(1, gtsam.Pose3(T_world_ref @ r.T_ref_read @ exp(xi)))
        raw = factor.unwhitenedError(values)
        np.testing.assert_allclose(raw, xi[[3, 4, 5, 0, 1, 2]], atol=1e-8)
        whitened.append(noise.whiten(raw))
    np.testing.assert_allclose(np.cov(np.array(whitened).T), np.eye(6), atol=0.15)


@pytest.mark.parametrize("method", COVARIANCE_MODES)
def test_methods_are_those_of_the_node(scans: tuple[Array, Array], method: str) -> None:
    assert cello.Estimator("general", method)(*scans, T_INIT).method == method


def test_what_cannot_be_is_one_sentence(scans: tuple[Array, Array]) -> None:
    reading, reference = scans
    est = cello.Estimator()
    with pytest.raises(ConfigError, match="method must be one of cello3d, "):
        cello.Estimator("general", "magic")
    with pytest.raises(ModelError, match="nowhere"):
        cello.Estimator("nowhere.npz")
    with pytest.raises(CloudError, match=r"the reading has shape \(3, 4\), expected \(N, 3\)"):
        est(np.zeros((3, 4)), reference)
    with pytest.raises(CloudError, match="the reference: 5 of 5 points are left"):
        est(reading, reference[:5])
    with pytest.raises(CloudError, match="not an array of numbers"):
        est("points", reference)
    with pytest.raises(RegistrationError, match="T_init is not a rigid transform"):
        est(reading, reference, 2.0 * np.eye(4))


def test_points_that_are_not_finite_are_left_out(scans: tuple[Array, Array]) -> None:
    reading, reference = scans
    holes = np.insert(reading, [0, 100, 5000], np.nan, axis=0)
    one, other = (cello.Estimator()(P, reference, T_INIT) for P in (reading, holes))
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_the_defaults_are_those_of_the_node() -> None:
    node = NodeConfig()
    estimator = estimator_of(cello.load_model(), Config(), node)
    assert estimator.settings == DEFAULTS
    assert (estimator.method, node.seed) == ("cello3d", 0)


class InMemory(list[Scan]):
    """Scans as a recording."""

    name = "in memory"
    has_odometry = True


@pytest.fixture
def strange(scans: tuple[Array, Array]) -> tuple[Array, Array]:
    """Scans of a sensor so noisy that the shipped model does not know the like."""
    rng = np.random.default_rng(0)
    one, other = (
        (points + rng.normal(scale=0.08, size=points.shape)).astype(np.float32).astype(float)
        for points in scans
    )
    return one, other


@pytest.fixture
def recording(strange: tuple[Array, Array]) -> InMemory:
    """The reference at the origin of the odometry, the reading where the guess has it."""
    reading, reference = strange
    return InMemory(
        [
            Scan(stamp_ns=10**18, points=reference, T_odom_sensor=np.eye(4)),
            Scan(stamp_ns=10**18 + 10**8, points=reading, T_odom_sensor=T_INIT),
        ]
    )


def agree(r: cello.Estimate, T: Array, C: Array) -> None:
    np.testing.assert_allclose(T, r.T_ref_read, atol=1e-9)
    np.testing.assert_allclose(C, r.covariance_ros(), rtol=1e-6, atol=1e-12)


def test_python_the_command_line_and_replay_answer_alike(
    strange: tuple[Array, Array], recording: InMemory, tmp_path: Path, capsys
) -> None:
    r = cello.Estimator()(*strange, T_INIT)
    for name, points in zip(("reading", "reference"), strange):
        np.save(tmp_path / f"{name}.npy", points)
    np.savetxt(tmp_path / "init.txt", T_INIT)
    files = [str(tmp_path / name) for name in ("reading.npy", "reference.npy", "init.txt")]
    assert main(["estimate", *files[:2], "--init", files[2], "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer == json.loads(json.dumps(r.to_dict()))
    write_bag(tmp_path / "bag", recording)
    assert main(["replay", str(tmp_path / "bag"), "--out", str(tmp_path / "out")]) == 0
    _, line = (tmp_path / "out" / "covariances.jsonl").read_text().splitlines()
    found = json.loads(line)
    assert set(answer) <= set(found)
    matrices = (
        np.reshape(found[name], (n, n)) for name, n in (("T_ref_read", 4), ("covariance_ros", 6))
    )
    agree(r, *matrices)


def test_the_node_answers_alike(
    strange: tuple[Array, Array], recording: InMemory, tmp_path: Path
) -> None:
    pytest.importorskip("rclpy")
    from cello3d_ros.ros.process import NodeProcess
    from cello3d_ros.ros.replay import Player, play

    domain_id = 1 + os.getpid() % 100
    with NodeProcess(tmp_path / "log", domain_id, {}) as process:
        player = Player(domain_id, check=process.check)
        try:
            found = play(player, recording)
        finally:
            player.close()
    (pose,) = found.relative.values()
    agree(cello.Estimator()(*strange, T_INIT), pose.T, pose.C)
