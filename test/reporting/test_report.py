"""``cello3d report``: what is on the page, what is refused, and that a browser draws it."""

from __future__ import annotations

import copy
import importlib.util
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cello3d_ros.cli.main import main
from cello3d_ros.evaluation.comparison import PROBABILITIES
from cello3d_ros.geometry.se3 import exp

NASTY = '<img src=x onerror="alert(1)"></script>&'


def figures(kl: float) -> dict[str, Any]:
    return {
        "n_pairs": 2,
        "kl_mean": kl,
        "kl_median": kl,
        "kl_90": kl,
        "kl_ratio": 0.5,
        "dm2_over_6": 1.1,
        "coverage_95": 0.93,
        "verdict": "about right",
        "ms_per_pair": None,
        "icp_runs": 0,
    }


def an_evaluation(name: str = "walk") -> dict[str, Any]:
    """An evaluation of two pairs of one recording, as ``cello3d evaluate`` writes it."""
    rng = np.random.default_rng(0)
    xi = rng.normal(scale=0.01, size=(60, 6))
    Y = np.diag([1e-4] * 6)
    methods = {"cello3d": figures(1.25), "mean_covariance": figures(7.5)}
    truth = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0.5, 0]])
    pairs = [
        {
            **{"recording": name, "i": i, "j": i + 1, "flagged": False},
            **{"offset_m": 0.0, "scatter_m": 0.01, "offset_rad": 0.0, "scatter_rad": 0.01},
            "kl": {"cello3d": 1.0 + i, "mean_covariance": 7.5},
            "dm2_over_6": {"cello3d": 2.2, "mean_covariance": 0.3},
        }
        for i in range(2)
    ]
    shown = {
        **{"recording": name, "j": 1, "i": 0, "kl": 2.0, "T_mean": exp([0.3, 0, 0, 0, 0, 0.1])},
        **{"covariance": Y, "predicted": 4.0 * Y, "xi": xi, "kept": [1] * 50 + [0] * 10},
        **{"dm2_over_6": 2.2, "flagged": True},
    }
    path = {
        **{"truth": truth, "positions": [truth[1:] + 0.01, truth[1:] - 0.01]},
        "covariances": np.tile(1e-4 * np.eye(3), (2, 2, 1, 1)),
    }
    counts = {"n_runs": 2, "n_failed": 0, "n_lost": 0, "n_told": 0, "n_lost_told": 0}
    walked = {"length_m": 2.1, **counts, "dm_6dof": 2.2, "without_lost": {}, "paths": path}
    report = {
        **{"settings": {}, "pose_check": {}, "with_flagged_pairs": None},
        **{"model": f"{name}.npz", "shape": "sandwich", "n_pairs": 2, "methods": methods},
        "recordings": {name: {"n_pairs": 2, "methods": methods}},
        "pairs": pairs,
        "calibration": {
            "probabilities": PROBABILITIES,
            "dm2": {"cello3d": list(np.linspace(0.5, 20.0, len(PROBABILITIES)))},
        },
        "worst_pairs": [shown],
        "trajectories": {name: walked},
    }
    return json.loads(json.dumps(report, default=np.ndarray.tolist))


@pytest.fixture
def plotly() -> None:
    pytest.importorskip("plotly", reason="plotly is not installed: extra 'report'")


def write(folder: Path, report: Any) -> Path:
    path = folder / "evaluation.json"
    path.write_text(report if isinstance(report, str) else json.dumps(report))
    return path


def make(folder: Path, report: Any, *words: object) -> int:
    path = write(folder, report)
    return main(["report", str(path), "--out", str(folder / "r.html"), *map(str, words)])


@pytest.fixture
def walk(tmp_path: Path, room: tuple[np.ndarray, np.ndarray]) -> Path:
    """A KITTI folder of two scans of a room."""
    folder = tmp_path / "walk"
    (folder / "velodyne").mkdir(parents=True)
    for k, points in enumerate(room):
        rows = np.zeros((len(points), 4), "<f4")
        rows[:, :3] = points
        rows.tofile(folder / "velodyne" / f"{k:06}.bin")
    np.savetxt(folder / "poses.txt", np.tile(np.eye(4)[:3].ravel(), (2, 1)))
    return folder


@pytest.mark.usefixtures("plotly")
def test_a_recording_that_the_model_was_trained_on_is_said_to_be(tmp_path: Path) -> None:
    report = an_evaluation()
    for is_seen in (True, False):
        report["recordings"]["walk"]["trained_on"] = is_seen
        assert make(tmp_path, report) == 0
        page = (tmp_path / "r.html").read_text()
        assert ("walk (2 pairs), which the model was trained" in page) == is_seen


@pytest.mark.usefixtures("plotly")
def test_the_page_holds_the_figures_and_fetches_nothing(tmp_path: Path) -> None:
    assert make(tmp_path, an_evaluation()) == 0
    page = (tmp_path / "r.html").read_text()
    assert "<td>1.25</td>" in page
    assert "<td>7.5</td>" in page
    assert "walk 0–1, KL 2, covariance too small: multiply by 2.2, its pose is suspected" in page
    assert "<dt>cello3d</dt><dd>the prediction of the model" in page
    assert "<dt>censi</dt>" not in page
    ours = re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)
    assert "http" not in ours.replace("http-equiv", "")
    assert "src=" not in ours
    assert len(page.encode()) < 20_000_000
    assert sorted(path.name for path in tmp_path.iterdir()) == ["evaluation.json", "r.html"]


