"""Parameters of a running node: descriptions, ranges, live changes."""

import pytest

pytest.importorskip("rclpy")

from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.parameter import Parameter


@pytest.fixture(scope="module")
def ask(player):
    """Call a parameter service of the node."""

    def call(kind, name: str, request):
        client = player._node.create_client(kind, f"/covariance_node/{name}")
        assert player.spin_until(client.service_is_ready, 20.0)
        future = client.call_async(request)
        assert player.spin_until(future.done, 10.0)
        player._node.destroy_client(client)
        return future.result()

    return call


def change(ask, name: str, value):
    """Set one parameter and return the node's verdict."""
    message = Parameter(name, value=value).to_parameter_msg()
    return ask(
        SetParameters, "set_parameters", SetParameters.Request(parameters=[message])
    ).results[0]


def test_descriptions_and_ranges_come_from_the_configuration(ask) -> None:
    names = ["icp.trim_ratio", "icp.max_iterations", "icp.error_metric", "grid.extent_m"]
    request = DescribeParameters.Request(names=names)
    trim, iterations, metric, extent = ask(
        DescribeParameters, "describe_parameters", request
    ).descriptors
    assert trim.description == "share of the associations kept, the closest"
    assert (trim.floating_point_range[0].from_value, trim.floating_point_range[0].to_value) == (
        0.01,
        1.0,
    )
    assert iterations.integer_range[0].to_value == 10000
    assert metric.additional_constraints == "one of point_to_plane, point_to_point"
    assert extent.read_only
    assert not trim.read_only


def test_a_live_change_within_range_is_taken_and_works(ask, robot) -> None:
    assert change(ask, "icp.trim_ratio", 0.8).successful
    robot.assert_right_again()
    assert change(ask, "icp.trim_ratio", 0.7).successful
    assert change(ask, "node.ceiling", 1e-5).successful
    robot.assert_right_again()
    assert float(robot.player.replay.last_status["weakest_eigenvalue"]) <= 1.001e-5
    assert change(ask, "node.ceiling", 900.0).successful
    robot.assert_right_again()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("icp.trim_ratio", 1.5),
        ("icp.trim_ratio", "much"),
        ("icp.error_metric", "fast"),
        ("node.model", "/other.npz"),
        ("cloud.voxel_m", 0.5),
    ],
)
def test_a_live_change_that_cannot_be_is_refused_with_a_reason(ask, robot, name, value) -> None:
    verdict = change(ask, name, value)
    assert not verdict.successful
    assert verdict.reason
    robot.assert_right_again()
