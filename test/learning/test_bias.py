"""The bias that steps share is found again in examples drawn with one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cello3d_ros.geometry.gaussian import INDEPENDENT, Bias
from cello3d_ros.geometry.se3 import exp
from cello3d_ros.learning.bias import measured_bias
from cello3d_ros.learning.examples import Examples
from cello3d_ros.learning.measures import select

STEP_M = 0.5


def walks(bias: Bias, n_recordings: int = 12, n_steps: int = 40, n_samples: int = 20) -> Examples:
    """Return consecutive pairs whose errors ``L (sqrt(s) b + sqrt(1 - s) n)`` share a bias b.

    A fifth of what is not shared is the same in all registrations of a pair.
    """
    rng, T = np.random.default_rng(0), exp([STEP_M, 0, 0, 0, 0, 0])
    kept, shapes, xi = bias.kept(T), [], []
    for _ in range(n_recordings):
        b = rng.normal(size=6)
        for _ in range(n_steps):
            A = 0.01 * rng.normal(size=(6, 12))
            L, own = np.linalg.cholesky(A @ A.T), np.sqrt(0.2) * rng.normal(size=6)
            noise = own + np.sqrt(0.8) * rng.normal(size=(n_samples, 6))
            xi.append((np.sqrt(bias.share) * b + np.sqrt(1 - bias.share) * noise) @ L.T)
            shapes.append(L @ L.T)
            b = kept * b + np.sqrt(1 - kept**2) * rng.normal(size=6)
    n = n_recordings * n_steps
    numbers = np.tile(np.arange(n_steps), n_recordings)
    return Examples(
        features=np.zeros((n, 1, 1)),
        covariances=np.array(shapes),
        motions=np.zeros((n, 2)),
        groups=np.repeat([f"walk{k:02}" for k in range(n_recordings)], n_steps),
        shapes={"sandwich": np.array(shapes)},
        rotations_rad=np.zeros(1),
        scans=np.stack([numbers, numbers + 1], axis=1),
        T_mean=np.tile(T, (n, 1, 1)),
        xi=tuple(xi),
    )


def found_in(examples: Examples) -> Bias:
    """Return the bias that is measured where predictions are what errors were drawn from."""
    return measured_bias(examples, examples.covariances)


@pytest.mark.parametrize("bias", [Bias(0.2, 16.0), Bias(0.5, 2.0), Bias(0.8, 4.0)])
def test_the_bias_that_examples_were_drawn_with_is_found(bias: Bias) -> None:
    found = found_in(walks(bias))
    assert found.share == pytest.approx(bias.share, abs=0.1)
    assert bias.way_m / 2 <= found.way_m <= 2 * bias.way_m


def test_steps_that_share_nothing_have_no_bias() -> None:
    assert found_in(walks(INDEPENDENT)).share < 0.03


def test_the_order_of_pairs_and_those_of_larger_gaps_do_not_matter() -> None:
    examples = walks(Bias(0.5, 4.0))
    expected = found_in(examples)
    order = np.random.default_rng(1).permutation(len(examples.groups))
    assert found_in(select(examples, order)) == expected
    every, far = np.arange(len(examples.groups)), np.arange(0, len(examples.groups), 7)
    both = select(examples, np.concatenate([every, far]))
    scans = both.scans.copy()
    scans[len(every) :, 1] += 1
    assert found_in(dataclasses.replace(both, scans=scans)) == expected


def test_steps_on_two_sides_of_a_missing_one_or_of_two_recordings_tell_nothing() -> None:
    """With every second step missing no two are known to be a way apart."""
    examples = walks(Bias(0.5, 4.0))
    second = np.flatnonzero(examples.scans[:, 0] % 2 == 0)
    assert found_in(select(examples, second)) == Bias()
    first = np.flatnonzero(examples.scans[:, 0] == 0)
    assert found_in(select(examples, first)) == Bias()


def test_an_enormous_error_decides_nothing() -> None:
    examples = walks(Bias(0.5, 4.0))
    expected = found_in(examples)
    xi = list(examples.xi)
    xi[100] = 1e3 * xi[100]
    found = found_in(dataclasses.replace(examples, xi=tuple(xi)))
    assert found.share == pytest.approx(expected.share, abs=0.02)
    assert found.way_m == expected.way_m


def test_steps_of_uneven_length_are_as_far_apart_as_the_later_ones_are_long() -> None:
    """The first step of a recording is long, and does not count."""
    examples = walks(Bias(0.5, 4.0))
    T = examples.T_mean.copy()
    T[examples.scans[:, 0] == 0] = exp([500.0, 0, 0, 0, 0, 0])
    expected = found_in(examples)
    assert found_in(dataclasses.replace(examples, T_mean=T)) == expected


def test_steps_of_one_recording_do_not_go_on_in_another() -> None:
    """All that is shared is between recordings: their steps are numbered one after the other."""
    examples = walks(Bias(0.5, 4.0), n_recordings=2)
    groups = np.array([f"walk{k}" for k in range(len(examples.groups))])
    assert found_in(dataclasses.replace(examples, groups=groups)) == Bias()


def test_no_pairs_have_the_default() -> None:
    examples = walks(Bias(0.5, 4.0))
    assert found_in(select(examples, np.zeros(0, int))) == Bias()
    assert found_in(dataclasses.replace(examples, xi=())) == Bias()