@pytest.mark.usefixtures("plotly")
def test_text_of_the_file_is_escaped(tmp_path: Path) -> None:
    assert make(tmp_path, an_evaluation(NASTY)) == 0
    page = (tmp_path / "r.html").read_text()
    assert "<img" not in page.split('<script type="application/json"')[0]
    data = page.split('id="data">')[1].split("</script>")[0]
    assert "<" not in data
    assert "&lt;img" in json.dumps(json.loads(data))


@pytest.mark.usefixtures("plotly")
def test_clouds_are_shown_thinned_where_they_are_given(tmp_path: Path, walk: Path) -> None:
    assert make(tmp_path, an_evaluation(), "--recordings", walk) == 0
    page = (tmp_path / "r.html").read_text()
    data = json.loads(page.split('id="data">')[1].split("</script>")[0])
    x = data["worst"][0]["clouds"]["data"][1]["x"]
    assert x["dtype"] == "f4"
    assert len(x["bdata"]) == 4 * 6000 * 4 // 3
    assert 'id="clouds"' in page


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda r: r.pop("calibration"), "of another version: the evaluation lacks 'calibration'"),
        (lambda r: r.pop("methods"), "no JSON of cello3d evaluate: it has no 'methods'"),
        (lambda r: r.update(pairs={}), "damaged: 'pairs' of the evaluation is not of type list"),
        (lambda r: r["pairs"][0].pop("kl"), "an entry of 'pairs' of the evaluation lacks 'kl'"),
        (
            lambda r: r["methods"]["cello3d"].update(kl_mean="much"),
            "'kl_mean' of 'cello3d' of 'methods' of the evaluation is not of type float",
        ),
        (
            lambda r: r["worst_pairs"][0].update(xi=[[1, 2]]),
            "damaged: 'xi' has shape (1, 2), not (60, 6)",
        ),
        (
            lambda r: r["trajectories"]["walk"].update(paths=[]),
            "damaged: 'paths' of 'walk' of 'trajectories' of the evaluation is not an",
        ),
    ],
)
def test_a_damaged_or_older_file_is_said_in_one_sentence(
    change: Any, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = copy.deepcopy(an_evaluation())
    change(report)
    assert make(tmp_path, report) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert reason in said.err
    assert not (tmp_path / "r.html").exists()


@pytest.mark.parametrize("text", ["", "{", "[]", "[" * 100_000, '{"methods": NaN}'])
def test_what_is_no_evaluation_is_said(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert make(tmp_path, text) == 1
    assert "no JSON of cello3d evaluate" in capsys.readouterr().err


def test_missing_files_and_scans_are_said(
    tmp_path: Path, walk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["report", str(tmp_path / "none.json"), "--out", str(tmp_path / "r.html")]
    assert main(words) == 1
    assert "cannot read" in capsys.readouterr().err
    report = an_evaluation()
    report["worst_pairs"][0]["j"] = 9
    assert make(tmp_path, report, "--recordings", walk) == 1
    assert "has 2 scans, no scan 9" in capsys.readouterr().err


@pytest.fixture(scope="module")
def browser():
    """Chromium of the system, driven by playwright."""
    if importlib.util.find_spec("playwright") is None:
        pytest.skip("playwright is not installed: extra 'dev'")
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    if path is None:
        pytest.skip("chromium is not installed")
    from playwright.sync_api import sync_playwright

    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=path, args=flags)
        yield found
        found.close()


@pytest.mark.usefixtures("plotly")
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_browser_draws_the_page(browser: Any, scheme: str, tmp_path: Path, walk: Path) -> None:
    report = an_evaluation(NASTY if scheme == "dark" else "walk")
    report["worst_pairs"][0]["recording"] = "walk"
    assert make(tmp_path, report, "--recordings", walk) == 0
    said, fetched = [], []
    tab = browser.new_page(color_scheme=scheme, viewport={"width": 1200, "height": 900})
    tab.on("console", lambda message: said.append((message.type, message.text)))
    tab.on("pageerror", lambda error: said.append(("error", str(error))))
    tab.on("request", lambda request: fetched.append(request.url))
    page = (tmp_path / "r.html").as_uri()
    tab.goto(page)
    tab.wait_for_selector("body[data-ready=yes]", timeout=120_000)
    assert [text for kind, text in said if kind == "error"] == []
    assert [url for url in fetched if not url.startswith(("data:", "blob:"))] == [page]
    for name in ("samples", "clouds"):  # the 3-D views have drawn more than their background
        shown = tab.locator(f"#{name}")
        assert n_colors(shown.screenshot()) > 50
        assert shown.locator("canvas").count() > 0
    for name in ("calibration", "divergence", "path0", "samples", "clouds"):
        tab.locator(f"#{name}").hover()
        legend = tab.locator(f"#{name} .legend").bounding_box()
        bar = tab.locator(f"#{name} .modebar-group").first.bounding_box()
        assert legend["x"] + legend["width"] <= bar["x"], name  # the tool bar hides no name
    before = tab.locator("#clouds").screenshot()
    box = tab.locator("#clouds").bounding_box()
    tab.mouse.move(box["x"] + 200, box["y"] + 250)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 320, box["y"] + 300, steps=5)
    tab.mouse.up()
    tab.wait_for_function("() => new Promise(done => requestAnimationFrame(() => done(true)))")
    assert before != tab.locator("#clouds").screenshot()  # it turns
    tab.close()


def n_colors(png: bytes) -> int:
    """Return how many colours the middle of a picture has."""
    import io

    from matplotlib.image import imread

    picture = imread(io.BytesIO(png), format="png")[100:-60, 100:-100, :3]
    return len(np.unique(np.round(picture * 32).reshape(-1, 3), axis=0))
