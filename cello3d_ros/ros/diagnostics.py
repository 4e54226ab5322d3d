"""What the node has seen, as diagnostic_msgs/DiagnosticArray."""

from __future__ import annotations

import time
from collections import Counter, deque

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from cello3d_ros.geometry.se3 import Array
from cello3d_ros.ros.messages import time_of
from cello3d_ros.ros.tracker import Answer

ANSWERED, REFERENCE, WAITING, INACTIVE = "answered", "reference", "waiting", "inactive"

_WINDOW = 200  # latencies remembered


class Statistics:
    """Counts since the start, latencies of the last answers and the last answer itself."""

    def __init__(self, model_name: str, n_serious_failures: int) -> None:
        self._model_name = model_name
        self._n_serious = n_serious_failures
        self.counts: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self._latencies_s: deque[float] = deque(maxlen=_WINDOW)
        self._ages_s: deque[float] = deque(maxlen=_WINDOW)
        self._last_event, self._last_stamp_ns = INACTIVE, 0
        self._last_failure = ""
        self._n_failed_in_a_row = 0
        self._answer: dict[str, str] = {}

    def listen(self, is_listening: bool) -> None:
        """Note that the node has begun, or ceased, to listen."""
        self._last_event, self._last_stamp_ns = WAITING if is_listening else INACTIVE, 0
        self._n_failed_in_a_row = 0

    def fail(self, stamp_ns: int, reason: str, sentence: str) -> None:
        """Count a cloud without an answer."""
        self.dropped[reason] += 1
        self._last_event, self._last_stamp_ns = reason, stamp_ns
        self._last_failure = sentence
        self._n_failed_in_a_row += 1

    def reference(self, stamp_ns: int) -> None:
        """Note a cloud with which a chain starts, so that it has no answer."""
        self.counts["references"] += 1
        self._last_event, self._last_stamp_ns = REFERENCE, stamp_ns

    def answer(self, answer: Answer, C: Array, received_s: float, now_ns: int) -> None:
        """Count an answer.  C: (6, 6), as published; received_s: time.monotonic() of the cloud."""
        self.counts["answered"] += 1
        self._last_event, self._last_stamp_ns = ANSWERED, answer.stamp_ns
        self._n_failed_in_a_row = 0
        self._latencies_s.append(time.monotonic() - received_s)
        self._ages_s.append(1e-9 * (now_ns - answer.stamp_ns))
        self._answer = _described(answer, C)

    def message(
        self, name: str, now_ns: int, n_restarts: int, n_clock_jumps: int
    ) -> DiagnosticArray:
        """Return the message of now: level, one sentence, keys and values."""
        status = DiagnosticStatus(name=name, level=self._level(), message=self._sentence())
        values = {
            "last_event": self._last_event,
            "last_stamp_ns": str(self._last_stamp_ns),
            "last_failure": self._last_failure,
            "received": str(self.counts["received"]),
            "answered": str(self.counts["answered"]),
            "dropped": str(sum(self.dropped.values())),
            **{f"dropped.{reason}": str(n) for reason, n in sorted(self.dropped.items())},
            "odometry_received": str(self.counts["odometry"]),
            "odometry_rejected": str(self.counts["odometry_rejected"]),
            "clock_jumps": str(n_clock_jumps),
            "chain_restarts": str(n_restarts),
            "model": self._model_name,
            **_quantiles("latency_ms", self._latencies_s),
            **_quantiles("age_ms", self._ages_s),
            **self._answer,
        }
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = time_of(now_ns)
        return message

    def _level(self) -> bytes:
        level: bytes = DiagnosticStatus.OK
        if self._n_failed_in_a_row >= self._n_serious:
            level = DiagnosticStatus.ERROR
        elif self._n_failed_in_a_row or self._last_event == WAITING:
            level = DiagnosticStatus.WARN
        return level

    def _sentence(self) -> str:
        if self._n_failed_in_a_row:
            return f"no answer: {self._last_failure}"
        return {
            WAITING: "waiting for clouds and odometry",
            INACTIVE: "inactive: not listening",
            REFERENCE: "the next cloud is registered to this one",
        }.get(self._last_event, "answered")


def _described(answer: Answer, C: Array) -> dict[str, str]:
    """Return the last answer in words; ``weakest`` is the direction of the largest variance."""
    found = answer.estimate
    values, vectors = np.linalg.eigh(C[:3, :3])
    return {
        "reference_stamp_ns": str(answer.reference_ns),
        "guess": answer.guess,
        "overlap_ratio": f"{found.overlap_ratio:.4f}",
        "residual_rms_m": f"{found.registration.residual_rms_m:.6f}",
        "iterations": str(found.registration.n_iterations),
        "associations": str(found.registration.n_associations),
        "nearest_rho": f"{found.nearest_rho:.6g}",
        "effective_neighbors": f"{found.effective_neighbors:.3f}",
        "weakest_sigma_m": f"{np.sqrt(values[-1]):.6g}",
        "weakest_direction": " ".join(f"{value:.3f}" for value in vectors[:, -1]),
        "weakest_eigenvalue": f"{np.linalg.eigvalsh(C)[-1]:.6g}",
        **_offset(answer.offset),
    }


def _offset(offset: Array | None) -> dict[str, str]:
    """Return how far ICP would move an external pose."""
    if offset is None:
        return {}
    return {
        "external_offset_m": f"{np.linalg.norm(offset[:3]):.4f}",
        "external_offset_rad": f"{np.linalg.norm(offset[3:]):.5f}",
    }


def _quantiles(name: str, seconds: deque[float]) -> dict[str, str]:
    if not seconds:
        return {}
    p50, p95 = np.percentile(seconds, [50, 95]) * 1e3
    return {f"{name}.p50": f"{p50:.1f}", f"{name}.p95": f"{p95:.1f}"}
