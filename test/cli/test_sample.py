"""The offline tools in a row: sample two recordings, train on them, use the model."""

import contextlib
import io
import json
import os
import resource
import signal
import subprocess
import sys

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from cello3d_ros.cli.main import main
from cello3d_ros.geometry.se3 import exp, inverse, transform
from cello3d_ros.learning.dataset import open_dataset
from cello3d_ros.recordings import Scan
from cello3d_ros.recordings.bag_writer import write_bag

CONFIG = """
cloud: {voxel_m: 0.1}
icp: {n_reading_points: 400, n_reference_points: 1500}
sampling: {n_samples: 50, variance: 0.01, max_gap: 2, n_rotations: 2}
training: {max_iterations: 5, rank: 2}
"""


def write_kitti(folder, seed, n_scans=4):
    """Write a KITTI folder: a furnished room seen from a short path."""
    rng = np.random.default_rng(seed)
    half = rng.uniform([3, 2, 1.2], [5, 4, 1.8])
    points = rng.uniform(-1, 1, (6000, 3)) * half
    face = rng.integers(3, size=len(points))
    points[np.arange(len(points)), face] = (rng.choice([-1, 1], len(points)) * half[face]).copy()
    velodyne = folder / "velodyne"
    velodyne.mkdir(parents=True)
    rows = []
    for k in range(n_scans):
        T = exp([0.2 * k, 0.1 * k, 0, 0, 0, 0.1 * k])
        seen = transform(inverse(T), points + rng.normal(scale=0.01, size=points.shape))
        scan = np.column_stack([seen, np.zeros(len(seen))]).astype("<f4")
        scan.tofile(velodyne / f"{k:06d}.bin")
        rows.append(T[:3].ravel())
    np.savetxt(folder / "poses.txt", rows)
    return str(folder)


@pytest.fixture
def recordings(tmp_path):
    (tmp_path / "config.yaml").write_text(CONFIG)
    return [write_kitti(tmp_path / name, seed) for seed, name in enumerate(("one", "two"))]


def sample(tmp_path, recordings, *flags):
    return main(
        [
            "sample",
            *recordings,
            "--out",
            str(tmp_path / "dataset"),
            "--config",
            str(tmp_path / "config.yaml"),
            "--jobs",
            "2",
            *flags,
        ]
    )


def contents(tmp_path):
    return {p.name: p.read_bytes() for p in (tmp_path / "dataset" / "pairs").iterdir()}


def test_what_is_missing_or_damaged_is_sampled_again_and_nothing_else(
    tmp_path, recordings, capsys
):
    assert sample(tmp_path, recordings) == 0
    assert "10 pairs accepted, 0 rejected" in capsys.readouterr().out
    before = contents(tmp_path)
    assert sorted(before)[0] == "one_0_1.npz"
    kept = tmp_path / "dataset" / "pairs" / "two_0_2.npz"
    inode = kept.stat().st_ino
    (tmp_path / "dataset" / "pairs" / "one_0_1.npz").unlink()
    damaged = tmp_path / "dataset" / "pairs" / "two_1_3.npz"
    damaged.write_bytes(before["two_1_3.npz"][:-100])
    assert sample(tmp_path, recordings) == 0
    assert contents(tmp_path) == before
    assert kept.stat().st_ino == inode


def test_other_settings_in_the_same_folder_are_refused(tmp_path, recordings, capsys):
    assert sample(tmp_path, recordings[:1]) == 0
    assert sample(tmp_path, recordings[:1], "--seed", "7") == 1
    assert "sampling.seed is 0, here 7" in capsys.readouterr().err


def test_a_setting_out_of_range_is_one_sentence(tmp_path, recordings, capsys):
    assert sample(tmp_path, recordings, "--variance", "-1") == 1
    error = capsys.readouterr().err
    assert "variance must be in [0, 10]: -1.0" in error
    assert error.count("\n") == 1


def test_a_missing_recording_is_one_sentence(tmp_path, recordings, capsys):
    assert sample(tmp_path, [str(tmp_path / "nowhere")]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "dataset").exists()


