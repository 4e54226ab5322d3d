"""Pairs, chain and restarts, with and without real registrations."""

import contextlib

import numpy as np
import pytest

from cello3d_ros.clouds.shape import filtered, prepare
from cello3d_ros.config import Config, NodeConfig
from cello3d_ros.covariance import estimator
from cello3d_ros.covariance.estimator import Estimate
from cello3d_ros.covariance.model import constant_model, load_model, shipped_model_path
from cello3d_ros.errors import (
    CloudError,
    CovarianceError,
    NoOverlapError,
    NotConvergedError,
    RegistrationError,
)
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import (
    REFERENCE_SHARE,
    Bias,
    Chained,
    GaussianPose,
    between,
    extended,
    is_positive_definite,
)
from cello3d_ros.registration.icp import Registration
from cello3d_ros.tracking import external as external_module
from cello3d_ros.tracking import map as map_module
from cello3d_ros.tracking import tracker as module
from cello3d_ros.tracking.agreement import OdometryDisagreesError
from cello3d_ros.tracking.external import DisagreementError
from cello3d_ros.tracking.guess import Place
from cello3d_ros.tracking.pairing import NoReferenceError
from cello3d_ros.tracking.tracker import (
    BrokenChainError,
    TooFarApartError,
    Tracker,
)
from cello3d_ros.tracking.warmup import room

S = 10**9
WIDE = np.diag([0.3, 0.2, 0.1, 0.05, 0.1, 0.2])
BIAS = Bias(0.3, 7.0)
MODEL = constant_model(WIDE, 704, bias=BIAS)


@pytest.fixture
def asked(monkeypatch):
    """Registrations that return their first guess; a list of the guesses; what to do instead."""
    guesses: list[np.ndarray] = []
    instead: list[Exception | bool] = []

    def register(self, reading, reference, T_init, rng):
        return judge(self, reading, reference, Registration(T_init, 5, True, "", 0.01, 99), rng)

    def judge(self, reading, reference, registration, rng):
        guesses.append(registration.T_ref_read)
        fate = instead.pop(0) if instead else True
        if isinstance(fate, Exception):
            raise fate
        if not fate:
            raise NotConvergedError("ICP did not converge in 5 iterations")
        return Estimate(registration, 0.9, WIDE, 0.0, 1.0)

    monkeypatch.setattr(module.Estimator, "register", register)
    monkeypatch.setattr(module.Estimator, "judge", judge)
    return guesses, instead


@pytest.fixture
def tracker() -> Tracker:
    """A tracker that gives a reference up after two failures."""
    node = NodeConfig(pairing="consecutive", max_failures=2, max_pair_gap_s=5.0)
    config = Config(node=node)
    return Tracker(MODEL, config, config.node)


POINTS = room(np.random.default_rng(0), 500)
RANGE_M = float(np.median(np.linalg.norm(POINTS, axis=1)))  # the filters keep all
SMALL_STEPS = [se3.exp(np.array([0.3, 0.1, 0.0, 0.0, 0.01, 0.05]) * i) for i in range(5)]
POSES = [se3.exp(np.array([0.5, 0.1, 0.0, 0.1, 0.2, 0.6]) * i) for i in range(8)]


def test_first_guess_is_the_motion_of_the_odometry_in_the_frame_of_the_reference(
    tracker, asked
) -> None:
    assert tracker.step(0, POINTS, Place(POSES[1])) is None
    answer = tracker.step(S, POINTS, Place(POSES[3]))
    np.testing.assert_allclose(asked[0][0], se3.inverse(POSES[1]) @ POSES[3], atol=1e-12)
    assert (answer.reference_ns, answer.stamp_ns) == (0, S)


def test_chain_starts_at_the_odometry_and_compounds_what_neighbors_share(tracker, asked) -> None:
    chain = Chained.start(POSES[2])
    tracker.step(0, POINTS, Place(POSES[2]))
    for i in range(3, 7):
        answer = tracker.step(i * S, POINTS, Place(POSES[i]))
        T_step = se3.inverse(POSES[i - 1]) @ POSES[i]
        chain = extended(chain, GaussianPose(T_step, WIDE), BIAS)
        np.testing.assert_allclose(answer.pose.T, chain.T, atol=1e-12)
        np.testing.assert_allclose(answer.pose.Y, chain.Y, atol=1e-12)


