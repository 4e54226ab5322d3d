"""The registrations of other libraries, where they are installed, through the one protocol."""

import importlib

import numpy as np
import pytest

from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import CloudConfig, IcpConfig, config_from, config_to
from cello3d_ros.errors import ConfigError
from cello3d_ros.geometry.se3 import exp, inverse, log, transform
from cello3d_ros.registration import icp
from cello3d_ros.registration.backends import BACKENDS, register, register_many

LIBRARY = {"open3d_point_to_plane": "open3d", "open3d_gicp": "open3d", "small_gicp": "small_gicp"}
T = exp([0.3, -0.2, 0.1, 0.02, -0.03, 0.2])


@pytest.fixture(params=sorted(BACKENDS))
def config(request):
    if request.param in LIBRARY:
        pytest.importorskip(LIBRARY[request.param])
    return IcpConfig(backend=request.param, n_reading_points=1500, n_reference_points=5000)


@pytest.fixture
def clouds(room):
    rng = np.random.default_rng(11)
    return (
        prepare(transform(inverse(T), room[0]), CloudConfig(), rng),
        prepare(room[1], CloudConfig(), rng),
    )


def test_every_choice_of_the_settings_is_there():
    field = IcpConfig.__dataclass_fields__["backend"]
    assert tuple(BACKENDS) == field.metadata["choices"]


def test_the_truth_is_found_from_a_start_nearby(clouds, config):
    start = T @ exp([0.1, -0.1, 0.05, 0.02, 0.02, -0.05])
    found = register(*clouds, start, config, np.random.default_rng(0))
    assert (found.converged, found.reason) == (True, "")
    assert np.linalg.norm(log(inverse(T) @ found.T_ref_read)) < 0.02
    assert found.n_associations > 500
    assert 0 < found.residual_rms_m < 0.5


def test_each_registration_draws_its_own_subsample(clouds, config):
    """Equal seeds agree to rounding, for Open3D's threads add up in any order; others do not."""
    starts = np.array([T, T, T])
    many = register_many(*clouds, starts, [[1], [2], [1]], config, n_threads=2)
    one = register_many(*clouds, starts, [[1], [2], [1]], config, n_threads=1)
    poses = np.array([r.T_ref_read for r in many])
    np.testing.assert_allclose(poses, [r.T_ref_read for r in one], atol=1e-6)
    np.testing.assert_allclose(poses[0], poses[2], atol=1e-6)
    assert np.abs(poses[0] - poses[1]).max() > 1e-5
    if config.backend in ("icp", "small_gicp"):
        np.testing.assert_array_equal(poses, [r.T_ref_read for r in one])


def test_icp_is_our_own(clouds):
    config = IcpConfig(n_reading_points=500)
    ours = icp.register(*clouds, T, config, np.random.default_rng(3))
    chosen = register(*clouds, T, config, np.random.default_rng(3))
    np.testing.assert_array_equal(ours.T_ref_read, chosen.T_ref_read)


def test_clouds_that_do_not_meet_have_no_answer(clouds, config):
    if config.backend == "icp":
        pytest.skip("it has no largest distance: a share of the nearest always meets")
    far = T @ exp([500.0, 0, 0, 0, 0, 0])
    found = register(*clouds, far, config, np.random.default_rng(0))
    assert (found.converged, found.reason) == (False, "too_few_points")
    np.testing.assert_array_equal(found.T_ref_read, far)


def test_one_iteration_is_not_enough_and_says_so(clouds, config):
    stopped = IcpConfig(backend=config.backend, max_iterations=1)
    start = T @ exp([0.4, 0.3, 0, 0, 0, 0.2])
    found = register(*clouds, start, stopped, np.random.default_rng(0))
    assert (found.converged, found.reason) == (False, "max_iterations")


def test_planes_and_points_in_one_place_give_finite_poses(config):
    rng = np.random.default_rng(14)
    plane = prepare(rng.uniform(-5, 5, (3000, 3)) * [1, 1, 0] + [0, 0, 1], CloudConfig(), rng)
    found = register(plane, plane, exp([0.1, 0, 0, 0, 0, 0]), config, rng)
    assert np.isfinite(found.T_ref_read).all()
    assert found.reason in ("", "singular", "max_iterations")


def test_a_missing_library_is_one_sentence(clouds, config, monkeypatch):
    if config.backend == "icp":
        pytest.skip("needs no library")

    def missing(name):
        raise ModuleNotFoundError(f"No module named {name!r}")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ConfigError, match=rf"icp.backend {config.backend} needs .*pip install"):
        register(*clouds, T, config, np.random.default_rng(0))


def test_settings_from_before_backends_mean_our_own_icp():
    tree = config_to(config_from({}))
    for name in ("backend", "max_distance_m"):
        del tree["icp"][name]
    for name in ("precision", "min_samples", "noise_m"):
        del tree["sampling"][name]
    assert config_from(tree) == config_from({})
    assert config_from(tree).icp.backend == "icp"
