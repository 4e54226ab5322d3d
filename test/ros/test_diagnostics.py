"""What diagnostics say, against the page that documents them."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.config import NodeConfig
from cello3d_ros.covariance.estimator import Estimate
from cello3d_ros.errors import (
    Cello3dError,
    CloudError,
    CovarianceError,
    ModelError,
    RegistrationError,
)
from cello3d_ros.geometry import se3
from cello3d_ros.geometry.gaussian import GaussianPose
from cello3d_ros.registration.icp import Registration
from cello3d_ros.ros.diagnostics import ERROR, OK, WARN, State, Statistics, Verdict, judged
from cello3d_ros.tracking.tracker import Answer

ROOT = Path(__file__).parents[2]
SOURCES = ROOT / "cello3d_ros"
PAGE = (ROOT / "docs" / "diagnostics.md").read_text()
CONFIG = NodeConfig(max_failures=3)


def section(title: str) -> str:
    """A section of the page."""
    return PAGE.split(f"## {title}\n")[1].split("\n## ")[0]


def table(title: str) -> dict[str, str]:
    """First and last columns of the table of a section; a cell may name several keys."""
    rows = re.findall(r"^\| (`.*) \|$", section(title), re.MULTILINE)
    cells = [row.split(" | ") for row in rows]
    return {key: row[-1] for row in cells for key in re.findall(r"`([^`]+)`", row[0])}


def an_estimate(C: np.ndarray, **flags: bool) -> Estimate:
    registration = Registration(se3.exp([1.0, 0, 0, 0, 0, 0]), 7, True, "", 0.02, 900)
    return Estimate(registration, 0.8, C, 0.5, 4.0, "model", **flags)


def answered(statistics: Statistics, C: np.ndarray, **settings) -> None:
    config = NodeConfig(max_failures=3, **settings)
    found = an_estimate(C)
    pose = GaussianPose(np.eye(4), C)
    answer = Answer(2, 1, found, pose, pose, offset=np.zeros(6))
    statistics.answer(answer, C, judged(C, found, config), 0.0, 3)


def said(statistics: Statistics) -> tuple[int, str, dict[str, str]]:
    status = statistics.message("node: registration", 5, CONFIG, State(2, "told to", 1)).status[0]
    return status.level[0], status.message, {item.key: item.value for item in status.values}


@pytest.fixture
def statistics() -> Statistics:
    statistics = Statistics("model.npz")
    statistics.listen(True)
    return statistics


def test_the_page_names_every_key_and_no_other(statistics) -> None:
    before = set(said(statistics)[2])
    answered(statistics, np.eye(6))
    after = set(said(statistics)[2])
    documented = table("Keys")
    assert after == set(documented)
    assert before == {key for key, when in documented.items() if when == "always"}
    assert set(documented.values()) == {
        *("always", "after an answer", "after an external registration")
    }


def errors_of_the_tracker() -> list[type[Cello3dError]]:
    """Every error class with which a pair can end without an answer."""
    found: list[type[Cello3dError]] = [CloudError, RegistrationError, ModelError, CovarianceError]
    for kind in found:
        found += [k for k in kind.__subclasses__() if ".learning." not in k.__module__]
    return found


def reasons() -> set[str]:
    """Every reason that a cloud can be skipped for, as written in the sources."""
    found = {"internal", *(kind.reason for kind in errors_of_the_tracker())}
    files = [
        path for room in ("ros", "tracking", "geometry") for path in (SOURCES / room).glob("*.py")
    ]
    for path in files:
        for node in ast.walk(ast.parse(path.read_text())):
            words: list[ast.AST] = []
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                words = [node.args[1]] if name == "Skip" else words
                words = [node.args[0]] if name == "self._forget" else words
            elif isinstance(node, ast.Subscript) and ast.unparse(node.value) == "self.dropped":
                words = [node.slice]
            elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "reason":
                words = [node.value]  # of an error
            elif isinstance(node, ast.FunctionDef) and node.name == "stamp_order":
                words = list(ast.walk(node))
            found |= {word.value for word in words if isinstance(word, ast.Constant)}
    worker = (SOURCES / "ros" / "worker.py").read_text()
    waited_for = re.search(r'what = "([a-z ]+)" if .* else "([a-z ]+)"', worker)
    assert waited_for
    found |= {f"no_{what.replace(' ', '_')}" for what in waited_for.groups()}  # Intake
    return {name for name in found if re.fullmatch("[a-z_]+", str(name))} - {"later", "jump"}


def test_the_page_names_every_reason_and_no_other() -> None:
    documented = set(table("Reasons"))
    assert len(documented) > 10
    assert reasons() == documented


def test_parameters_on_the_page_are_there() -> None:
    names = set(re.findall(r"`node\.(\w+)`", PAGE))
    assert names
    assert names <= set(NodeConfig.__dataclass_fields__)


def test_every_reason_is_counted_under_its_own_key(statistics) -> None:
    for reason in ("malformed", "no_overlap", "malformed"):
        statistics.fail(1, reason, "why")
    values = said(statistics)[2]
    assert (values["dropped"], values["dropped.malformed"], values["dropped.no_overlap"]) == (
        *("3", "2"),
        "1",
    )


def test_levels_follow_failures_and_recover(statistics) -> None:
    assert said(statistics)[:2] == (WARN, "waiting for clouds and odometry")
    statistics.reference(1)
    assert said(statistics)[0] == OK
    for level in (WARN, WARN, ERROR, ERROR):
        statistics.fail(2, "no_overlap", "too little")
        assert said(statistics)[:2] == (level, "no answer: too little")
    answered(statistics, 1e-6 * np.eye(6))
    assert said(statistics)[:2] == (OK, "answered")
    statistics.listen(False)
    assert said(statistics)[:2] == (OK, "inactive: not listening")


@pytest.mark.parametrize(
    ("sigma_m", "is_unknown", "level", "words"),
    [
        (0.01, False, OK, ["answered"]),
        (0.01, True, WARN, ["out of distribution"]),
        (0.0999, False, OK, ["answered"]),
        (0.1001, False, WARN, ["warn_sigma_m 0.3"]),
        (0.1001, True, WARN, ["warn_sigma_m 0.3", "out of distribution"]),
        (0.3332, False, WARN, ["warn_sigma_m 0.3"]),
        (0.3334, True, ERROR, ["error_sigma_m 1", "out of distribution"]),
    ],
)
def test_three_sigma_along_the_weakest_axis_are_judged(sigma_m, is_unknown, level, words) -> None:
    R = se3.exp([0, 0, 0, 0.3, 0.4, 1.0])[:3, :3]
    C = 1e-6 * np.eye(6)
    C[:3, :3] = R @ np.diag([sigma_m**2, 1e-6, 1e-6]) @ R.T
    verdict = judged(C, an_estimate(C, is_unknown=is_unknown), CONFIG)
    assert verdict.level == level
    assert [word for word in words if word in verdict.sentence] == words
    assert verdict.sentence.count(";") == len(words) - 1


def test_a_registration_that_is_probably_lost_is_told_of() -> None:
    C = 1e-6 * np.eye(6)
    verdict = judged(C, an_estimate(C, is_lost=True, is_unknown=True), CONFIG)
    assert verdict.level == WARN
    assert "probably lost" in verdict.sentence
    assert "out of distribution" in verdict.sentence
    wide = 0.8 * np.eye(6)
    assert judged(wide, an_estimate(wide, is_lost=True), CONFIG).level == ERROR


def test_numbers_are_those_of_the_covariance(statistics) -> None:
    C = np.diag([1e-4, 4e-2, 1e-4, 1e-6, 1e-6, 9e-4])
    answered(statistics, C, warn_sigma_m=5.0, error_sigma_m=6.0)
    level, sentence, values = said(statistics)
    assert (level, sentence) == (OK, "answered")
    assert values["weakest_direction"] == "0.000 1.000 0.000"
    assert float(values["long_axis_3_sigma_m"]) == pytest.approx(0.6)
    assert float(values["weakest_sigma_m"]) == pytest.approx(0.2)
    assert values["weakest_rotation"] == "0.000 0.000 1.000"
    assert float(values["weakest_sigma_rad"]) == pytest.approx(0.03)
    eigenvalues = [float(number) for number in values["eigenvalues"].split()]
    np.testing.assert_allclose(eigenvalues, sorted(np.diag(C), reverse=True))
    assert (values["out_of_distribution"], values["covariance_mode"]) == ("false", "cello3d")
    assert (values["chain_restarts"], values["clock_jumps"]) == ("2", "1")


def test_rates_are_of_the_last_seconds(statistics, monkeypatch) -> None:
    now_s = [100.0]
    monkeypatch.setattr("cello3d_ros.ros.diagnostics.time.monotonic", lambda: now_s[0])
    for _ in range(101):
        now_s[0] += 0.1
        statistics.receive()
    assert float(said(statistics)[2]["rate_hz.received"]) == pytest.approx(10.0, rel=0.02)
    now_s[0] += 2.5
    assert float(said(statistics)[2]["rate_hz.received"]) == pytest.approx(5.0, rel=0.05)
    now_s[0] += 10.0
    assert float(said(statistics)[2]["rate_hz.received"]) == 0.0


def test_a_verdict_is_of_the_last_answer_only(statistics) -> None:
    answered(statistics, np.eye(6))
    assert said(statistics)[0] == ERROR
    answered(statistics, 1e-6 * np.eye(6))
    assert said(statistics)[:2] == Verdict(OK, "answered")


def test_warnings_are_never_ok_and_do_not_hide_what_else_is_wrong(statistics) -> None:
    wrong = State(0, "", 0, ("two lidars on one topic", "no frame_id"))
    answered(statistics, 1e-6 * np.eye(6))
    status = statistics.message("node: registration", 5, CONFIG, wrong).status[0]
    assert (status.level[0], status.message) == (WARN, "two lidars on one topic; no frame_id")
    statistics.fail(7, "no_overlap", "too little in common")
    status = statistics.message("node: registration", 5, CONFIG, wrong).status[0]
    assert (
        status.message == "no answer: too little in common; two lidars on one topic; no frame_id"
    )


def test_an_answer_that_odometry_contradicts_is_never_ok() -> None:
    C = 1e-6 * np.eye(6)
    verdict = judged(C, an_estimate(C), CONFIG, "the registration is 2 m from where odometry led")
    assert (verdict.level, verdict.sentence[:20]) == (WARN, "the registration is ")
