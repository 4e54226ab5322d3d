from dataclasses import replace

import numpy as np
import pytest

from cello3d_ros.clouds.shape import filtered, prepare
from cello3d_ros.config import GridConfig, IcpConfig, OverlapConfig, Pipeline
from cello3d_ros.covariance import sigma_points
from cello3d_ros.covariance.case import MethodSettings
from cello3d_ros.covariance.description import describe, turns
from cello3d_ros.covariance.estimator import Estimator, needs_shape, registered_elsewhere
from cello3d_ros.covariance.fused import PRIOR_WEIGHT
from cello3d_ros.covariance.methods import METHODS
from cello3d_ros.covariance.model import Model, constant_model, load_model, shipped_model_path
from cello3d_ros.errors import ModelError, NoOverlapError, NotConvergedError, RegistrationError
from cello3d_ros.geometry.gaussian import is_positive_definite
from cello3d_ros.geometry.se3 import exp, inverse, log, transform

PIPELINE = Pipeline()
AS_PREDICTED = MethodSettings(unknown_quantile=1.0, widen_unknown=False)
T_TRUE = exp([0.6, -0.4, 0.1, 0.02, -0.03, 0.4])


@pytest.fixture
def pair(room):
    rng = np.random.default_rng(0)
    reading = transform(inverse(T_TRUE), room[0])
    return prepare(reading, PIPELINE.cloud, rng), prepare(room[1], PIPELINE.cloud, rng)


def moved(cloud, T):
    """Express a cloud in another frame without choosing other points."""
    points = transform(T, cloud.points)
    tree = cloud.tree  # its boxes are axis-aligned: rebuild
    from cello3d_ros.clouds.neighbors import build_tree

    tree = build_tree(points)
    order = tree.order
    return cloud._replace(
        points=tree.points,
        normals=cloud.normals[order] @ T[:3, :3].T,
        planarity=cloud.planarity[order],
        cylindricality=cloud.cylindricality[order],
        tree=tree._replace(order=np.arange(len(order))),
    )


def test_the_description_does_not_depend_on_the_frame_of_the_reference(pair):
    reading, reference = pair
    A = exp([3.0, -2.0, 1.0, 0.3, 0.4, 2.0])
    here = describe(reading, reference, T_TRUE, PIPELINE)
    there = describe(reading, moved(reference, A), A @ T_TRUE, PIPELINE)
    np.testing.assert_allclose(here.descriptors, there.descriptors, atol=2e-3)
    assert np.abs(here.descriptors).max() > 0.5
    for name in ("hessian", "sandwich"):
        scale = np.sqrt(np.diag(here.shapes[name]))
        np.testing.assert_allclose(
            here.shapes[name] / np.outer(scale, scale),
            there.shapes[name] / np.outer(scale, scale),
            atol=1e-2,
        )


def test_the_description_does_not_depend_on_the_number_of_threads(pair):
    one = describe(*pair, T_TRUE, PIPELINE)
    four = describe(*pair, T_TRUE, PIPELINE, n_threads=4)
    for a, b in zip(
        [*one.descriptors, *one.shapes.values()], [*four.descriptors, *four.shapes.values()]
    ):
        np.testing.assert_array_equal(a, b)


def test_a_turned_description_is_that_of_turned_clouds(pair):
    """P -> RP, Q -> RQ, T -> R T R^-1; the paper's augmentation."""
    reading, reference = pair
    n = 3
    R = np.eye(4)
    R[:3, :3] = turns(n)[1]
    one = describe(reading, reference, T_TRUE, PIPELINE, n)
    other = describe(moved(reading, R), moved(reference, R), R @ T_TRUE @ inverse(R), PIPELINE)
    np.testing.assert_allclose(one.descriptors[1], other.descriptors[0], atol=2e-3)
    assert np.abs(one.descriptors[1] - one.descriptors[0]).max() > 0.1


def test_an_estimate_registers_and_predicts(pair):
    reading, reference = pair
    model = constant_model(2.0 * np.eye(6), 704, shape="sandwich")
    found = Estimator(model).register(
        reading, reference, T_TRUE @ exp([0.05] * 6), np.random.default_rng(1)
    )
    assert found.registration.converged
    assert np.linalg.norm(log(inverse(T_TRUE) @ found.registration.T_ref_read)) < 0.03
    assert found.overlap_ratio > 0.7
    assert found.effective_neighbors == 1.0
    S = describe(reading, reference, found.registration.T_ref_read, PIPELINE).shapes["sandwich"]
    np.testing.assert_allclose(found.covariance, 2.0 * S, rtol=1e-6, atol=1e-16)
    assert is_positive_definite(found.covariance)


