import json
import subprocess
import sys

import numpy as np
import pytest

from cello3d_ros.cli.main import VERBS, main
from cello3d_ros.config import IcpConfig, Pipeline
from cello3d_ros.covariance.model import constant_model, save_model
from cello3d_ros.geometry.se3 import exp, inverse, transform

T_TRUE = exp([0.3, -0.2, 0.05, 0.0, 0.02, 0.15])


@pytest.fixture
def files(tmp_path, room):
    """Reading, reference, first guess and model, as files."""
    np.save(tmp_path / "reading.npy", transform(inverse(T_TRUE), room[0]))
    header, rows = "intensity,x,y,z", np.column_stack([np.zeros(len(room[1])), room[1]])
    np.savetxt(tmp_path / "reference.csv", rows, delimiter=",", header=header, comments="")
    np.savetxt(tmp_path / "init.txt", T_TRUE @ exp([0.05, 0, 0, 0, 0, 0.03]))
    save_model(constant_model(3.0 * np.eye(6), 704, shape="sandwich"), tmp_path / "model.npz")
    return [
        str(tmp_path / "reading.npy"),
        str(tmp_path / "reference.csv"),
        "--init",
        str(tmp_path / "init.txt"),
        "--model",
        str(tmp_path / "model.npz"),
    ]


def test_estimate_prints_the_pose_and_both_covariances(files, capsys):
    assert main(["estimate", *files, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    T = np.reshape(answer["T_ref_read"], (4, 4))
    np.testing.assert_allclose(T, T_TRUE, atol=0.03)
    Y = np.reshape(answer["covariance"], (6, 6))
    C = np.reshape(answer["covariance_ros"], (6, 6))
    R = T[:3, :3]
    np.testing.assert_allclose(C[:3, :3], R @ Y[:3, :3] @ R.T, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(C[3:, 3:], R @ Y[3:, 3:] @ R.T, rtol=1e-9, atol=1e-18)
    assert (np.linalg.eigvalsh(C) > 0).all()
    assert answer["trust"]["converged"] is True
    assert answer["registration"]["n_iterations"] > 0
    assert 0.5 < answer["trust"]["overlap"] <= 1.0
    assert answer["nearest_rho"] >= 0.0
    assert answer["effective_neighbors"] == 1.0


def test_estimate_is_by_the_method_that_is_named(files, capsys):
    sizes = {}
    for method in ("cello3d", "hessian", "fused"):
        assert main(["estimate", *files, "--json", "--method", method]) == 0
        answer = json.loads(capsys.readouterr().out)
        assert answer["method"] == method
        assert 0.0 <= answer["trust"]["novelty"] <= 1.0
        sizes[method] = np.trace(np.reshape(answer["covariance"], (6, 6)))
    assert len(set(sizes.values())) == 3


def test_a_registration_that_did_not_converge_is_an_error(files, capsys, tmp_path):
    hasty = Pipeline(icp=IcpConfig(max_iterations=1))
    model = constant_model(3.0 * np.eye(6), 704, shape="sandwich", pipeline=hasty)
    save_model(model, tmp_path / "model.npz")
    assert main(["estimate", *files]) == 1
    output = capsys.readouterr()
    assert output.out == ""
    assert "ICP did not converge in 1 iterations" in output.err


def test_estimate_is_readable_and_repeats_itself(files, capsys):
    assert main(["estimate", *files]) == 0
    first = capsys.readouterr().out
    assert main(["estimate", *files]) == 0
    assert capsys.readouterr().out == first
    assert "ICP converged after" in first


def test_the_clouds_may_swap_roles(files, capsys, tmp_path):
    np.savetxt(tmp_path / "back.txt", inverse(T_TRUE))
    swapped = [files[1], files[0], "--init", str(tmp_path / "back.txt"), *files[4:], "--json"]
    assert main(["estimate", *swapped]) == 0
    T = np.reshape(json.loads(capsys.readouterr().out)["T_ref_read"], (4, 4))
    np.testing.assert_allclose(T, inverse(T_TRUE), atol=0.03)


@pytest.mark.parametrize(
    ("position", "content", "words"),
    [
        (0, None, "reading"),
        (1, "x,y\n1,2\n", "reference"),
        (3, "1 2 3\n", "16 or 12"),
        (3, "2 0 0 0 0 1 0 0 0 0 1 0\n", "not a rigid pose"),
        (3, "one two\n", "cannot read the pose"),
        (5, "not a model", "model"),
    ],
)
def test_a_file_that_is_missing_or_wrong_is_one_sentence(files, capsys, position, content, words):
    from pathlib import Path

    path = Path(files[position])
    path.unlink() if content is None else path.write_text(content)
    assert main(["estimate", *files]) == 1
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith("cello3d: ")
    assert output.err.count("\n") == 1
    assert words in output.err


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((100, 3), np.nan), np.eye(3)])
def test_clouds_with_too_few_points_are_one_sentence(files, capsys, points):
    np.save(files[0], points)
    assert main(["estimate", *files]) == 1
    error = capsys.readouterr().err
    assert "reading" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("argv", [[], ["nonsense"], ["estimate"], ["info", "--nonsense"]])
def test_wrong_usage_exits_with_2(argv, capsys):
    with pytest.raises(SystemExit) as stop:
        main(argv)
    assert stop.value.code == 2


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help(verb, capsys):
    with pytest.raises(SystemExit) as stop:
        main([verb, "--help"])
    assert stop.value.code == 0
    assert verb in capsys.readouterr().out


def test_ctrl_c_is_130_and_one_line(monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("cello3d_ros.cli.info.describe", interrupted)
    assert main(["info", "x"]) == 130
    assert capsys.readouterr().err == "cello3d: interrupted\n"


def test_an_interrupt_within_a_compiled_function_is_an_interrupt(monkeypatch, capsys):
    """The interpreter raises a SystemError for it, and another where it passes a second one."""
    from cello3d_ros.cli import info

    def interrupted(_):
        try:
            raise SystemError("returned a result with an exception set") from KeyboardInterrupt()
        except SystemError as error:
            raise SystemError("returned a result with an exception set") from error

    monkeypatch.setattr(info, "run", interrupted)
    assert main(["info", "general"]) == 130
    assert capsys.readouterr().err == "cello3d: interrupted\n"
    monkeypatch.setattr(info, "run", lambda _: (_ for _ in ()).throw(SystemError("another")))
    with pytest.raises(SystemError, match="another"):
        main(["info", "general"])


def test_a_full_disk_under_the_output_is_one_sentence(tmp_path) -> None:
    code = "from cello3d_ros.cli.main import main\nraise SystemExit(main())"
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code, "info", "general"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr == "cello3d: cannot write the output: No space left on device\n"
