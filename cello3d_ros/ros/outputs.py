"""What is published for an answer."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from cello3d_ros.config import NodeConfig
from cello3d_ros.geometry.gaussian import GaussianPose
from cello3d_ros.geometry.se3 import Array, log
from cello3d_ros.ros import messages
from cello3d_ros.ros.diagnostics import Verdict, judged
from cello3d_ros.ros.markers import markers_to
from cello3d_ros.tracking.covariances import twist_covariance
from cello3d_ros.tracking.intake import Job
from cello3d_ros.tracking.tracker import Answer


class Outputs:
    """The publishers of poses, which live as long as the node is configured."""

    def __init__(self, node: Node, config: NodeConfig) -> None:
        """Announce the topics.  Raises ConfigError when TF is asked for and not there."""
        self._node = node
        self._n_answers = 0
        self._tf_message = messages.tf_message("node.publish_tf") if config.publish_tf else None
        self._relative = node.create_publisher(PoseWithCovarianceStamped, "~/relative_pose", 10)
        self._pose = node.create_publisher(PoseWithCovarianceStamped, "~/pose", 10)
        self._odometry = node.create_publisher(Odometry, "~/odometry", 10)
        self._markers = node.create_publisher(MarkerArray, "~/markers", 10)
        self._publishers = [self._relative, self._pose, self._odometry, self._markers]
        if self._tf_message is not None:
            self._tf = node.create_publisher(self._tf_message, "/tf", 100)
            self._publishers.append(self._tf)

    def destroy(self) -> None:
        """Leave the graph."""
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)

    def publish(self, job: Job, answer: Answer, config: NodeConfig) -> tuple[Array, Verdict]:
        """Publish an answer; return the (6, 6) covariance of ~/relative_pose and what it is worth.

        Raises CovarianceError and publishes nothing when there is one that cannot be.
        """
        relative = _pose(job.stamp_ns, answer.frame_id, answer.step, config)
        pose = _pose(job.stamp_ns, answer.pose_frame_id, answer.pose, config)
        odometry = messages.full_odometry(pose, answer.child_frame_id, *_twist(answer, config))
        C: Array = relative.pose.covariance.reshape(6, 6)
        verdict = judged(C, answer.estimate, config, answer.disagreement)
        self._odometry.publish(odometry)
        self._relative.publish(relative)
        self._pose.publish(pose)
        if self._tf_message is not None:
            T = messages.transform_to(
                job.stamp_ns, answer.pose_frame_id, answer.child_frame_id, answer.pose.T
            )
            self._tf.publish(self._tf_message(transforms=[T]))
        if self._markers.get_subscription_count() > 0:
            self._markers.publish(self._drawn(answer, pose, verdict, config))
        self._n_answers += 1
        return C, verdict

    def _drawn(
        self,
        answer: Answer,
        pose: PoseWithCovarianceStamped,
        verdict: Verdict,
        config: NodeConfig,
    ) -> MarkerArray:
        R = answer.pose.T[:3, :3]
        return markers_to(
            pose,
            messages.ros_covariance(answer.step.Y, R, *_bounds(config)),
            number=self._n_answers,
            level=verdict.level,
            scale=config.marker_scale,
            lifetime_s=config.marker_lifetime_s,
        )


def _pose(
    stamp_ns: int, frame_id: str, pose: GaussianPose, config: NodeConfig
) -> PoseWithCovarianceStamped:
    """Return the message of a pose with its reading-side covariance within the bounds."""
    C = messages.ros_covariance(pose.Y, pose.T[:3, :3], *_bounds(config))
    return messages.pose_with_covariance(stamp_ns, frame_id, pose.T, C)


def _twist(answer: Answer, config: NodeConfig) -> tuple[Array, Array]:
    """Return the twist (6,) since the scan before and its covariance (6, 6), along its own axes.

    Zero with the largest covariance where the motion since then is unknown.
    """
    if answer.motion is None or answer.span_s is None:
        return np.zeros(6), config.ceiling * np.eye(6)
    C = twist_covariance(answer.motion.Y, answer.span_s, *_bounds(config))
    return log(answer.motion.T) / answer.span_s, C


def _bounds(config: NodeConfig) -> tuple[float, float, float]:
    return config.floor_sigma_m, config.floor_sigma_rad, config.ceiling
