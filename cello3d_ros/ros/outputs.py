"""What is published for an answer."""

from __future__ import annotations

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node

from cello3d_ros.config import NodeConfig
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.ros import messages
from cello3d_ros.ros.intake import Job
from cello3d_ros.ros.tracker import Answer


class Outputs:
    """The publishers of poses, which live as long as the node is configured."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._relative = node.create_publisher(PoseWithCovarianceStamped, "~/relative_pose", 10)
        self._pose = node.create_publisher(PoseWithCovarianceStamped, "~/pose", 10)

    def destroy(self) -> None:
        """Leave the graph."""
        self._node.destroy_publisher(self._relative)
        self._node.destroy_publisher(self._pose)

    def publish(self, job: Job, answer: Answer, odometry_frame: str, config: NodeConfig) -> Array:
        """Publish an answer; return the (6, 6) covariance of the relative pose as published.

        Raises CovarianceError and publishes nothing when there is one that cannot be.
        """
        T_ref_read = answer.estimate.registration.T_ref_read
        relative = _pose(
            job.stamp_ns, job.frame_id, T_ref_read, answer.estimate.covariance, config
        )
        pose = _pose(job.stamp_ns, odometry_frame, answer.T_odom_read, answer.Y_chain, config)
        self._relative.publish(relative)
        self._pose.publish(pose)
        C: Array = relative.pose.covariance.reshape(6, 6)
        return C


def _pose(
    stamp_ns: int, frame_id: str, T: Array, Y: Array, config: NodeConfig
) -> PoseWithCovarianceStamped:
    """Return the message of a pose with its reading-side covariance within the bounds."""
    C = messages.ros_covariance(
        Y, T[:3, :3], config.floor_sigma_m, config.floor_sigma_rad, config.ceiling
    )
    return messages.pose_with_covariance(stamp_ns, frame_id, T, C)