def test_a_registration_from_elsewhere_is_judged_as_it_is(pair):
    model = constant_model(2.0 * np.eye(6), 704, shape="sandwich")
    T = T_TRUE @ exp([0.01, 0, 0, 0, 0, 0.002])
    rng = np.random.default_rng(1)
    found = Estimator(model).judge(*pair, registered_elsewhere(T), rng)
    np.testing.assert_array_equal(found.registration.T_ref_read, T)
    S = describe(*pair, T, PIPELINE).shapes["sandwich"]
    np.testing.assert_allclose(found.covariance, 2.0 * S, rtol=1e-6, atol=1e-16)


def test_an_estimate_is_by_the_method_that_it_names(pair):
    model = constant_model(2.0 * np.eye(6), 704, shape="sandwich")
    bare = MethodSettings(floor_sigma_m=1e-9, floor_sigma_rad=1e-9)
    found = {
        name: Estimator(model, name, bare).register(*pair, T_TRUE, np.random.default_rng(1))
        for name in ("cello3d", "fused", "sigma_points", "censi", "hessian", "constant")
    }
    assert set(found) <= set(METHODS)
    for name, answer in found.items():
        assert answer.method == name
        assert is_positive_definite(answer.covariance)
    H = describe(*pair, found["hessian"].registration.T_ref_read, PIPELINE).shapes["hessian"]
    np.testing.assert_allclose(found["hessian"].covariance, 1e-4 * H, rtol=1e-6, atol=1e-18)
    np.testing.assert_allclose(
        found["constant"].covariance, found["cello3d"].covariance, rtol=1e-9, atol=1e-16
    )
    assert not np.allclose(found["fused"].covariance, found["cello3d"].covariance, rtol=1e-3)


def test_clouds_that_share_too_little_are_an_error(pair):
    reading, reference = pair
    with pytest.raises(NoOverlapError, match="overlap"):
        describe(reading, reference, exp([40.0, 0, 0, 0, 0, 0]), PIPELINE)
    strict = Pipeline(overlap=OverlapConfig(radius_m=0.02, min_ratio=0.9))
    with pytest.raises(NoOverlapError, match="of the reading overlaps"):
        describe(reading, reference, T_TRUE, strict)


def test_an_unconverged_registration_is_an_error_before_any_other_is_run(pair, monkeypatch):
    hasty = Pipeline(icp=IcpConfig(max_iterations=1))
    monkeypatch.setattr(sigma_points, "register_many", None)
    for method in ("cello3d", "fused", "sigma_points"):
        estimator = Estimator(constant_model(np.eye(6), 704), method, pipeline=hasty)
        with pytest.raises(NotConvergedError, match="did not converge in 1 iterations"):
            estimator.register(*pair, T_TRUE, np.random.default_rng(1))


def test_a_plane_has_no_answer():
    rng = np.random.default_rng(3)
    ground = rng.uniform(-8, 8, (4000, 3)) * [1, 1, 0] - [0, 0, 1.5]
    cloud = prepare(ground, PIPELINE.cloud, rng)
    with pytest.raises(RegistrationError, match=r"singular|direction free"):
        Estimator(constant_model(np.eye(6), 704)).register(cloud, cloud, np.eye(4), rng)


def test_another_grid_than_the_models_is_refused(pair):
    other = Pipeline(grid=GridConfig(n_cells=(2, 2, 2)))
    estimator = Estimator(constant_model(np.eye(6), 704), pipeline=other)
    with pytest.raises(ModelError, match="trained with GridConfig"):
        estimator.register(*pair, T_TRUE, np.random.default_rng(0))


