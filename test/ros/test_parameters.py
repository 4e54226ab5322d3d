"""Parameters of a running node: descriptions, ranges, live changes."""

import dataclasses
from importlib.util import find_spec

import numpy as np
import pytest
import rclpy
from rcl_interfaces.srv import DescribeParameters
from rclpy.parameter import Parameter

from cello3d_ros.config import NodeConfig
from cello3d_ros.errors import ConfigError
from cello3d_ros.ros import parameters
from cello3d_ros.ros.node import CovarianceNode


def test_descriptions_and_ranges_come_from_the_configuration(ask) -> None:
    names = ["icp.trim_ratio", "icp.max_iterations", "icp.error_metric", "grid.extent_m"]
    request = DescribeParameters.Request(names=names)
    trim, iterations, metric, _ = ask(
        DescribeParameters, "describe_parameters", request
    ).descriptors
    assert trim.description == "share of the associations kept, the closest"
    assert (trim.floating_point_range[0].from_value, trim.floating_point_range[0].to_value) == (
        0.01,
        1.0,
    )
    assert iterations.integer_range[0].to_value == 10000
    assert metric.additional_constraints == "one of point_to_plane, point_to_point"


def test_a_live_change_within_range_is_taken_and_works(change, robot) -> None:
    assert change("icp.trim_ratio", 0.8).successful
    robot.assert_right_again()
    assert change("icp.trim_ratio", 0.7).successful
    assert change("node.ceiling", 1e-5).successful
    robot.assert_right_again()
    assert float(robot.player.replay.last_status["weakest_eigenvalue"]) <= 1.001e-5
    assert change("node.ceiling", 900.0).successful
    robot.assert_right_again()


FIXED = "is read when the node is configured: clean the node up, set it and configure again"


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("icp.trim_ratio", 1.5, "icp.trim_ratio"),
        ("icp.trim_ratio", "much", "type"),
        ("icp.error_metric", "fast", "must be one of point_to_plane, point_to_point: 'fast'"),
        ("node.model", "/other.npz", FIXED),
        ("cloud.voxel_m", 0.5, FIXED),
    ],
)
def test_a_live_change_that_cannot_be_is_refused_with_a_reason(
    change, robot, name, value, reason
) -> None:
    verdict = change(name, value)
    assert not verdict.successful
    assert reason in verdict.reason
    robot.assert_right_again()


def test_modes_and_scale_change_from_one_cloud_to_the_next(change, robot) -> None:
    for mode in ("hessian", "fused", "constant", "cello3d"):
        assert change("node.covariance_mode", mode).successful
        robot.assert_right_again()
        assert robot.player.replay.last_status["covariance_mode"] == mode
    plain = np.trace(robot.player.replay.relative[robot.stamp_ns].C)
    assert change("node.scale", 4.0).successful
    robot.assert_right_again()
    C = robot.player.replay.relative[robot.stamp_ns].C
    assert np.trace(C) == pytest.approx(4.0 * plain, rel=1e-6)
    assert change("node.scale", 1.0).successful
    assert not change("node.covariance_mode", "best").successful


def test_every_default_survives_a_dump() -> None:
    """ros2 param dump writes 1e-05, and its load takes that for a string."""
    for section in parameters._SECTIONS.values():
        for setting in dataclasses.fields(section):
            values = setting.default if isinstance(setting.default, tuple) else (setting.default,)
            assert not any("e" in repr(v) for v in values if isinstance(v, float)), setting.name


def test_a_backend_without_its_library_is_refused_and_not_every_cloud(change, robot) -> None:
    if find_spec("small_gicp") is not None:
        pytest.skip("small_gicp is installed")
    verdict = change("icp.backend", "small_gicp")
    assert not verdict.successful
    assert "icp.backend small_gicp needs small_gicp" in verdict.reason
    robot.assert_right_again()


def test_tf_that_would_cut_the_tree_is_refused(change, robot) -> None:
    with pytest.raises(ConfigError, match="output_frame to base"):
        NodeConfig(use_tf=True, publish_tf=True)
    NodeConfig(use_tf=True, publish_tf=True, output_frame="base")


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("node.T_base_sensor", [1.0, 0.0, 0.0], "needs x y z and a unit quaternion"),
        ("grid.n_cells", [8, 8], "needs three numbers"),
        ("node.model", "/any.npz", ""),
    ],
)
def test_before_it_is_configured_nonsense_is_refused_as_well(
    model_path, name, value, sentence
) -> None:
    rclpy.init(args=["--ros-args", "-p", f"node.model:={model_path}", "--log-level", "fatal"])
    try:
        node = CovarianceNode("unconfigured")
        node.start()
        node.trigger_deactivate()
        node.trigger_cleanup()
        (verdict,) = node.set_parameters([Parameter(name, value=value)])
        assert verdict.successful == (sentence == "")
        assert sentence in verdict.reason
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