def test_a_long_chain_stays_positive_definite(tracker, asked) -> None:
    for i in range(300):
        answer = tracker.step(i * S, POINTS, Place(POSES[i % 2]))
    assert is_positive_definite(answer.pose.Y)


@pytest.mark.parametrize("pairing_name", ["consecutive", "keyframe", "topics"])
@pytest.mark.parametrize("model", [load_model(shipped_model_path()), constant_model(WIDE, 704)])
def test_answers_are_the_same_whether_it_is_worked_ahead_or_not(pairing_name, model) -> None:
    """And the same as those of clouds that were prepared at once."""
    node = NodeConfig(pairing=pairing_name, keyframe_distance_ratio=1.0 / RANGE_M)
    config = Config(node=node)
    ahead, late = (Tracker(model, config, node) for _ in range(2))
    scans = [se3.transform(se3.inverse(T), 2.0 * POINTS) for T in SMALL_STEPS]
    places = [Place(T, T_map_odom=np.eye(4)) for T in SMALL_STEPS]
    if pairing_name == "topics":
        ahead.take_map(0, 2.0 * POINTS, "map")
        late.take_map(0, 2.0 * POINTS, "map")
    n_answers = 0
    for i, (scan, place) in enumerate(zip(scans, places)):
        one, other = ahead.step(i * S, scan, place), late.step(i * S, scan, place)
        ahead.finish()
        assert (one is None) == (other is None)
        if one is None or other is None:
            continue
        n_answers += 1
        assert one.reference_ns == other.reference_ns
        for mine, theirs in zip((*one.pose, *one.step), (*other.pose, *other.step), strict=True):
            np.testing.assert_array_equal(mine, theirs)
        np.testing.assert_array_equal(one.estimate.covariance, other.estimate.covariance)
        if pairing_name == "consecutive":
            rngs = [estimator.draws(scans[k], node.seed) for k in (i, i - 1)]
            first = prepare if estimator.needs_shape(model, config) else filtered
            reading = first(scans[i], config.cloud, rngs[0])
            reference = prepare(scans[i - 1], config.cloud, rngs[1])
            T_init = se3.inverse(SMALL_STEPS[i - 1]) @ SMALL_STEPS[i]
            whole = module.estimator_of(model, config, node)
            expected = whole.register(reading, reference, T_init, rngs[0])
            np.testing.assert_array_equal(one.estimate.covariance, expected.covariance)
    assert n_answers >= len(SMALL_STEPS) - 1


@pytest.mark.parametrize("pairing_name", ["consecutive", "keyframe"])
def test_two_scans_that_fit_each_other_are_registered_though_neither_was_a_reference(
    pairing_name,
) -> None:
    node = NodeConfig(pairing=pairing_name)
    tracker = Tracker(load_model(shipped_model_path()), Config(node=node), node)
    far = POINTS + np.array([60.0, 0.0, 0.0])
    scans = [se3.transform(se3.inverse(T), 2.0 * POINTS) for T in SMALL_STEPS]
    assert tracker.step(0, far, Place(SMALL_STEPS[0])) is None
    tracker.finish()
    with pytest.raises(NoOverlapError):
        tracker.step(S, scans[1], Place(SMALL_STEPS[1]))
    tracker.finish()
    answer = tracker.step(2 * S, scans[2], Place(SMALL_STEPS[2]))
    assert (answer.reference_ns, tracker.n_restarts) == (S, 1)


def test_a_failed_scan_leaves_the_reference_and_the_chain(tracker, asked) -> None:
    guesses, fates = asked
    tracker.step(0, POINTS, Place(POSES[0]))
    fates.append(NoOverlapError("nothing in common"))
    with pytest.raises(NoOverlapError):
        tracker.step(S, POINTS, Place(POSES[1]))
    answer = tracker.step(2 * S, POINTS, Place(POSES[2]))
    np.testing.assert_allclose(guesses[1], POSES[2], atol=1e-12)
    assert (answer.reference_ns, tracker.n_restarts) == (0, 0)


def test_an_unconverged_registration_is_a_failure(tracker, asked) -> None:
    tracker.step(0, POINTS, Place(POSES[0]))
    asked[1].append(False)
    with pytest.raises(NotConvergedError, match="5 iterations"):
        tracker.step(S, POINTS, Place(POSES[1]))
    assert tracker.n_failures == 1


