"""What the node has seen, as diagnostic_msgs/DiagnosticArray; every key: docs/diagnostics.md."""

from __future__ import annotations

import time
from collections import Counter, deque
from typing import NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from cello3d_ros.config import NodeConfig
from cello3d_ros.covariance.estimator import Estimate
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.ros.messages import time_of
from cello3d_ros.tracking.covariances import N_SIGMA, principal_axes
from cello3d_ros.tracking.tracker import Answer

ANSWERED, REFERENCE, WAITING, INACTIVE = "answered", "reference", "waiting", "inactive"
OK, WARN, ERROR = 0, 1, 2

_WINDOW = 200  # latencies remembered
_RATE_WINDOW_S = 5.0
_LEVELS: tuple[bytes, ...] = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR)


class Verdict(NamedTuple):
    """How far an answer is to be trusted: OK, WARN or ERROR, and why in one sentence."""

    level: int
    sentence: str


class State(NamedTuple):
    """What a node says of itself beside its clouds: restarts of the chain, jumps, warnings."""

    n_restarts: int
    last_restart: str
    n_clock_jumps: int
    warnings: tuple[str, ...] = ()


def judged(C: Array, found: Estimate, config: NodeConfig, disagreement: str = "") -> Verdict:
    """Judge an answer by its covariance (6, 6), as published, the model and the odometry.

    disagreement: why odometry contradicts it, or "".
    """
    longest_m = N_SIGMA * float(principal_axes(C[:3, :3])[0][0])
    level, reasons = OK, []
    for worse, name in ((WARN, "warn_sigma_m"), (ERROR, "error_sigma_m")):
        if longest_m > (limit_m := getattr(config, name)):
            level = worse
            reasons = [f"3 sigma are {longest_m:.3g} m, more than node.{name} {limit_m:g}"]
    if found.is_lost:
        level = max(level, WARN)
        reasons.append("probably lost: the scans fit badly, and the pose may be off by a metre")
    if disagreement:
        level = max(level, WARN)
        reasons.append(disagreement)
    if found.is_unknown:
        level = max(level, WARN)
        reasons.append("out of distribution: the model has seen no pair like this one")
    return Verdict(level, "; ".join(reasons) or "answered")


class Statistics:
    """Counts since the start, latencies of the last answers and the last answer itself."""

    def __init__(self, model_name: str) -> None:
        self._model_name = model_name
        self.counts: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self._latencies_s: deque[float] = deque(maxlen=_WINDOW)
        self._ages_s: deque[float] = deque(maxlen=_WINDOW)
        self._received_s: deque[float] = deque(maxlen=_WINDOW)
        self._answered_s: deque[float] = deque(maxlen=_WINDOW)
        self._last_event, self._last_stamp_ns = INACTIVE, 0
        self._last_failure = ""
        self._n_failed_in_a_row = 0
        self._verdict = Verdict(OK, "answered")
        self._answer: dict[str, str] = {}

    @property
    def is_waiting(self) -> bool:
        """Whether the node listens and no cloud has met its fate yet."""
        return self._last_event == WAITING

    def listen(self, is_listening: bool) -> None:
        """Note that the node has begun, or ceased, to listen."""
        self._last_event, self._last_stamp_ns = WAITING if is_listening else INACTIVE, 0
        self._n_failed_in_a_row = 0

    def receive(self, n_unheard: int = 0) -> None:
        """Count a cloud that came, and those before it that came but could not be heard."""
        self.counts["received"] += 1 + n_unheard
        if n_unheard:
            self.dropped["unheard"] += n_unheard
        self._received_s.extend([time.monotonic()] * (1 + n_unheard))

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

    def answer(
        self, answer: Answer, C: Array, verdict: Verdict, received_s: float, now_ns: int
    ) -> None:
        """Count an answer.  C: (6, 6), as published; received_s: time.monotonic() of the cloud."""
        self.counts["answered"] += 1
        self._last_event, self._last_stamp_ns = ANSWERED, answer.stamp_ns
        self._n_failed_in_a_row = 0
        self._verdict = verdict
        self._answered_s.append(now_s := time.monotonic())
        self._latencies_s.append(now_s - received_s)
        self._ages_s.append(1e-9 * (now_ns - answer.stamp_ns))
        self._answer = _described(answer, C)

    def message(self, name: str, now_ns: int, config: NodeConfig, state: State) -> DiagnosticArray:
        """Return the message of now: level, one sentence, keys and values."""
        verdict = self._judged(config.max_failures)
        if state.warnings:
            said = [] if verdict.level == OK else [verdict.sentence]
            verdict = Verdict(max(verdict.level, WARN), "; ".join([*said, *state.warnings]))
        status = DiagnosticStatus(
            name=name, level=_LEVELS[verdict.level], message=verdict.sentence
        )
        values = {
            "last_event": self._last_event,
            "last_stamp_ns": str(self._last_stamp_ns),
            "last_failure": self._last_failure,
            "received": str(self.counts["received"]),
            "answered": str(self.counts["answered"]),
            "references": str(self.counts["references"]),
            "dropped": str(sum(self.dropped.values())),
            **{f"dropped.{reason}": str(n) for reason, n in sorted(self.dropped.items())},
            "odometry_received": str(self.counts["odometry"]),
            "odometry_rejected": str(self.counts["odometry_rejected"]),
            "clock_jumps": str(state.n_clock_jumps),
            "chain_restarts": str(state.n_restarts),
            "last_restart": state.last_restart,
            "warnings": "; ".join(state.warnings),
            "model": self._model_name,
            "covariance_mode": config.covariance_mode,
            "rate_hz.received": f"{_rate_hz(self._received_s):.2f}",
            "rate_hz.answered": f"{_rate_hz(self._answered_s):.2f}",
            **_quantiles("latency_ms", self._latencies_s),
            **_quantiles("age_ms", self._ages_s),
            **self._answer,
        }
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = time_of(now_ns)
        return message

    def _judged(self, n_serious_failures: int) -> Verdict:
        if self._n_failed_in_a_row:
            is_serious = self._n_failed_in_a_row >= n_serious_failures
            return Verdict(ERROR if is_serious else WARN, f"no answer: {self._last_failure}")
        if self._last_event == WAITING:
            has_odometry = self.counts["odometry"] > self.counts["odometry_rejected"]
            return Verdict(WARN, f"waiting for clouds{'' if has_odometry else ' and odometry'}")
        if self._last_event == INACTIVE:
            return Verdict(OK, "inactive: not listening")
        if self._last_event == REFERENCE:
            return Verdict(OK, "the next cloud is registered to this one")
        return self._verdict


