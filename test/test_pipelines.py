"""The named pipelines: what they hold, how a file or an option names one, what is warned of."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cello3d_ros.config import (
    PIPELINES,
    Config,
    IcpConfig,
    config_from,
    differences,
    load_config,
    pipeline_name,
    pipeline_of,
    pipeline_warning,
)
from cello3d_ros.covariance.estimator import Estimator
from cello3d_ros.covariance.model import constant_model, load_model, save_model
from cello3d_ros.errors import ConfigError

ROBOT, PAPER = PIPELINES["robot"], PIPELINES["paper"]


def test_paper_is_table_1_and_robot_takes_the_whole_reference() -> None:
    assert (PAPER.icp.n_reference_points, PAPER.icp.n_reading_points) == (10_000, 2_000)
    assert (PAPER.icp.n_neighbors, PAPER.icp.trim_ratio) == (3, 0.7)
    assert (PAPER.cloud.n_neighbors, PAPER.cloud.min_spread) == (20, 0.0)
    assert ROBOT.icp.n_reference_points == 0
    assert pipeline_of(Config()) == ROBOT


@pytest.mark.parametrize("name", PIPELINES)
def test_a_file_names_the_pipeline_and_its_sections_win(tmp_path: Path, name: str) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text(f"pipeline: {name}\nicp: {{trim_ratio: 0.8}}\n")
    expected = replace(PIPELINES[name], icp=replace(PIPELINES[name].icp, trim_ratio=0.8))
    assert pipeline_of(load_config(file)) == expected
    below = tmp_path / "ros.yaml"
    below.write_text(f"/**: {{ros__parameters: {{pipeline: {name}, icp: {{trim_ratio: 0.8}}}}}}")
    assert pipeline_of(load_config(below)) == expected
    other = load_config(file, "paper")
    assert pipeline_of(other) == replace(PAPER, icp=replace(PAPER.icp, trim_ratio=0.8))


def test_a_name_that_is_no_pipeline_is_refused() -> None:
    with pytest.raises(ConfigError, match="must be one of robot, paper: 'fast'"):
        config_from({"pipeline": "fast"})
    with pytest.raises(ConfigError, match="must be one of robot, paper"):
        config_from({"pipeline": {"icp": 1}})


@pytest.mark.parametrize("name", PIPELINES)
def test_a_model_knows_by_name_what_it_was_trained_with(tmp_path: Path, name: str) -> None:
    save_model(constant_model(np.eye(6), 3, pipeline=PIPELINES[name]), tmp_path / "m.npz")
    model = load_model(tmp_path / "m.npz")
    assert differences(model.pipeline, PIPELINES[name]) == []
    assert pipeline_name(model.pipeline) == name
    changed = replace(model.pipeline, icp=replace(model.pipeline.icp, max_iterations=7))
    assert pipeline_name(changed) == f"{name}, changed"


def test_one_warning_names_both_pipelines_and_what_differs(
    caplog: pytest.LogCaptureFixture,
) -> None:
    model = constant_model(np.eye(6), 3, pipeline=PAPER)
    with caplog.at_level(logging.WARNING, "cello3d_ros"):
        Estimator(model)
        assert not caplog.records
        for _ in range(2):
            Estimator(model, pipeline=ROBOT)
    (record,) = caplog.records
    told = record.getMessage()
    assert told == pipeline_warning(PAPER, ROBOT)
    assert told.startswith("the model was trained with the pipeline paper, this is robot: ")
    assert "icp.n_reading_points is 5000, not 2000" in told
    assert pipeline_warning(ROBOT, Config(icp=IcpConfig())) == ""