def test_after_max_failures_the_last_scan_is_the_reference_of_a_new_chain(tracker, asked) -> None:
    tracker.step(0, POINTS, Place(POSES[0]))
    tracker.step(S, POINTS, Place(POSES[1]))
    asked[1].extend([False, NoOverlapError("nothing in common")])
    for i in (2, 3):
        with pytest.raises((NotConvergedError, NoOverlapError)):
            tracker.step(i * S, POINTS, Place(POSES[i]))
    answer = tracker.step(4 * S, POINTS, Place(POSES[4]))
    assert (answer.reference_ns, tracker.n_restarts) == (3 * S, 1)
    np.testing.assert_allclose(answer.pose.T, POSES[4], atol=1e-12)
    np.testing.assert_allclose(answer.pose.Y, WIDE, atol=1e-12)


def test_a_bad_first_scan_is_given_up_for_two_that_fit_each_other(asked) -> None:
    tracker = tracker_with(max_failures=5)
    tracker.step(0, POINTS, Place(POSES[0]))
    asked[1].extend([NoOverlapError("nothing in common"), NoOverlapError("nothing in common")])
    with pytest.raises(NoOverlapError):
        tracker.step(S, POINTS, Place(POSES[1]))
    answer = tracker.step(2 * S, POINTS, Place(POSES[3]))
    assert (answer.reference_ns, tracker.n_restarts) == (S, 1)
    np.testing.assert_allclose(asked[0][-1], se3.inverse(POSES[1]) @ POSES[3], atol=1e-12)
    np.testing.assert_allclose(answer.pose.T, POSES[3], atol=1e-12)
    np.testing.assert_allclose(answer.pose.Y, WIDE, atol=1e-12)
    answer = tracker.step(3 * S, POINTS, Place(POSES[4]))
    assert (answer.reference_ns, tracker.n_restarts) == (2 * S, 1)


def test_a_good_first_scan_outlives_a_bad_second(asked) -> None:
    tracker = tracker_with(max_failures=5)
    tracker.step(0, POINTS, Place(POSES[0]))
    asked[1].append(NoOverlapError("nothing in common"))
    with pytest.raises(NoOverlapError):
        tracker.step(S, POINTS, Place(POSES[1]))
    assert tracker.step(2 * S, POINTS, Place(POSES[2])).reference_ns == 0
    assert tracker.n_restarts == 0


def test_a_reference_that_has_fitted_stays_until_max_failures(asked) -> None:
    tracker = tracker_with(max_failures=5)
    for i in range(2):
        tracker.step(i * S, POINTS, Place(POSES[i]))
    asked[1].extend([NoOverlapError("nothing in common")] * 3)
    for i in range(2, 5):
        with pytest.raises(NoOverlapError):
            tracker.step(i * S, POINTS, Place(POSES[i]))
    assert len(asked[0]) == 4  # none of the three was tried against another
    assert tracker.step(5 * S, POINTS, Place(POSES[5])).reference_ns == S


def test_failures_that_are_not_in_a_row_do_not_add_up(tracker, asked) -> None:
    tracker.step(0, POINTS, Place(POSES[0]))
    for i in range(1, 8, 2):
        asked[1].append(False)
        with pytest.raises(NotConvergedError):
            tracker.step(i * S, POINTS, Place(POSES[i]))
        tracker.step((i + 1) * S, POINTS, Place(POSES[i]))
    assert tracker.n_restarts == 0


def test_a_bad_cloud_is_no_failure_of_the_reference(tracker, asked) -> None:
    tracker.step(0, POINTS, Place(POSES[0]))
    for i in range(1, 5):
        with pytest.raises(CloudError):
            tracker.step(i * S, POINTS[:3], Place(POSES[i]))
    assert tracker.step(5 * S, POINTS, Place(POSES[5])).reference_ns == 0


def test_a_long_pause_starts_a_new_chain(tracker, asked) -> None:
    tracker.step(0, POINTS, Place(POSES[0]))
    with pytest.raises(TooFarApartError, match=r"6\.0 s after"):
        tracker.step(6 * S, POINTS, Place(POSES[1]))
    assert tracker.step(7 * S, POINTS, Place(POSES[2])).reference_ns == 6 * S
    assert tracker.n_restarts == 1