def _described(answer: Answer, C: Array) -> dict[str, str]:
    """Return the last answer in words; directions are those of the largest variance."""
    found = answer.estimate
    (sigma_m, axes), (sigma_rad, turns) = principal_axes(C[:3, :3]), principal_axes(C[3:, 3:])
    eigenvalues = np.asarray(np.linalg.eigvalsh(C)[::-1], dtype=np.float64)
    return {
        "reference_stamp_ns": str(answer.reference_ns),
        "guess": answer.guess,
        "deskewed": answer.deskewed,
        "overlap_ratio": f"{found.overlap_ratio:.4f}",
        "residual_rms_m": f"{found.registration.residual_rms_m:.6f}",
        "iterations": str(found.registration.n_iterations),
        "associations": str(found.registration.n_associations),
        "nearest_rho": f"{found.nearest_rho:.6g}",
        "novelty": f"{found.novelty:.3f}",
        "effective_neighbors": f"{found.effective_neighbors:.3f}",
        "out_of_distribution": str(found.is_unknown).lower(),
        "probably_lost": str(found.is_lost).lower(),
        "long_axis_3_sigma_m": f"{N_SIGMA * sigma_m[0]:.6g}",
        "weakest_sigma_m": f"{sigma_m[0]:.6g}",
        "weakest_direction": _numbers(axes[:, 0], "{:.3f}"),
        "weakest_sigma_rad": f"{sigma_rad[0]:.6g}",
        "weakest_rotation": _numbers(turns[:, 0], "{:.3f}"),
        "weakest_eigenvalue": f"{eigenvalues[0]:.6g}",
        "eigenvalues": _numbers(eigenvalues, "{:.4g}"),
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


def _numbers(values: Array, form: str) -> str:
    return " ".join(form.format(value) for value in values)


def _quantiles(name: str, seconds: deque[float]) -> dict[str, str]:
    if not seconds:
        return {}
    p50, p95 = np.percentile(seconds, [50, 95]) * 1e3
    return {f"{name}.p50": f"{p50:.1f}", f"{name}.p95": f"{p95:.1f}"}


def _rate_hz(times_s: deque[float]) -> float:
    """Return events per second over the last ones and the time since, at most 5 s."""
    now_s = time.monotonic()
    recent = [t for t in times_s if now_s - t <= _RATE_WINDOW_S]
    return (len(recent) - 1) / (now_s - recent[0]) if len(recent) > 1 else 0.0