@pytest.mark.parametrize("method", METHODS)
def test_nobody_looks_at_the_shape_of_the_reading_who_has_not_said_so(pair, room, method):
    model, icp = load_model(shipped_model_path()), PIPELINE.icp
    assert not needs_shape(model, PIPELINE)
    bare = filtered(transform(inverse(T_TRUE), room[0]), PIPELINE.cloud, np.random.default_rng(0))
    assert len(bare.normals) == len(bare.tree.points) == 0
    found = Estimator(model, method).register(bare, pair[1], T_TRUE, np.random.default_rng(1))
    assert np.abs(log(inverse(T_TRUE) @ found.T_ref_read)).max() < 0.01
    assert needs_shape(constant_model(np.eye(6), 704), PIPELINE)
    assert needs_shape(model, Pipeline(icp=replace(icp, backend="small_gicp")))


def two_examples(pair, far: float):
    """A model of a small covariance near the pair and a large one; the pair is ``far`` away."""
    d = describe(*pair, T_TRUE, PIPELINE).descriptors[0]
    theta = np.zeros((1, len(d)))
    theta[0, np.argmax(d)] = 1.0
    place = (theta @ d)[0]
    return Model(
        theta=theta,
        mean=np.zeros(len(d)),
        scale=np.ones(len(d)),
        projections=np.array([[place + far], [place + far + 100.0]]),
        covariances=np.array([1e-6 * np.eye(6), 1e-2 * np.diag([1.0, 1, 1, 1e-6, 1, 1])]),
        rho_quantiles=np.array([0.0, 4.0, 8.0]),
    )


@pytest.mark.parametrize("method", ["cello3d", "fused"])
def test_a_prediction_far_from_every_example_is_widened_to_their_mean(pair, method):
    model = two_examples(pair, 3.0)
    settings = MethodSettings(unknown_quantile=0.5, widen_unknown=True)
    rng = [np.random.default_rng(5) for _ in range(3)]
    plain = Estimator(model, method, AS_PREDICTED).register(*pair, T_TRUE, rng[0])
    found = Estimator(model, method, settings).register(*pair, T_TRUE, rng[1])
    mean = model.covariances.mean(axis=0)
    if method == "fused":  # twelve registrations weigh in
        mean = mean * PRIOR_WEIGHT / (PRIOR_WEIGHT + settings.n_registrations)
    assert found.nearest_rho == plain.nearest_rho
    assert (plain.is_unknown, found.is_unknown) == (False, True)
    for smaller in (plain.covariance, mean):
        assert np.linalg.eigvalsh(found.covariance - smaller)[0] > -1e-15
    assert np.linalg.eigvalsh(found.covariance - plain.covariance)[-1] > 1e-3
    near = two_examples(pair, 0.5)
    kept = Estimator(near, method, settings).register(*pair, T_TRUE, rng[2])
    assert np.linalg.eigvalsh(kept.covariance)[-1] < 1e-3
    assert not kept.is_unknown


def test_what_does_not_come_from_the_model_is_not_widened(pair):
    model, rng = two_examples(pair, 3.0), [np.random.default_rng(5) for _ in range(2)]
    settings = MethodSettings(unknown_quantile=0.5, widen_unknown=True)
    plain = Estimator(model, "hessian", AS_PREDICTED).register(*pair, T_TRUE, rng[0])
    found = Estimator(model, "hessian", settings).register(*pair, T_TRUE, rng[1])
    np.testing.assert_array_equal(found.covariance, plain.covariance)
    assert found.is_unknown


def test_an_answer_far_from_every_example_is_only_told_of_unless_it_is_to_be_widened(pair):
    model = two_examples(pair, 3.0)
    rng = [np.random.default_rng(5) for _ in range(2)]
    plain = Estimator(model, settings=AS_PREDICTED).register(*pair, T_TRUE, rng[0])
    settings = MethodSettings(unknown_quantile=0.5, widen_unknown=False)
    found = Estimator(model, settings=settings).register(*pair, T_TRUE, rng[1])
    np.testing.assert_array_equal(found.covariance, plain.covariance)
    assert found.is_unknown


def test_an_answer_is_scaled_last(pair):
    model = two_examples(pair, 3.0)
    plain, scaled = (
        Estimator(model, settings=MethodSettings(unknown_quantile=0.5, scale=scale)).register(
            *pair, T_TRUE, np.random.default_rng(5)
        )
        for scale in (1.0, 2.5)
    )
    np.testing.assert_allclose(scaled.covariance, 2.5 * plain.covariance, rtol=1e-12)