def test_the_same_scans_give_the_same_answers_whatever_came_before(tracker) -> None:
    rng = np.random.default_rng(4)
    scans = [se3.transform(se3.inverse(T), room(rng)) for T in POSES[:3]]
    places = [Place(T) for T in POSES[:3]]
    for i in range(3):
        first = tracker.step(i * S, scans[i], places[i])
    tracker.reset()
    for i in range(1, 3):
        again = tracker.step(i * S, scans[i], places[i])
    np.testing.assert_array_equal(
        first.estimate.registration.T_ref_read, again.estimate.registration.T_ref_read
    )


def test_reasons_are_the_narrowest_name() -> None:
    assert NoOverlapError().reason == "no_overlap"
    assert NotConvergedError().reason == "not_converged"
    assert TooFarApartError().reason == "too_far_apart"
    assert CloudError().reason == "too_few_points"


def tracker_with(**settings) -> Tracker:
    """A tracker that gives a reference up after three failures."""
    config = Config(node=NodeConfig(**{"pairing": "consecutive", **settings}))
    return Tracker(MODEL, config, config.node)


def shift(x: float) -> np.ndarray:
    return se3.exp([x, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_a_keyframe_stays_until_the_scan_is_far_enough(asked) -> None:
    tracker = tracker_with(pairing="keyframe", keyframe_distance_ratio=1.0 / RANGE_M)
    references = []
    for i in range(9):
        answer = tracker.step(i * S, POINTS, Place(shift(0.4 * i)))
        references.append(None if answer is None else answer.reference_ns // S)
    assert references == [None, 0, 0, 0, 3, 3, 3, 6, 6]


@pytest.mark.parametrize(
    ("settings", "step"),
    [
        ({"keyframe_angle_rad": 0.3}, se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.35])),
        ({"keyframe_min_overlap": 0.95}, shift(0.1)),  # the registrations here overlap by 0.9
    ],
)
def test_a_turn_and_a_small_overlap_make_a_keyframe(asked, settings, step) -> None:
    tracker = tracker_with(pairing="keyframe", keyframe_distance_ratio=10.0 / RANGE_M, **settings)
    tracker.step(0, POINTS, Place(np.eye(4)))
    tracker.step(S, POINTS, Place(step))
    assert tracker.step(2 * S, POINTS, Place(step)).reference_ns == S


def test_covariance_accumulates_only_from_keyframe_to_keyframe(asked) -> None:
    tracker = tracker_with(pairing="keyframe", keyframe_distance_ratio=1.0 / RANGE_M)
    answers = [tracker.step(i * S, POINTS, Place(shift(0.4 * i))) for i in range(6)]
    for answer in answers[1:4]:
        np.testing.assert_allclose(answer.pose.Y, WIDE, atol=1e-12)
    expected = Chained.start(np.eye(4))
    for way_m in (1.2, 0.8):
        expected = extended(expected, GaussianPose(shift(way_m), WIDE), BIAS)
    np.testing.assert_allclose(answers[5].pose.Y, expected.Y, atol=1e-12)
    np.testing.assert_allclose(answers[5].pose.T, expected.T, atol=1e-12)


def test_a_scan_that_fails_against_the_keyframe_leaves_the_chain_to_the_latest_scan(asked) -> None:
    tracker = tracker_with(pairing="keyframe", keyframe_distance_ratio=10.0 / RANGE_M)
    for i in range(3):
        tracker.step(i * S, POINTS, Place(shift(0.1 * i)))
    asked[1].append(NoOverlapError("nothing in common"))
    with pytest.raises(NoOverlapError):
        tracker.step(3 * S, POINTS, Place(shift(0.3)))
    answer = tracker.step(4 * S, POINTS, Place(shift(0.4)))
    assert (answer.reference_ns, tracker.n_restarts) == (2 * S, 0)
    np.testing.assert_allclose(answer.pose.T, shift(0.4), atol=1e-12)


def test_a_keyframe_is_not_too_old_while_the_robot_stands(asked) -> None:
    tracker = tracker_with(pairing="keyframe", max_pair_gap_s=5.0)
    for i in range(10):
        answer = tracker.step(i * S, POINTS, Place(np.eye(4)))
    assert answer.reference_ns == 0


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"sensor_frame": "other"}, "frame_id of the clouds changed from 'lidar' to 'other'"),
        ({"odom_frame": "other"}, "frame of the odometry changed from 'odom' to 'other'"),
        ({"base_frame": "other"}, "child frame of the odometry changed"),
        ({"epoch": 2}, "the odometry jumped or began anew"),
    ],
)
def test_the_chain_starts_again_where_frames_or_odometry_change(asked, change, sentence) -> None:
    tracker = tracker_with()
    tracker.step(0, POINTS, Place(POSES[0]))
    tracker.step(S, POINTS, Place(POSES[1]))
    with pytest.raises(BrokenChainError, match=sentence):
        tracker.step(2 * S, POINTS, Place(POSES[5], **change))
    assert tracker.n_restarts == 1
    assert sentence in tracker.last_restart
    answer = tracker.step(3 * S, POINTS, Place(POSES[6], **change))
    assert answer.reference_ns == 2 * S
    np.testing.assert_allclose(answer.pose.T, POSES[6], atol=1e-12)
    np.testing.assert_allclose(answer.pose.Y, WIDE, atol=1e-12)


