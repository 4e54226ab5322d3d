"""Pairs, chain and restarts, with and without real registrations."""

import numpy as np
import pytest

from cello3d_ros.config import Config, NodeConfig
from cello3d_ros.covariance.estimator import Estimate
from cello3d_ros.covariance.model import constant_model
from cello3d_ros.errors import CloudError, NoOverlapError
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import compound_right, is_positive_definite
from cello3d_ros.registration.icp import Registration
from cello3d_ros.ros import tracker as module
from cello3d_ros.ros.tracker import NotConvergedError, TooFarApartError, Tracker, reason_of
from cello3d_ros.ros.warmup import room

S = 10**9
WIDE = np.diag([0.3, 0.2, 0.1, 0.05, 0.1, 0.2])


@pytest.fixture
def asked(monkeypatch):
    """Registrations that return their first guess; a list of the guesses; what to do instead."""
    guesses: list[np.ndarray] = []
    instead: list[Exception | bool] = []

    def estimate(reading, reference, T_init, model, pipeline, rng, method, settings):
        guesses.append(T_init)
        fate = instead.pop(0) if instead else True
        if isinstance(fate, Exception):
            raise fate
        reason = "" if fate else "max_iterations"
        return Estimate(Registration(T_init, 5, fate, reason, 0.01, 99), 0.9, WIDE, 0.0, 1.0)

    monkeypatch.setattr(module, "estimate", estimate)
    return guesses, instead


@pytest.fixture
def tracker() -> Tracker:
    """A tracker that gives a reference up after two failures."""
    config = Config(node=NodeConfig(max_failures=2, max_pair_gap_s=5.0))
    return Tracker(constant_model(WIDE, 704), config, config.node)


POINTS = room(np.random.default_rng(0), 500)
POSES = [se3.exp(np.array([0.5, 0.1, 0.0, 0.1, 0.2, 0.6]) * i) for i in range(8)]


def test_first_guess_is_the_motion_of_the_odometry_in_the_frame_of_the_reference(
    tracker, asked
) -> None:
    assert tracker.step(0, POINTS, POSES[1]) is None
    answer = tracker.step(S, POINTS, POSES[3])
    np.testing.assert_allclose(asked[0][0], se3.inverse(POSES[1]) @ POSES[3], atol=1e-12)
    assert (answer.reference_ns, answer.stamp_ns) == (0, S)


def test_chain_starts_at_the_odometry_and_is_compounded_to_4th_order(tracker, asked) -> None:
    T, Y = POSES[2], np.zeros((6, 6))
    tracker.step(0, POINTS, POSES[2])
    for i in range(3, 7):
        answer = tracker.step(i * S, POINTS, POSES[i])
        T, Y = compound_right(T, Y, se3.inverse(POSES[i - 1]) @ POSES[i], WIDE, order=4)
        np.testing.assert_allclose(answer.T_odom_read, T, atol=1e-12)
        np.testing.assert_allclose(answer.Y_chain, Y, atol=1e-12)
    second = compound_right(T, Y, np.eye(4), WIDE, order=2).Y
    assert np.abs(second - compound_right(T, Y, np.eye(4), WIDE, order=4).Y).max() > 1e-3


def test_a_long_chain_stays_positive_definite(tracker, asked) -> None:
    for i in range(300):
        answer = tracker.step(i * S, POINTS, POSES[i % 2])
    assert is_positive_definite(answer.Y_chain)


def test_a_failed_scan_leaves_the_reference_and_the_chain(tracker, asked) -> None:
    guesses, fates = asked
    tracker.step(0, POINTS, POSES[0])
    fates.append(NoOverlapError("nothing in common"))
    with pytest.raises(NoOverlapError):
        tracker.step(S, POINTS, POSES[1])
    answer = tracker.step(2 * S, POINTS, POSES[2])
    np.testing.assert_allclose(guesses[1], POSES[2], atol=1e-12)
    assert (answer.reference_ns, tracker.n_restarts) == (0, 0)


def test_an_unconverged_registration_is_a_failure(tracker, asked) -> None:
    tracker.step(0, POINTS, POSES[0])
    asked[1].append(False)
    with pytest.raises(NotConvergedError, match="5 iterations"):
        tracker.step(S, POINTS, POSES[1])
    assert tracker.n_failures == 1


def test_after_max_failures_the_last_scan_is_the_reference_of_a_new_chain(tracker, asked) -> None:
    tracker.step(0, POINTS, POSES[0])
    tracker.step(S, POINTS, POSES[1])
    asked[1].extend([False, NoOverlapError("nothing in common")])
    for i in (2, 3):
        with pytest.raises((NotConvergedError, NoOverlapError)):
            tracker.step(i * S, POINTS, POSES[i])
    answer = tracker.step(4 * S, POINTS, POSES[4])
    assert (answer.reference_ns, tracker.n_restarts) == (3 * S, 1)
    np.testing.assert_allclose(answer.T_odom_read, POSES[4], atol=1e-12)
    np.testing.assert_allclose(answer.Y_chain, WIDE, atol=1e-12)


def test_failures_that_are_not_in_a_row_do_not_add_up(tracker, asked) -> None:
    tracker.step(0, POINTS, POSES[0])
    for i in range(1, 8, 2):
        asked[1].append(False)
        with pytest.raises(NotConvergedError):
            tracker.step(i * S, POINTS, POSES[i])
        tracker.step((i + 1) * S, POINTS, POSES[i])
    assert tracker.n_restarts == 0


def test_a_bad_cloud_is_no_failure_of_the_reference(tracker, asked) -> None:
    tracker.step(0, POINTS, POSES[0])
    for i in range(1, 5):
        with pytest.raises(CloudError):
            tracker.step(i * S, POINTS[:3], POSES[i])
    assert tracker.step(5 * S, POINTS, POSES[5]).reference_ns == 0


def test_a_long_pause_starts_a_new_chain(tracker, asked) -> None:
    tracker.step(0, POINTS, POSES[0])
    with pytest.raises(TooFarApartError, match=r"6\.0 s after"):
        tracker.step(6 * S, POINTS, POSES[1])
    assert tracker.step(7 * S, POINTS, POSES[2]).reference_ns == 6 * S
    assert tracker.n_restarts == 1


def test_the_same_scans_give_the_same_answers_whatever_came_before(tracker) -> None:
    rng = np.random.default_rng(4)
    scans = [room(rng), room(rng), room(rng)]
    tracker.step(0, scans[0], POSES[0])
    tracker.step(S, scans[1], POSES[0])
    first = tracker.step(2 * S, scans[2], POSES[0])
    tracker.reset()
    tracker.step(S, scans[1], POSES[0])
    again = tracker.step(2 * S, scans[2], POSES[0])
    np.testing.assert_array_equal(
        first.estimate.registration.T_ref_read, again.estimate.registration.T_ref_read
    )


def test_reasons_are_the_narrowest_name() -> None:
    assert reason_of(NoOverlapError()) == "no_overlap"
    assert reason_of(NotConvergedError()) == "not_converged"
    assert reason_of(TooFarApartError()) == "too_far_apart"
    assert reason_of(CloudError()) == "too_few_points"
    assert reason_of(ValueError()) == "internal"
