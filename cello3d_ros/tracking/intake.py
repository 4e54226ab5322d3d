"""Which cloud is worked on next: order of stamps, waiting for odometry, newest wins.  No ROS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from cello3d_ros.geometry.pose_track import PoseError, PoseNotYetError
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.geometry.transforms import UnknownFrameError
from cello3d_ros.tracking.guess import Place

JUMP_NS = (
    1_000_000_000  # a stamp that goes back by more than this is a clock set back, a bag looped
)

_N_SLOTS = 2


@dataclass(frozen=True)
class Skip:
    """A cloud that will not be answered: its stamp, a reason to count by, and one sentence."""

    stamp_ns: int
    reason: str
    sentence: str


@dataclass
class Job:
    """A cloud on its way: when it came (time.monotonic) and, in the end, where it was taken.

    points: (N, 3), sensor frame.
    """

    stamp_ns: int
    points: Array
    frame_id: str
    received_s: float
    waited_s: float = 0.0
    place: Place | None = None


def stamp_order(stamp_ns: int, newest_ns: int | None) -> str:
    """Return "later", or why not: "duplicate_stamp", "out_of_order" or "jump"."""
    if newest_ns is None or stamp_ns > newest_ns:
        return "later"
    if stamp_ns == newest_ns:
        return "duplicate_stamp"
    return "jump" if newest_ns - stamp_ns > JUMP_NS else "out_of_order"


class Intake:
    """At most two clouds wait for their odometry: the oldest and the newest.

    A cloud between them is dropped, so that nothing queues up; the oldest keeps its place, so
    that odometry which is always late by more than a period of the clouds starves nobody.  Of
    the clouds whose odometry is there the newest is taken and the others are dropped.
    """

    def __init__(
        self,
        locate: Callable[[int, str, bool], Place],
        timeout_s: float,
        what: str = "odometry",
    ) -> None:
        """locate: as Locator.place.  timeout_s: how long a cloud waits for it.  what: it knows."""
        self._locate = locate
        self._what = what
        self.timeout_s = timeout_s
        self._waiting: list[Job] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def clear(self, reason: str, sentence: str) -> list[Skip]:
        """Forget the clouds that wait, for a reason."""
        dropped = [Skip(job.stamp_ns, reason, sentence) for job in self._waiting]
        self._waiting.clear()
        return dropped

    def offer(self, job: Job) -> list[Skip]:
        """Let a cloud wait, later than all that wait; return what it displaced."""
        displaced = self._waiting[_N_SLOTS - 1 :]
        self._waiting[_N_SLOTS - 1 :] = [job]
        return [_superseded(old) for old in displaced]

    def newest_is_ready(self) -> bool:
        """Return whether no cloud waits or the newest has all, or can have nothing more."""
        try:
            for job in self._waiting[-1:]:
                self._place(job)
        except PoseError as error:
            return not isinstance(error, PoseNotYetError)
        return True

    def take(self) -> tuple[Job | None, list[Skip]]:
        """Return the newest cloud whose odometry is there, if any, and what was dropped."""
        skips = []
        for i in reversed(range(len(self._waiting))):
            job = self._waiting[i]
            try:
                job.place = self._place(job)
            except PoseNotYetError:
                continue
            except PoseError as error:
                skips.append(self._without_place(job, error))
                del self._waiting[i]
                continue
            skips += [_superseded(old) for old in self._waiting[:i]]
            del self._waiting[: i + 1]
            return job, skips
        return None, skips

    def expire(self, elapsed_s: float) -> list[Skip]:
        """Drop the clouds that have now waited long enough, unless they can do without odometry.

        ``elapsed_s`` counts only time in which odometry could have been heard: a node that was
        busy must not blame the odometry.
        """
        skips, kept = [], []
        for job in self._waiting:
            job.waited_s += elapsed_s
            if job.waited_s < self.timeout_s:
                kept.append(job)
                continue
            try:
                self._place(job)
                kept.append(job)
            except PoseError as error:
                skips.append(self._without_place(job, error))
        self._waiting = kept
        return skips

    def _place(self, job: Job) -> Place:
        return self._locate(job.stamp_ns, job.frame_id, job.waited_s >= self.timeout_s)

    def _without_place(self, job: Job, error: PoseError) -> Skip:
        if isinstance(error, UnknownFrameError):
            return Skip(job.stamp_ns, "unknown_frame", str(error))
        reason = f"no_{self._what.replace(' ', '_')}"
        sentence = f"no {self._what} at the stamp of the cloud: {error}"
        return Skip(job.stamp_ns, reason, sentence)


def _superseded(job: Job) -> Skip:
    return Skip(job.stamp_ns, "superseded", "a newer cloud came before it could be worked on")