NOWHERE = Place(None, guess="constant_velocity")


def test_without_odometry_the_guess_goes_on_at_the_velocity_of_the_chain(asked) -> None:
    tracker = tracker_with()
    tracker.step(0, POINTS, Place(POSES[1]))
    tracker.step(S, POINTS, Place(POSES[2]))
    answer = tracker.step(2 * S, POINTS, NOWHERE)
    np.testing.assert_allclose(asked[0][1], se3.inverse(POSES[1]) @ POSES[2], atol=1e-12)
    assert answer.guess == "constant_velocity"
    # odometry is back: the scan without it is where its registration has put it
    answer = tracker.step(3 * S, POINTS, Place(POSES[5]))
    np.testing.assert_allclose(asked[0][2], se3.inverse(POSES[3]) @ POSES[5], atol=1e-12)
    assert answer.guess == "odometry"


def test_a_chain_without_any_odometry_starts_at_rest_at_the_origin(asked) -> None:
    tracker = tracker_with()
    tracker.step(0, POINTS, NOWHERE)
    answer = tracker.step(S, POINTS, NOWHERE)
    np.testing.assert_array_equal(asked[0][0], np.eye(4))
    np.testing.assert_array_equal(answer.pose.T, np.eye(4))


def test_an_extrapolated_scan_is_put_where_its_registration_says(asked, monkeypatch) -> None:
    tracker = tracker_with()
    tracker.step(0, POINTS, Place(shift(0.0)))
    fixed, moved = module.Estimator.register, shift(0.1)
    monkeypatch.setattr(  # a registration that corrects the guess by 0.1 m
        module.Estimator, "register", lambda self, P, Q, T, rng: fixed(self, P, Q, T @ moved, rng)
    )
    tracker.step(S, POINTS, Place(shift(1.0), guess="extrapolated"))
    tracker.step(2 * S, POINTS, Place(shift(2.0)))
    np.testing.assert_allclose(asked[0][1] @ se3.inverse(moved), shift(0.9), atol=1e-12)


STEP = se3.exp([0.1, 0.05, 0.0, 0.0, 0.0, 1.0])


def external(tracker: Tracker, error: np.ndarray):
    """Two scans of a room, a step apart, and external poses with an error in the second."""
    rng = np.random.default_rng(4)
    scans = [se3.transform(se3.inverse(T), room(rng)) for T in (np.eye(4), STEP)]
    tracker.step(0, scans[0], Place(POSES[2], guess="external"))
    return tracker.step(S, scans[1], Place(POSES[2] @ STEP @ error, guess="external"))


def test_an_external_registration_is_the_result_and_icp_need_not_be_run(monkeypatch) -> None:
    def register(*_):
        raise AssertionError("ICP was run")

    monkeypatch.setattr(estimator, "register", register)
    monkeypatch.setattr(external_module, "register", register)
    tracker = tracker_with(registration="external", max_external_offset=0.0)
    answer = external(tracker, np.eye(4))
    found = answer.estimate.registration
    np.testing.assert_allclose(found.T_ref_read, STEP, atol=1e-12)
    assert (found.n_iterations, found.converged, answer.guess) == (0, True, "external")
    np.testing.assert_allclose(answer.estimate.covariance, WIDE, atol=1e-12)
    np.testing.assert_allclose(answer.pose.T, POSES[2] @ STEP, atol=1e-12)


