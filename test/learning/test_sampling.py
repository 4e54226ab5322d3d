import numpy as np
import pytest

from cello3d_ros.clouds.shape import prepare
from cello3d_ros.config import CloudConfig, IcpConfig, OverlapConfig, Pipeline, SamplingConfig
from cello3d_ros.errors import RecordingError
from cello3d_ros.geometry.gaussian import sampled_covariance
from cello3d_ros.geometry.se3 import exp, inverse, log, transform
from cello3d_ros.learning.sampling import sample_pair, sample_recording
from cello3d_ros.recordings.recording import Scan

PIPELINE = Pipeline(
    cloud=CloudConfig(voxel_m=0.1),
    icp=IcpConfig(n_reading_points=600, n_reference_points=2500),
    overlap=OverlapConfig(radius_m=0.4),
)
SAMPLING = SamplingConfig(n_samples=40, variance=0.01, max_gap=2, seed=5, n_rotations=2)


class Recorded:
    """A recording in memory."""

    def __init__(self, name, scans):
        self.name, self.scans = name, scans

    def __len__(self):
        return len(self.scans)

    def __iter__(self):
        return iter(self.scans)


def cloud(points):
    return prepare(points, PIPELINE.cloud, np.random.default_rng(0))


def hallway(seed):
    """Four walls along x without ends, rough on a scale that does not tell where along x."""
    rng = np.random.default_rng(seed)
    n = 6000
    points = rng.uniform([-15, -1.5, -1.2], [15, 1.5, 1.2], (n, 3))
    side = rng.integers(4, size=n)
    points[side == 0, 1], points[side == 1, 1] = -1.5, 1.5
    points[side == 2, 2], points[side == 3, 2] = -1.2, 1.2
    return points + rng.normal(scale=0.01, size=points.shape)


@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_a_hallway_is_free_along_itself(turn):
    R = exp([0, 0, 0, 0, 0, turn])
    record = sample_pair(
        "hallway",
        0,
        1,
        cloud(transform(R, hallway(1))),
        cloud(transform(R, hallway(2))),
        np.eye(4),
        PIPELINE,
        SamplingConfig(n_samples=150, variance=0.02, cluster_scale_m=0.5),
        n_threads=2,
    )
    assert record.accepted
    values, vectors = np.linalg.eigh(record.covariance[:3, :3])
    assert abs(vectors[:, -1] @ R[:3, 0]) > 0.99
    assert values[-1] > 20 * values[-2]


def test_the_covariance_is_on_the_reading_side_about_the_truth(room):
    """T_mean is off the true pose by b: the covariance holds b b^T, in the reading's frame."""
    T = exp([0.5, -0.2, 0.1, 0.0, 0.1, 1.2])
    b = np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    reading, reference = cloud(transform(inverse(T), room[0])), cloud(room[1])
    record = sample_pair(
        "room", 0, 1, reading, reference, T @ exp(-b), PIPELINE, SAMPLING, n_threads=2
    )
    assert record.accepted
    np.testing.assert_allclose(record.xi[record.kept].mean(axis=0), b, atol=0.01)
    np.testing.assert_array_equal(record.covariance, sampled_covariance(record.xi[record.kept]))
    assert record.covariance[0, 0] > 0.04**2


def recorded(name, n_scans=4):
    rng = np.random.default_rng(9)
    walls = rng.uniform([-4, -3, -1.5], [4, 3, 1.5], (5000, 3))
    face = rng.integers(3, size=len(walls))
    sign = rng.choice([-1, 1], len(walls))
    walls[np.arange(len(walls)), face] = sign * np.array([4, 3, 1.5])[face]
    scans = []
    for k in range(n_scans):
        T = exp([0.2 * k, 0.1 * k, 0, 0, 0, 0.1 * k])
        points = transform(inverse(T), walls + rng.normal(scale=0.01, size=walls.shape))
        scans.append(Scan(stamp_ns=k, points=points, T_world_sensor=T))
    return Recorded(name, scans)


def test_neither_threads_nor_what_is_done_change_a_record():
    todo = [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]
    small = SamplingConfig(n_samples=15, variance=0.01, max_gap=2, seed=5, n_rotations=2)
    one = list(sample_recording(recorded("r"), todo, PIPELINE, small, n_threads=1))
    two = list(sample_recording(recorded("r"), todo, PIPELINE, small, n_threads=2))
    rest = list(sample_recording(recorded("r"), todo[2:4], PIPELINE, small))
    assert [r.key[1:] for r in one] == todo
    for a, b in [*zip(one, two), *zip(one[2:4], rest)]:
        assert a.accepted
        for name in ("xi", "kept", "covariance", "descriptors", "T_mean"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    other = list(sample_recording(recorded("other name"), todo[:1], PIPELINE, small))
    assert not np.array_equal(other[0].xi, one[0].xi)


def test_the_starts_have_the_stated_variance(monkeypatch):
    """With ICP stopped at once, the results are the starts."""
    pipeline = Pipeline(cloud=PIPELINE.cloud, icp=PIPELINE.icp, overlap=PIPELINE.overlap)
    seen = []

    def keep_starts(reading, reference, starts, seeds, config, n_threads):
        seen.append(starts)
        return []

    monkeypatch.setattr("cello3d_ros.learning.sampling.register_many", keep_starts)
    recording = recorded("r", 2)
    sampling = SamplingConfig(n_samples=4000, variance=0.05)
    list(sample_recording(recording, [(0, 1)], pipeline, sampling))
    T_mean = inverse(recording.scans[0].T_world_sensor) @ recording.scans[1].T_world_sensor
    xi = log(inverse(T_mean) @ seen[0])
    np.testing.assert_allclose(np.cov(xi.T), 0.05 * np.eye(6), atol=0.006)
    np.testing.assert_allclose(xi.mean(axis=0), 0.0, atol=0.015)


def test_pairs_that_cannot_be_learned_from_say_why(room):
    far = Recorded(
        "r",
        [
            Scan(stamp_ns=0, points=room[0], T_world_sensor=np.eye(4)),
            Scan(stamp_ns=1, points=room[1], T_world_sensor=exp([50, 0, 0, 0, 0, 0])),  # wrong
            Scan(stamp_ns=2, points=room[1][:3], T_world_sensor=np.eye(4)),
        ],
    )
    records = sample_recording(far, [(0, 1), (0, 2), (1, 2)], PIPELINE, SAMPLING)
    assert [r.reason for r in records] == ["offset", "too_few_points", "too_few_points"]


def test_pairs_that_fail_consistently_are_rejected(room):
    wrong = exp([0, 0, 0, 0, 0, 1.4])  # the "truth" is turned, ICP finds another pose
    record = sample_pair(
        "r",
        0,
        1,
        cloud(room[0]),
        cloud(room[1]),
        wrong,
        PIPELINE,
        SamplingConfig(n_samples=30, variance=1e-4, max_offset_rad=0.3, max_offset_m=0.3),
    )
    assert not record.accepted
    assert record.reason in ("offset", "no_overlap")


def test_sampling_without_ground_truth_is_an_error(room):
    blind = Recorded("blind", [Scan(stamp_ns=k, points=room[0]) for k in range(2)])
    with pytest.raises(RecordingError, match="no ground truth"):
        list(sample_recording(blind, [(0, 1)], PIPELINE, SAMPLING))