def test_a_model_trained_on_samples_estimates(tmp_path, recordings, capsys):
    assert sample(tmp_path, recordings) == 0
    model = str(tmp_path / "model.npz")
    config = str(tmp_path / "config.yaml")
    dataset = str(tmp_path / "dataset")
    assert main(["train", dataset, "--out", model, "--config", config]) == 0
    capsys.readouterr()
    scans = [f"{recordings[0]}/velodyne/00000{k}.bin" for k in (1, 0)]
    assert main(["estimate", *scans, "--model", model, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    Y = np.reshape(answer["covariance"], (6, 6))
    assert (np.linalg.eigvalsh(Y) > 0).all()
    assert 1e-4 < np.sqrt(Y[0, 0]) < 0.1
    np.testing.assert_allclose(
        np.reshape(answer["T_ref_read"], (4, 4)), exp([0.2, 0.1, 0, 0, 0, 0.1]), atol=0.05
    )


def started(tmp_path, recordings, out, *flags):
    """Start the real command as a process of its own."""
    command = [sys.executable, "-m", "cello3d_ros.cli.main", "sample", *recordings]
    options = ["--out", str(out), "--config", str(tmp_path / "config.yaml"), "--jobs", "1"]
    return subprocess.Popen(
        [*command, *options, *flags],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        preexec_fn=_hear_interrupts,
    )


def _hear_interrupts():
    """Undo what a shell does to jobs in its background: to ignore SIGINT is inherited."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def files(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    }


def test_killed_at_random_moments_the_dataset_is_that_of_an_undisturbed_run(tmp_path):
    """kill -9, five times: after some pairs were written, a random part of a pair later."""
    (tmp_path / "config.yaml").write_text(CONFIG.replace("n_samples: 50", "n_samples: 200"))
    recordings = [write_kitti(tmp_path / "long", 0, n_scans=8)]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert started(tmp_path, recordings, whole).wait(120) == 0
    rng = np.random.default_rng(1)
    n_killed = 0
    for _ in range(5):
        before = set(files(cut))
        process = started(tmp_path, recordings, cut)
        n_more, delay_s = rng.integers(0, 3), rng.uniform(0.0, 0.3)
        while process.poll() is None and len(set(files(cut)) - before) < n_more:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.002)
        with contextlib.suppress(subprocess.TimeoutExpired):  # the random moment
            process.wait(delay_s)
        process.kill()
        process.communicate()
        n_killed += process.returncode == -signal.SIGKILL
        done = files(cut)
        assert all(done[name] == content for name, content in files(whole).items() if name in done)
        assert len(done) < len(files(whole))
    assert n_killed == 5
    assert started(tmp_path, recordings, cut).wait(120) == 0
    assert files(cut) == files(whole)
    assert [path.name for path in cut.rglob(".*")] == []


def test_ctrl_c_ends_with_130_and_keeps_what_is_done(tmp_path, recordings):
    process = started(tmp_path, recordings, tmp_path / "dataset", "--samples", "3000")
    while process.poll() is None and not contents_or_none(tmp_path):
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.01)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert (process.returncode, error.decode()) == (130, "cello3d: interrupted\n")
    assert 1 <= len(contents(tmp_path)) < 10


def contents_or_none(tmp_path):
    folder = tmp_path / "dataset" / "pairs"
    return folder.is_dir() and any(p.suffix == ".npz" for p in folder.iterdir())


def test_adaptive_sampling_says_so_in_the_manifest_and_resumes(tmp_path, recordings, capsys):
    flags = ["--samples", "adaptive", "--precision", "0.5"]
    assert sample(tmp_path, recordings[:1], *flags) == 0
    settings = json.loads((tmp_path / "dataset" / "manifest.json").read_text())["configuration"]
    assert (settings["sampling"]["precision"], settings["sampling"]["n_samples"]) == (0.5, 50)
    before = contents(tmp_path)
    assert sample(tmp_path, recordings[:1], *flags) == 0
    assert contents(tmp_path) == before
    assert sample(tmp_path, recordings[:1]) == 1
    assert "sampling.precision is 0.5, here 0.0" in capsys.readouterr().err


def test_noise_is_a_setting_of_the_dataset(tmp_path, recordings, capsys):
    assert sample(tmp_path, recordings[:1], "--noise", "0.02") == 0
    assert sample(tmp_path, recordings[:1]) == 1
    assert "sampling.noise_m is 0.02, here 0.0" in capsys.readouterr().err


def test_another_registration_is_recorded_by_the_dataset_and_the_model(tmp_path, recordings):
    pytest.importorskip("small_gicp")
    from cello3d_ros.covariance.model import load_model

    text = CONFIG.replace("icp: {", "icp: {backend: small_gicp, ")
    (tmp_path / "config.yaml").write_text(text)
    assert sample(tmp_path, recordings) == 0
    model, config = str(tmp_path / "model.npz"), str(tmp_path / "config.yaml")
    assert main(["train", str(tmp_path / "dataset"), "--out", model, "--config", config]) == 0
    assert load_model(model).pipeline.icp.backend == "small_gicp"


def test_samples_that_are_no_number_are_a_usage_error(tmp_path, recordings, capsys):
    with pytest.raises(SystemExit) as error:
        sample(tmp_path, recordings, "--samples", "many")
    assert error.value.code == 2


def test_too_few_samples_are_refused_before_any_registration(tmp_path, recordings, capsys):
    assert sample(tmp_path, recordings, "--samples", "10") == 1
    error = capsys.readouterr().err
    assert error == "cello3d: SamplingConfig.n_samples must be at least 50: 10\n"
    assert not (tmp_path / "dataset").exists()


def test_two_recordings_of_one_name_are_refused(tmp_path, recordings, capsys):
    other = write_kitti(tmp_path / "elsewhere" / "one", 7)
    assert sample(tmp_path, [recordings[0], other]) == 1
    assert "two recordings are named 'one'" in capsys.readouterr().err
    assert not (tmp_path / "dataset").exists()


def test_sampling_keeps_blas_to_one_thread(tmp_path, recordings, monkeypatch):
    from cello3d_ros.learning import sampling

    seen, register_many = set(), sampling.register_many

    def watched(*arguments):
        seen.update(x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas")
        return register_many(*arguments)

    monkeypatch.setattr(sampling, "register_many", watched)
    assert sample(tmp_path, recordings[:1]) == 0
    assert seen == {1}


def test_another_recording_of_a_name_is_refused_by_what_is_in_it(tmp_path, recordings, capsys):
    assert sample(tmp_path, recordings[:1]) == 0
    before = contents(tmp_path)
    other = write_kitti(tmp_path / "elsewhere" / "one", 7)  # as many scans
    assert sample(tmp_path, [other]) == 1
    assert "holds another recording named 'one': fingerprint is" in capsys.readouterr().err
    poses = tmp_path / "one" / "poses.txt"
    rows = np.loadtxt(poses)
    rows[1:, 3] += 1e-9  # the same scans, poses estimated anew
    np.savetxt(poses, rows)
    assert sample(tmp_path, recordings[:1]) == 1
    assert "holds another recording named 'one'" in capsys.readouterr().err
    assert contents(tmp_path) == before


def test_a_dataset_from_before_fingerprints_is_resumed_and_learns_them(tmp_path, recordings):
    assert sample(tmp_path, recordings[:1]) == 0
    before, file = contents(tmp_path), tmp_path / "dataset" / "manifest.json"
    manifest = json.loads(file.read_text())
    known = manifest["recordings"]["one"].pop("fingerprint")
    file.write_text(json.dumps(manifest))
    assert sample(tmp_path, recordings[:1]) == 0
    assert contents(tmp_path) == before
    assert json.loads(file.read_text())["recordings"]["one"]["fingerprint"] == known


def test_a_recording_that_ends_early_keeps_the_pairs_before(
    tmp_path, recordings, capsys, monkeypatch
):
    from cello3d_ros.recordings.kitti import KittiRecording

    monkeypatch.setattr(KittiRecording, "__len__", lambda self: 6)
    assert sample(tmp_path, recordings[:1]) == 1
    error = capsys.readouterr().err
    assert "one: ends early, after 4 scans: scan 5 is missing" in error
    assert error.count("\n") == 1
    assert len(contents(tmp_path)) == 5


def test_a_disk_without_room_is_one_sentence_and_the_rest_follows_later(
    tmp_path, recordings, capsys
):
    """No file may grow past 4 kB: the manifest fits, pairs do not."""
    assert sample(tmp_path, recordings[:1], "--samples", "90") == 0  # compiles
    (tmp_path / "dataset").rename(tmp_path / "first")
    capsys.readouterr()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4_000, hard))
    try:
        assert sample(tmp_path, recordings[:1], "--samples", "90") == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    error = capsys.readouterr().err
    assert "cannot write" in error
    assert "one_0_1.npz: File too large" in error
    assert error.count("\n") == 1
    assert contents(tmp_path) == {}
    assert sample(tmp_path, recordings[:1], "--samples", "90") == 0
    assert files(tmp_path / "dataset") == files(tmp_path / "first")


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path, recordings, capsys):
    (tmp_path / "file").write_text("")
    config = str(tmp_path / "config.yaml")
    out = str(tmp_path / "file" / "dataset")
    assert main(["sample", *recordings, "--out", out, "--config", config]) == 1
    error = capsys.readouterr().err
    assert "cannot write" in error
    assert error.count("\n") == 1


def test_the_bar_tells_registrations_a_second_and_the_time_left(tmp_path, recordings, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    assert sample(tmp_path, recordings[:1]) == 0
    last = terminal.getvalue().rstrip().split("\r")[-1]
    assert "250/250" in last
    assert "reg/s" in last
    assert "pair 5 of 5" in last
    assert "<" in last


def test_python_samples_trains_and_evaluates_as_the_verbs_do(tmp_path, recordings, capsys):
    import cello3d_ros as cello
    from cello3d_ros.config import load_config

    recordings.append(write_kitti(tmp_path / "three", 2))
    assert sample(tmp_path, recordings) == 0
    config, reports = load_config(tmp_path / "config.yaml"), []
    outcomes = cello.sample(recordings, tmp_path / "again", config, 2, reports.append)
    assert outcomes == {"": 15}
    assert reports[-1] == ("three", 750, 750, 15, 15)
    assert files(tmp_path / "again") == files(tmp_path / "dataset")
    model = tmp_path / "model.npz"
    training = cello.train([tmp_path / "again"], model, config.training, exclude=["three"])
    assert training.model.provenance["recordings"] == {"one": 5, "two": 5}
    found = cello.evaluate([tmp_path / "again"], model, cello.EvaluationSettings(only=["three"]))
    capsys.readouterr()
    assert (
        main(["evaluate", str(tmp_path / "again"), "--model", str(model), "--only", "three"]) == 0
    )
    assert f"covariances are {found.methods['cello3d'].verdict} " in capsys.readouterr().out


@pytest.mark.parametrize(("n_scans", "words"), [(3, "no ground truth"), (1, "1 scan, a pair")])
def test_a_recording_that_gives_no_pair_begins_no_dataset(tmp_path, capsys, n_scans, words):
    scans = [Scan(stamp_ns=k + 1, points=np.ones((9, 3))) for k in range(n_scans)]
    write_bag(tmp_path / "bare", scans)
    assert main(["sample", str(tmp_path / "bare"), "--out", str(tmp_path / "d")]) == 1
    assert f"bare has {words}" in capsys.readouterr().err
    assert not (tmp_path / "d").exists()


def test_pairs_in_a_gap_of_ground_truth_are_rejected_by_name(tmp_path):
    poses = [None if k == 2 else exp([0.1 * k, 0, 0, 0, 0, 0]) for k in range(4)]
    points = np.random.default_rng(0).normal(size=(9, 3))
    write_bag(
        tmp_path / "gap",
        [
            Scan(stamp_ns=10**18 + k * 3 * 10**9, points=points, T_world_sensor=T)
            for k, T in enumerate(poses)
        ],
    )
    words = ["--samples", "50", "--max-gap", "1"]
    assert main(["sample", str(tmp_path / "gap"), "--out", str(tmp_path / "d"), *words]) == 0
    dataset = open_dataset(tmp_path / "d")
    reasons = {key[1:]: dataset.read(*key).reason for key in dataset.pair_keys()}
    assert reasons[0, 1] == "too_few_points"
    assert reasons[1, 2] == "no_ground_truth"
