"""A stream of poses, with the frames it is in and the breaks it has.  Imports no ROS."""

from __future__ import annotations

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseError, PoseTrack
from cello3d_ros.geometry.se3 import Array


class PoseSource:
    """One stream of poses and the frames it speaks of.

    epoch: how often the stream has begun anew: at its first pose, after a jump and after a change
    of frames.  Poses of two epochs have nothing to do with each other.
    """

    def __init__(self, poses: PoseTrack) -> None:
        self.poses = poses
        self.frame_id = self.child_frame_id = ""
        self.epoch = 0

    def hear(
        self, stamp_ns: int, T: Array, frame_id: str, child_frame_id: str, max_speed_m_s: float
    ) -> str:
        """Remember a pose; return why a new epoch begins with it, or "".

        Raises PoseError, and nothing has changed, when the pose is none or not later.
        """
        if not se3.is_rigid(T):
            raise PoseError("the pose is not finite or not rigid")
        newest_ns = self.poses.newest_ns
        if newest_ns is not None and stamp_ns <= newest_ns:
            late_s = 1e-9 * (newest_ns - stamp_ns)
            what = f"{late_s:.3f} s older than" if late_s else "the same as that of"
            raise PoseError(f"the stamp is {what} the message before")
        break_ = self._break(stamp_ns, T, frame_id, child_frame_id, max_speed_m_s)
        if break_:
            self.poses.clear()
        self.poses.add(stamp_ns, T)
        self.epoch += bool(break_) or self.epoch == 0
        self.frame_id, self.child_frame_id = frame_id, child_frame_id
        return break_

    def _break(
        self, stamp_ns: int, T: Array, frame_id: str, child_frame_id: str, max_speed_m_s: float
    ) -> str:
        what = self.poses.what
        if self.epoch == 0:
            return ""
        for name, old, new in (
            ("frame_id", self.frame_id, frame_id),
            ("child_frame_id", self.child_frame_id, child_frame_id),
        ):
            if old != new:
                return f"the {name} of the {what} changed from {old!r} to {new!r}"
        speed = self.poses.speed_to(stamp_ns, T)
        if speed > max_speed_m_s:
            return f"the {what} jumped: {speed:.1f} m/s, more than {max_speed_m_s:g} m/s"
        return ""