def test_covariance_of_an_external_pose_has_the_way_that_icp_would_move_it() -> None:
    error = np.array([0.05, 0.0, -0.03, 0.0, 0.02, 0.01])
    answer = external(tracker_with(registration="external"), se3.exp(error))
    found = answer.estimate
    np.testing.assert_allclose(found.registration.T_ref_read, STEP @ se3.exp(error), atol=1e-12)
    np.testing.assert_allclose(answer.offset, -error, atol=0.01)
    extra = found.covariance - WIDE
    np.testing.assert_allclose(extra, np.outer(answer.offset, answer.offset), atol=1e-12)
    np.testing.assert_allclose(answer.pose.Y, found.covariance, atol=1e-12)
    assert 0.0 < found.registration.residual_rms_m < 0.1
    assert found.registration.n_associations > 100


def test_an_external_pose_that_icp_would_move_far_is_refused() -> None:
    far = se3.exp([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(DisagreementError, match=r"by 0\.\d+ m and .* more than 0\.2") as caught:
        external(tracker_with(registration="external", max_external_offset=0.2), far)
    assert caught.value.reason == "external_disagrees"


def test_at_the_base_the_chain_is_that_of_the_base(asked) -> None:
    X = se3.exp([0.3, 0.1, 1.2, 0.1, 0.0, 0.7])
    sensor, base = tracker_with(), tracker_with(output_frame="base")
    for i in range(4):
        place = Place(POSES[i] @ X, X)
        at_sensor = sensor.step(i * S, POINTS, place)
        at_base = base.step(i * S, POINTS, place)
    assert (at_sensor.frame_id, at_sensor.child_frame_id) == ("lidar", "lidar")
    assert (at_base.frame_id, at_base.child_frame_id) == ("base_link", "base_link")
    assert at_base.pose_frame_id == "odom"
    np.testing.assert_allclose(at_base.pose.T, POSES[3], atol=1e-12)
    expected = se3.inverse(POSES[2]) @ POSES[3]
    np.testing.assert_allclose(at_base.step.T, expected, atol=1e-12)
    Ad = se3.adjoint(X)
    np.testing.assert_allclose(at_base.step.Y, Ad @ WIDE @ Ad.T, atol=1e-12)
    np.testing.assert_allclose(at_base.pose.Y, Ad @ at_sensor.pose.Y @ Ad.T, atol=1e-12)


MAP = room(np.random.default_rng(9), 20_000, 20.0) + [300.0, 40.0, 1.0]
IN_MAP = se3.pose([300.5, 40.2, 1.0], [0, 0, 0, 1])


def test_without_a_map_there_is_no_answer(asked) -> None:
    with pytest.raises(NoReferenceError, match="reference_points"):
        tracker_with(pairing="topics").step(0, POINTS, Place(IN_MAP))


def test_a_scan_is_registered_to_the_map_in_the_frame_of_the_map(asked) -> None:
    tracker = tracker_with(pairing="topics")
    tracker.take_map(7, MAP, "map")
    for i in range(3):
        T = IN_MAP @ shift(0.1 * i)
        answer = tracker.step(i * S, POINTS, Place(T, odom_frame="map"))
        np.testing.assert_allclose(answer.step.T, T, atol=1e-9)
        np.testing.assert_allclose(answer.pose.T, T, atol=1e-9)
        np.testing.assert_allclose(answer.pose.Y, WIDE, atol=1e-12)  # of one registration
        assert (answer.reference_ns, answer.frame_id, answer.pose_frame_id) == (7, "map", "map")


def test_a_map_that_comes_again_is_prepared_once_and_a_new_one_anew(asked, monkeypatch) -> None:
    prepared = []
    around = map_module.prepare
    monkeypatch.setattr(map_module, "prepare", lambda *a: prepared.append(1) or around(*a))
    tracker = tracker_with(pairing="topics")
    for i, points in enumerate((MAP, MAP.copy(), MAP + [0.1, 0.0, 0.0])):
        tracker.take_map(0, points, "map")  # whose stamp says nothing
        tracker.step(i * S, POINTS, Place(IN_MAP))
    assert len(prepared) == 2


def test_odometry_that_drifts_or_jumps_from_the_map_is_followed(asked) -> None:
    tracker = tracker_with(pairing="topics")
    tracker.take_map(7, MAP, "map")
    drift = shift(3.0)
    tracker.step(0, POINTS, Place(IN_MAP))
    tracker._pairing._T_map_odom = drift  # as if registrations had found the odometry 3 m off
    for i in (1, 2):
        answer = tracker.step(i * S, POINTS, Place(IN_MAP @ shift(0.1 * i)))
        np.testing.assert_allclose(answer.pose.T, IN_MAP @ drift @ shift(0.1 * i), atol=1e-9)
    jumped = Place(POSES[5], epoch=2)
    answer = tracker.step(3 * S, POINTS, jumped)
    assert answer.guess == "constant_velocity"
    np.testing.assert_allclose(answer.pose.T, IN_MAP @ drift @ shift(0.3), atol=1e-9)
    answer = tracker.step(4 * S, POINTS, Place(POSES[5] @ shift(0.1), epoch=2))
    assert answer.guess == "odometry"
    np.testing.assert_allclose(answer.pose.T, IN_MAP @ drift @ shift(0.4), atol=1e-9)


def test_a_scan_is_found_in_a_map_by_icp(asked, monkeypatch) -> None:
    monkeypatch.undo()
    tracker = tracker_with(pairing="topics")
    tracker.take_map(7, MAP, "map")
    scan = se3.transform(se3.inverse(IN_MAP), MAP[::2])
    for i in range(2):
        answer = tracker.step(i * S, scan, Place(IN_MAP @ shift(0.1)))
        error = se3.log(se3.inverse(IN_MAP) @ answer.pose.T)
        assert np.abs(error).max() < 0.02


def test_a_covariance_that_cannot_be_published_has_a_reason_of_its_own() -> None:
    assert CovarianceError("not finite").reason == "covariance"


def test_the_motion_since_the_scan_before_is_known_except_after_a_break_or_on_a_map(
    asked, monkeypatch
) -> None:
    monkeypatch.setitem(globals(), "WIDE", 1e-4 * np.eye(6))
    for pairing, distance_m in (("consecutive", 1.0), ("keyframe", 1e9)):
        tracker = tracker_with(pairing=pairing, keyframe_distance_ratio=distance_m)
        for i, T in enumerate(SMALL_STEPS):
            answer = tracker.step(i * S, POINTS, Place(T))
        moved = se3.inverse(SMALL_STEPS[-2]) @ SMALL_STEPS[-1]
        assert answer.span_s == 1.0
        assert answer.reference_ns == (3 * S if pairing == "consecutive" else 0)
        np.testing.assert_allclose(answer.motion.T, moved, atol=1e-12)
        steps = [GaussianPose(se3.inverse(SMALL_STEPS[0]) @ T, WIDE) for T in SMALL_STEPS[-2:]]
        expected = BIAS.inflation(moved) * WIDE
        if pairing == "keyframe":
            expected = between(*steps, REFERENCE_SHARE).Y
        np.testing.assert_allclose(answer.motion.Y, expected, atol=1e-12)
    on_map = tracker_with(pairing="topics")
    on_map.take_map(7, MAP, "map")
    for i in range(3):
        answer = on_map.step(i * S, POINTS, Place(IN_MAP))
        assert answer.motion is None
        assert answer.span_s is None


@pytest.mark.parametrize("pairing_name", ["consecutive", "keyframe"])
def test_a_registration_that_odometry_makes_impossible_is_refused_or_never_ok(
    asked, monkeypatch, pairing_name
) -> None:
    fixed, wrong = module.Estimator.register, shift(1.5)

    def register(self, P, Q, T, rng):
        return fixed(self, P, Q, T @ wrong, rng)

    trackers = [
        tracker_with(pairing=pairing_name, publish_disagreeing=publish)
        for publish in (False, True)
    ]
    for tracker in trackers:
        for i in range(2):
            tracker.step(i * S, POINTS, Place(shift(0.1 * i)))
    monkeypatch.setattr(module.Estimator, "register", register)
    with pytest.raises(OdometryDisagreesError, match=r"1\.500 m .* more than 1 m"):
        trackers[0].step(2 * S, POINTS, Place(shift(0.2)))
    assert trackers[0].n_failures == 1
    answer = trackers[1].step(2 * S, POINTS, Place(shift(0.2)))
    assert "1.500 m" in answer.disagreement
    answer = trackers[1].step(3 * S, POINTS, NOWHERE)  # nobody says where it should be
    assert answer.disagreement == ""


def test_odometry_that_is_sure_of_itself_contradicts_sooner(asked, monkeypatch) -> None:
    fixed, wrong = module.Estimator.register, shift(0.5)
    tracker = tracker_with()
    sure = {"Y_odom": 1e-4 * np.eye(6)}
    monkeypatch.setitem(globals(), "WIDE", 1e-6 * np.eye(6))
    tracker.step(0, POINTS, Place(shift(0.0), **sure))
    monkeypatch.setattr(
        module.Estimator, "register", lambda self, P, Q, T, rng: fixed(self, P, Q, T @ wrong, rng)
    )
    with pytest.raises(OdometryDisagreesError, match="6 standard deviations"):
        tracker.step(S, POINTS, Place(shift(0.1), **sure))


def test_on_a_map_odometry_contradicts_only_once_it_is_located(asked, monkeypatch) -> None:
    fixed, far = module.Estimator.register, [shift(3.0)]
    monkeypatch.setattr(
        module.Estimator, "register", lambda self, P, Q, T, rng: fixed(self, P, Q, T @ far[0], rng)
    )
    tracker = tracker_with(pairing="topics")
    tracker.take_map(7, MAP, "map")
    assert tracker.step(0, POINTS, Place(IN_MAP)) is not None  # the two need not coincide
    with pytest.raises(OdometryDisagreesError):
        tracker.step(S, POINTS, Place(IN_MAP))


def test_a_planar_robot_has_z_roll_and_pitch_of_its_odometry(asked, monkeypatch) -> None:
    fixed, error = module.Estimator.register, se3.exp([0.02, 0.01, 0.3, 0.1, -0.1, 0.05])
    monkeypatch.setattr(
        module.Estimator, "register", lambda self, P, Q, T, rng: fixed(self, P, Q, T @ error, rng)
    )
    monkeypatch.setitem(globals(), "WIDE", 1e-4 * np.eye(6))
    tracker = tracker_with(planar=True)
    turns = [se3.exp([0.3 * i, 0, 0, 0, 0, 0.1 * i]) for i in range(4)]
    for i, T in enumerate(turns):
        answer = tracker.step(i * S, POINTS, Place(T))
    assert abs(answer.pose.T[2, 3]) < 1e-12
    np.testing.assert_allclose(answer.pose.T[2, :3], [0, 0, 1], atol=1e-12)
    assert abs(answer.pose.T[0, 3] - turns[3][0, 3]) > 0.02
    np.testing.assert_allclose(answer.step.Y[2, 2], 0.005**2)
    np.testing.assert_allclose(answer.step.Y[0, 0], WIDE[0, 0])
    np.testing.assert_allclose(
        answer.estimate.T_ref_read, se3.inverse(turns[2]) @ turns[3] @ error, atol=1e-12
    )
    flat = tracker.step(4 * S, POINTS, NOWHERE)  # the guess stays on the floor, too
    assert abs(flat.pose.T[2, 3]) < 1e-12


@pytest.mark.parametrize(
    ("mount", "sentence"),
    [
        ([0.5, 0.2, 0.0, 0.0, 0.0, 0.3], "to and fro by 0.5"),
        ([1.5, 0.0, 0.0, 0.0, 0.0, 3.1], "every other cloud"),
    ],
)
def test_two_lidars_in_turn_on_one_topic_are_told(mount: list[float], sentence: str) -> None:
    """By real registrations; one lidar, walking the same way, is not."""
    node = NodeConfig()
    X = [np.eye(4), se3.exp(mount)]
    for turns in (True, False):
        tracker = Tracker(load_model(shipped_model_path()), Config(node=node), node)
        rng = np.random.default_rng(3)
        for i in range(20):
            T = se3.exp(np.array([0.05, 0.02, 0.0, 0.0, 0.0, 0.02]) * i)
            points = se3.transform(se3.inverse(T @ X[i % 2 if turns else 0]), room(rng))
            with contextlib.suppress(RegistrationError):
                tracker.step(i * S // 10, points, Place(T))
        assert (sentence in tracker.warning) == turns, tracker.warning
        assert turns or tracker.warning == ""
