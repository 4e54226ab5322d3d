"""The figures on small scenes: their laws hold with few samples."""

from __future__ import annotations

import numpy as np
import pytest

from cello3d_ros.config import IcpConfig
from cello3d_ros.geometry.se3 import exp
from cello3d_ros.registration.icp import icp
from cello3d_ros.reproduction import cylinder, hallway, noise, objective
from cello3d_ros.reproduction.drawing import contour
from cello3d_ros.reproduction.scenes import cube


def test_the_objective_is_what_icp_minimises() -> None:
    rng = np.random.default_rng(0)
    reading, reference = cube(rng, 400, 0.01), cube(rng, 400, 0.01)
    shift = np.array([0.03, -0.02, 0.01])
    one_step = IcpConfig(max_iterations=1, n_smoothed=1)
    found = icp(
        reading.points, reference.points, reference.normals, exp([*shift, 0, 0, 0]), one_step
    )
    J = objective.objective(reading.points + shift, reference, one_step)
    assert np.sqrt(J) == pytest.approx(found.residual_rms_m, rel=1e-9)


def test_the_objective_is_a_basin_from_afar_and_plateaus_from_near(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(objective, "_N_GRID", 21)
    result = objective.make(12, 1, 0)
    wide, _, near = (np.array(J) for J in result.data["objective_m2"])
    middle = wide[10, 10]
    assert middle < 0.05 * wide[[0, 0, -1, -1], [0, -1, 0, -1]].min()
    steps = np.abs(np.diff(near, axis=1)).ravel()
    assert np.median(steps) < 0.02 * steps.max()  # flat, but for the borders
    assert 10 <= result.data["n_samples"] <= 12


def test_the_upside_down_ring_goes_and_the_free_axis_stays() -> None:
    result = cylinder.make(700, 2, 0)
    assert result.data["n_upside_down"] > 20
    assert result.data["n_upside_down_kept"] == 0
    spread = np.sqrt(np.diag(result.data["covariance"]))
    assert spread[5] > 0.2
    assert max(spread[3:5]) < 0.01
    assert len(result.rows) == 1 + result.data["n_samples"]


def test_registrations_lock_on_to_the_next_pillars() -> None:
    data = hallway.make(300, 2, 0).data
    share = data["share_at_pillar"]
    assert share["0"] > share["1"] > 0.05
    assert share["-1"] > 0.05
    assert share["0"] + share["1"] + share["-1"] > 0.95
    assert data["cosine_leading_axis_hallway"] > 0.99
    assert np.array(data["covariance_all"])[0, 0] > 100 * np.array(data["covariance_kept"])[0, 0]


def test_sampled_covariance_and_censi_grow_with_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex")
    monkeypatch.setattr(noise, "SIGMAS_M", (0.005, 0.05))
    result = noise.make(50, 2, 0)
    found = {(r["scene"], r["sigma_m"], r["block"]): r for r in result.data["rows"]}
    for scene in ("cube", "apartment"):
        low, high = found[scene, 0.005, "u_m2"], found[scene, 0.05, "u_m2"]
        assert high["sampled"] > 5.0 * low["sampled"]
        assert high["censi"] == pytest.approx(100.0 * low["censi"], rel=0.5)


def test_the_contour_has_the_distance_that_is_asked_for() -> None:
    C = np.array([[2.0, 0.5], [0.5, 1.0]])
    off = contour((1.0, -2.0), C, 3.0) - np.array([[1.0], [-2.0]])
    np.testing.assert_allclose(np.sum(off * np.linalg.solve(C, off), axis=0), 9.0)
