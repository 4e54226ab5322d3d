"""Which cloud is worked on next: order of stamps, waiting for odometry, overload.  No ROS."""

from __future__ import annotations

import contextlib
import statistics
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from cello3d_ros.clouds.motion import sweep_of
from cello3d_ros.geometry.pose_track import PoseError, PoseNotYetError
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.tracking.guess import Place

JUMP_NS = (
    1_000_000_000  # a stamp that goes back by more than this is a clock set back, a bag looped
)

_N_WAITING = 64  # clouds that wait
_N_POINTS = 8_000_000  # points of all of them: 200 MB
_BACKLOG = 3  # clouds ready to be worked on, from which on the newest is taken
_N_CLOUDS = 10  # whose times of arrival say how often clouds come
_N_WORKS = 5  # pieces of work, most of which are too long under overload


@dataclass(frozen=True)
class Skip:
    """A cloud that will not be answered: its stamp, a reason to count by, and one sentence."""

    stamp_ns: int
    reason: str
    sentence: str


@dataclass
class Job:
    """A cloud on its way: when it came (time.monotonic) and, in the end, where it was taken.

    points: (N, 3), sensor frame.  time_s: (N,), finite, when each was seen, after the stamp, or
    None: then ``no_times`` says why.
    """

    stamp_ns: int
    points: Array
    frame_id: str
    received_s: float
    waited_s: float = 0.0
    place: Place | None = None
    time_s: Array | None = None
    no_times: str = ""
    sweep_s: tuple[float, float] | None = field(init=False)

    def __post_init__(self) -> None:
        self.sweep_s = None if self.time_s is None else sweep_of(self.time_s)


def stamp_order(stamp_ns: int, newest_ns: int | None) -> str:
    """Return "later", or why not: "duplicate_stamp", "out_of_order" or "jump"."""
    if newest_ns is None or stamp_ns > newest_ns:
        return "later"
    if stamp_ns == newest_ns:
        return "duplicate_stamp"
    return "jump" if newest_ns - stamp_ns > JUMP_NS else "out_of_order"


class Intake:
    """Clouds that wait for their odometry, worked on in their order.

    Only where the work takes longer than clouds take to come, and three are ready, is the newest
    taken first and those before it dropped.  A bounded number waits, with a bounded number of
    points; beyond that the newest takes the place of the one before it, so that odometry that is
    always late starves nobody.
    """

    def __init__(
        self,
        locate: Callable[[int, str, bool, tuple[float, float] | None], Place],
        timeout_s: float,
        what: str = "odometry",
    ) -> None:
        """locate: as Locator.place.  timeout_s: how long a cloud waits for it.  what: it knows."""
        self._locate = locate
        self._what = what
        self.timeout_s = timeout_s
        self._waiting: list[Job] = []
        self._came_s: deque[float] = deque(maxlen=_N_CLOUDS)
        self._worked_s: deque[float] = deque(maxlen=_N_WORKS)

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def is_overloaded(self) -> bool:
        """Whether most of the last pieces of work took longer than clouds take to come."""
        if len(self._worked_s) < 3 or len(self._came_s) < 2:
            return False
        period_s = (self._came_s[-1] - self._came_s[0]) / (len(self._came_s) - 1)
        return statistics.median(self._worked_s) > period_s

    def note_work(self, seconds: float) -> None:
        """Note how long the work on a cloud took."""
        self._worked_s.append(seconds)

    def clear(self, reason: str, sentence: str) -> list[Skip]:
        """Forget the clouds that wait, for a reason."""
        dropped = [Skip(job.stamp_ns, reason, sentence) for job in self._waiting]
        self._waiting.clear()
        self._came_s.clear()
        return dropped

    def offer(self, job: Job, n_unheard: int = 0) -> list[Skip]:
        """Let a cloud wait, later than all that wait; return what it displaced.

        n_unheard: clouds that came before it but never got here.
        """
        self._came_s.extend([job.received_s] * (1 + n_unheard))
        displaced = []
        n_points = len(job.points) + sum(len(old.points) for old in self._waiting)
        while self._waiting and (len(self._waiting) >= _N_WAITING or n_points > _N_POINTS):
            displaced.append(self._waiting.pop())
            n_points -= len(displaced[-1].points)
        self._waiting.append(job)
        sentence = f"{len(self._waiting)} clouds wait for {self._what}: no more are kept"
        return [Skip(old.stamp_ns, "superseded", sentence) for old in reversed(displaced)]

    def newest_is_ready(self) -> bool:
        """Return whether no cloud waits or the newest has all, or can have nothing more."""
        try:
            for job in self._waiting[-1:]:
                self._place(job)
        except PoseError as error:
            return not isinstance(error, PoseNotYetError)
        return True

    def take(self) -> tuple[Job | None, list[Skip]]:
        """Return the next cloud whose odometry is there, if any, and what was dropped.

        It is the oldest such cloud, or the newest under overload; what is older is dropped.
        """
        skips: list[Skip] = []
        is_overloaded = self.is_overloaded and self._n_ready() >= _BACKLOG
        for job in self._waiting[::-1] if is_overloaded else self._waiting[:]:
            try:
                job.place = self._place(job)
            except PoseNotYetError:
                continue
            except PoseError as error:
                skips.append(self._without_place(job, error))
                self._waiting.remove(job)
                continue
            k = self._waiting.index(job)
            skips += [self._passed_over(old, is_overloaded) for old in self._waiting[:k]]
            del self._waiting[: k + 1]
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
        is_late = job.waited_s >= self.timeout_s
        return self._locate(job.stamp_ns, job.frame_id, is_late, job.sweep_s)

    def _n_ready(self) -> int:
        """Return how many clouds wait with all that they need."""
        n = 0
        for job in self._waiting:
            with contextlib.suppress(PoseError):
                self._place(job)
                n += 1
        return n

    def _passed_over(self, job: Job, is_overloaded: bool) -> Skip:
        if not is_overloaded:  # a later cloud has what this one lacks
            try:
                self._place(job)
            except PoseError as error:
                return self._without_place(job, error)
        sentence = "the work takes longer than clouds take to come, and a newer one was there"
        return Skip(job.stamp_ns, "superseded", sentence)

    def _without_place(self, job: Job, error: PoseError) -> Skip:
        if error.reason != PoseError.reason:
            return Skip(job.stamp_ns, error.reason, str(error))
        reason = f"no_{self._what.replace(' ', '_')}"
        sentence = f"no {self._what} at the stamp of the cloud: {error}"
        return Skip(job.stamp_ns, reason, sentence)
