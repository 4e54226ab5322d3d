"""An evaluation and its file: what is read is what was written."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.evaluation.result import (
    Calibration,
    Consistency,
    Distances,
    Evaluation,
    EvaluationError,
    Group,
    Pair,
    Paths,
    Poses,
    ShownPair,
    Trajectory,
    read_evaluation,
    write_evaluation,
)
from cello3d_ros.learning.measures import Figures, Marginal, verdict


def an_evaluation() -> Evaluation:
    figures = Figures(
        n_pairs=2,
        kl_mean=1.5,
        verdict="about right",
        coverage=[0.1, 0.9],
        rotation=Marginal(dm2_over_3=1.0),
    )
    check = {"offset_m": 0.0, "scatter_m": 0.1, "offset_rad": 0.0, "scatter_rad": 0.2}
    counts = dict.fromkeys(("n_runs", "n_failed", "n_lost", "n_told", "n_lost_told"), 1)
    walked = Consistency(**counts, dm_6dof=2.0, without_lost=Distances(error_m=0.1))
    rng = np.random.default_rng(0)
    truth, runs = rng.normal(size=(3, 3)), rng.normal(size=(4, 2, 3))
    paths = Paths(truth=truth, positions=runs, covariances=rng.normal(size=(4, 2, 3, 3)))
    key = {"recording": "walk", "i": 0, "j": 1, "flagged": False}
    shown = ShownPair(
        **key, kl=2.0, dm2_over_6=1.0, T_mean=np.eye(4), covariance=np.eye(6),
        predicted=2 * np.eye(6), xi=rng.normal(size=(5, 6)), kept=np.ones(5),
    )  # fmt: skip
    return Evaluation(
        model="m.npz",
        shape="sandwich",
        settings={"sigma_m": 0.01},
        n_pairs=2,
        methods={"cello3d": figures},
        recordings={"walk": Group(n_pairs=2, methods={"cello3d": figures}, trained_on=True)},
        with_flagged_pairs=None,
        pose_check={"walk": Poses(n_pairs=2, **check, n_flagged=1, flagged=[[0, 1]])},
        calibration=Calibration(probabilities=[0.5], dm2={"cello3d": [5.3]}),
        pairs=[Pair(**key, **check, kl={"cello3d": 2.0}, dm2_over_6={"cello3d": 1.0})],
        worst_pairs=[shown],
        trajectories={"walk": Trajectory(**vars(walked), length_m=2.0, paths=paths)},
    )


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    ours = an_evaluation()
    write_evaluation(ours, tmp_path / "e.json")
    theirs = read_evaluation(tmp_path / "e.json")
    empty = {"worst_pairs": [], "trajectories": {}}
    assert dataclasses.replace(theirs, **empty) == dataclasses.replace(ours, **empty)
    for a, b in (
        (ours.worst_pairs[0], theirs.worst_pairs[0]),
        (ours.trajectories["walk"].paths, theirs.trajectories["walk"].paths),
    ):
        for name, value in vars(a).items():
            np.testing.assert_array_equal(getattr(b, name), value)
    assert theirs.trajectories["walk"].without_lost == Distances(error_m=0.1)


def test_numbers_that_json_does_not_have_are_not_written(tmp_path: Path) -> None:
    spoiled = dataclasses.replace(an_evaluation(), settings={"sigma_m": np.nan})
    with pytest.raises(ValueError, match="JSON"):
        write_evaluation(spoiled, tmp_path / "e.json")
    assert list(tmp_path.iterdir()) == []


def test_an_array_of_another_size_is_damage(tmp_path: Path) -> None:
    write_evaluation(an_evaluation(), tmp_path / "e.json")
    text = (tmp_path / "e.json").read_text().replace('"kept": [\n    1.0,', '"kept": [')
    (tmp_path / "e.json").write_text(text)
    with pytest.raises(EvaluationError, match=r"damaged: 'xi' has shape \(5, 6\), not \(4, 6\)"):
        read_evaluation(tmp_path / "e.json")


@pytest.mark.parametrize(
    ("ratio", "words"),
    [
        (2.2, "too small: multiply by 2.2"),
        (0.45, "too large: multiply by 0.45"),
        (1.3, "about right"),
        (0.8, "about right"),
    ],
)
def test_a_verdict_is_in_words_with_the_factor(ratio: float, words: str) -> None:
    assert verdict(ratio) == words
