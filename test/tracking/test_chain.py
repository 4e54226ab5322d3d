"""Scans that follow each other, and the pose that is expected next."""

import numpy as np

from cello3d_ros.clouds.shape import filtered
from cello3d_ros.config import CloudConfig
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import Chained
from cello3d_ros.tracking.chain import Chain, Frame, Link
from cello3d_ros.tracking.guess import Place

S = 10**9
X = se3.exp([0.2, 0.0, 1.0, 0.0, 0.0, 0.5])
STEP = se3.exp([0.5, 0.1, 0.0, 0.02, -0.05, 0.3])


def link(stamp_ns: int, T: np.ndarray) -> Link:
    rng = np.random.default_rng(0)
    cloud = filtered(rng.normal(size=(200, 3), scale=5.0), CloudConfig(), rng)
    frame = Frame(stamp_ns, cloud, Place(T), T)
    return Link(frame, Chained.start(T))


def test_motion_is_carried_on_at_constant_velocity() -> None:
    chain = Chain()
    np.testing.assert_array_equal(chain.predicted(S), np.eye(4))
    chain.begin(link(S, X))
    np.testing.assert_array_equal(chain.predicted(5 * S), X)
    chain.add(link(2 * S, X @ STEP))
    expected = X @ STEP @ STEP @ STEP
    np.testing.assert_allclose(chain.predicted(4 * S), expected, atol=1e-12)


def test_only_a_chain_of_one_scan_is_at_its_first() -> None:
    chain = Chain()
    assert not chain.is_at_first
    chain.begin(link(S, X))
    assert chain.is_at_first
    chain.add(link(2 * S, X))
    assert not chain.is_at_first
