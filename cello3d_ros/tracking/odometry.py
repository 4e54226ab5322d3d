"""A stream of poses, with the frames it is in and the breaks it has.  Imports no ROS."""

from __future__ import annotations

from collections import deque

from cello3d_ros.geometry import se3
from cello3d_ros.geometry.pose_track import PoseError, PoseTrack
from cello3d_ros.geometry.se3 import Array

_N_COVARIANCES = 10_000  # remembered


class PoseSource:
    """One stream of poses and the frames it speaks of.

    epoch: how often the stream has begun anew: at its first pose, after a jump and after a change
    of frames.  Poses of two epochs have nothing to do with each other.
    """

    def __init__(self, poses: PoseTrack) -> None:
        self.poses = poses
        self.frame_id = self.child_frame_id = ""
        self.epoch = 0
        self._n_rejected, self._last_rejection = 0, ""  # since a pose was of use
        self._covariances: deque[tuple[int, Array]] = deque(maxlen=_N_COVARIANCES)

    def reject(self, sentence: str) -> None:
        """Note a message that was of no use, and why."""
        self._n_rejected += 1
        self._last_rejection = sentence

    @property
    def rejection(self) -> str:
        """Why there is no pose although messages came, or ""."""
        if len(self.poses) or not self._n_rejected:
            return ""
        return (
            f"all {self._n_rejected} messages of {self.poses.what} were rejected, the last "
            f"because {self._last_rejection}"
        )

    def clear(self) -> None:
        """Forget all poses."""
        self.poses.clear()
        self._covariances.clear()
        self._n_rejected = 0

    def covariance(self, stamp_ns: int) -> Array | None:
        """Return the covariance (6, 6) of the newest pose not after a stamp, if it has one."""
        found = (Y for before_ns, Y in reversed(self._covariances) if before_ns <= stamp_ns)
        return next(found, None)

    def hear(
        self,
        stamp_ns: int,
        T: Array,
        frame_id: str,
        child_frame_id: str,
        max_speed_m_s: float,
        covariance: Array | None = None,
    ) -> str:
        """Remember a pose; return why a new epoch begins with it, or "".

        covariance: (6, 6), right side, None where it has none.

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
            self.clear()
        self.poses.add(stamp_ns, T)
        self._n_rejected = 0
        if covariance is not None:
            self._covariances.append((stamp_ns, covariance))
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
