"""One HTML page of an evaluation: nothing in it is fetched from anywhere."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import resources
from typing import Any

from cello3d_ros.errors import Cello3dError
from cello3d_ros.evaluation.result import Evaluation, ShownPair, Trajectory
from cello3d_ros.geometry.se3 import Array
from cello3d_ros.learning.measures import verdict
from cello3d_ros.reporting.charts import (
    calibration_chart,
    clouds_chart,
    divergence_chart,
    name_of,
    pair_name,
    samples_chart,
    trajectory_chart,
)

Clouds = Mapping[tuple[str, int, int], tuple[Array, Array]]  # pair -> reading, reference

_Columns = Sequence[tuple[str, str, str]]  # heading, figure, format
_METHODS: _Columns = (
    ("pairs", "n_pairs", "d"),
    ("KL mean", "kl_mean", ".3g"),
    ("median", "kl_median", ".3g"),
    ("90 %", "kl_90", ".3g"),
    ("ratio to baseline", "kl_ratio", ".3g"),
    ("D²/6", "dm2_over_6", ".3g"),
    ("in 95 %", "coverage_95", ".3f"),
    ("covariances are", "verdict", "s"),
    ("ms a pair", "ms_per_pair", ".1f"),
    ("extra ICP runs", "icp_runs", "d"),
)
_TRAJECTORIES: _Columns = (
    ("length (m)", "length_m", ".1f"),
    ("runs", "n_runs", "d"),
    ("failed", "n_failed", "d"),
    ("lost", "n_lost", "d"),
    ("found lost", "n_told", "d"),
    ("NEES/6 (ideal 1)", "nees_over_6", ".3g"),
    ("covariances are", "verdict", "s"),
    ("D_M (ideal 2.35)", "dm_6dof", ".2f"),
    ("translation (1.60)", "dm_translation", ".2f"),
    ("rotation (1.60)", "dm_rotation", ".2f"),
    ("in 95 %", "coverage_95", ".2f"),
    ("error (m)", "error_m", ".3f"),
    ("error (rad)", "error_rad", ".4f"),
)
_MEANING = {
    "cello3d": "the prediction of the model that is judged",
    "cello3d_widened": "the same as a node publishes it: at least the mean of the training data "
    "where a pair is unknown to the model",
    "mean_covariance": "one covariance for every pair, the mean of the training data (the "
    "baseline)",
    "constant": "the mean of the training data relative to the shape of each pair",
    "hessian": "σ² (Σ JᵀJ)⁻¹, the sensor's noise through the equations of ICP",
    "sandwich": "H⁻¹ (Σ g gᵀ) H⁻¹, what residuals and drawn points do to the result",
    "censi": "the sensor's noise through the minimum of ICP's cost (Censi 2007, Prakhya 2015)",
    "sigma_points": "12 more registrations from chosen starts (Brossard 2020)",
    "monte_carlo": "the scatter of some more registrations from random starts",
    "fused": "the model's prediction and the same registrations together",
}
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src data: blob:"
)


def page(found: Evaluation, clouds: Clouds) -> str:
    """Return the page of an evaluation.

    clouds: points (N, 3) of those worst pairs whose recordings are at hand.  Raises ValueError
    where arrays of the evaluation have the wrong size, and Cello3dError without plotly.
    """
    charts = {
        "calibration": calibration_chart(found.calibration),
        "divergence": divergence_chart(found.pairs),
    }
    for k, row in enumerate(found.trajectories.values()):
        if row.paths is not None:
            charts[f"path{k}"] = trajectory_chart(row.paths)
    worst = [_worst(pair, clouds) for pair in found.worst_pairs]
    data = json.dumps({"charts": charts, "worst": worst}, allow_nan=False, separators=(",", ":"))
    data = data.replace("<", "\\u003c")  # so that no text in it can end the script
    body = "\n".join(_body(found, clouds))
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<title>Evaluation of {html.escape(found.model)}</title>
<style>{_asset("report.css")}</style>
</head>
<body>
{body}
<script type="application/json" id="data">{data}</script>
<script>{_plotly()}</script>
<script>{_asset("report.js")}</script>
</body>
</html>
"""


def _body(found: Evaluation, clouds: Clouds) -> Iterator[str]:
    yield "<header><h1>Evaluation of ICP covariances</h1>"
    yield f"<p>Model <strong>{html.escape(found.model)}</strong>, covariances relative to: "
    yield f"{html.escape(found.shape)}. {found.n_pairs} pairs of "
    yield f"{len(found.recordings)} recordings.</p></header>\n<main>"
    yield "<h2>All pairs</h2>"
    yield "<p>KL is the divergence of a method's covariance from the sampled one, 0 at best. "
    yield "D²/6 is the mean squared Mahalanobis distance of sampled errors over 6, 1 at best; "
    yield "above, covariances are too small.</p>"
    yield table("Methods, all recordings", _METHODS, found.methods)
    yield from _meanings(found.methods)
    for name, part in found.recordings.items():
        seen = ", which the model was trained or validated on" if part.trained_on else ""
        title = f"{html.escape(name)} ({part.n_pairs} pairs){seen}"
        yield f"<details><summary>{title}</summary>"
        yield table(title, _METHODS, part.methods) + "</details>"
    yield "<h2>Calibration</h2>"
    yield _figure(
        "calibration",
        "Quantiles of the squared Mahalanobis distance of sampled errors over those of "
        "chi-square with 6 degrees of freedom. On the dashed line a covariance is right, above "
        "it too small, below it too large.",
    )
    yield "<h2>Divergence of each pair</h2>"
    yield _figure(
        "divergence",
        "KL divergence of every pair by every method. Hollow: the pose of the pair is suspected, "
        "and it is in no figure above.",
    )
    yield from _trajectories(found.trajectories)
    yield from _worst_pairs(found.worst_pairs, clouds)
    yield "</main>"


def _meanings(methods: Iterable[str]) -> Iterator[str]:
    """Explain the methods that are in the table."""
    yield '<dl class="methods">'
    for name in methods:
        if name in _MEANING:
            yield f"<dt>{name_of(name)}</dt><dd>{_MEANING[name]}</dd>"
    yield "<dt>… scaled</dt><dd>that method times the one number that suits these very pairs "
    yield "best, more than it could know</dd></dl>"


def _trajectories(rows: Mapping[str, Trajectory]) -> Iterator[str]:
    if not rows:
        return
    yield "<h2>Trajectories</h2>"
    yield "<p>ICP odometry from scattered starts; the covariance of its end is compounded from "
    yield "those of its steps. All runs of a recording share its places: how covariances fit over "
    yield "trajectories is judged over many recordings.</p>"
    yield table("Final poses", _TRAJECTORIES, rows)
    yield '<div class="paths">'
    for k, (name, row) in enumerate(rows.items()):
        if row.paths is not None:
            yield _figure(f"path{k}", f"{html.escape(name)}, from above.")
    yield "</div>"


def _worst_pairs(pairs: Sequence[ShownPair], clouds: Clouds) -> Iterator[str]:
    if not pairs:
        return
    yield "<h2>Worst predicted pairs</h2>"
    yield '<p><label for="worst">Pair: </label><select id="worst">'
    for k, pair in enumerate(pairs):
        told = f"KL {pair.kl:.3g}, covariance {verdict(pair.dm2_over_6)}"
        told += ", its pose is suspected" if pair.flagged else ""
        yield f'<option value="{k}">{pair_name(pair)}, {told}</option>'
    yield '</select></p><div class="pair">'
    yield _figure(
        "samples",
        "Positions at which registrations ended, about the truth, in the reading's frame, with "
        "ellipsoids of the sampled and the predicted covariance. Drag to turn.",
    )
    if clouds:
        yield _figure("clouds", "Both clouds, registered by the truth. Drag to turn.")
    else:
        yield "<p>Clouds are shown where their <code>--recordings</code> are given.</p>"
    yield "</div>"


def table(caption: str, columns: _Columns, rows: Mapping[str, object]) -> str:
    """Return a table of escaped cells; a figure that is not there leaves its cell empty."""
    heads = "".join(f'<th scope="col">{heading}</th>' for heading, _, _ in columns)
    lines = []
    for name, row in rows.items():
        cells = "".join(f"<td>{_cell(getattr(row, key), form)}</td>" for _, key, form in columns)
        kind = ' class="chosen"' if name == "cello3d" else ""
        lines.append(f'<tr{kind}><th scope="row">{name_of(name)}</th>{cells}</tr>')
    return (
        f'<div class="scroll"><table><caption>{caption}</caption><thead><tr><td></td>{heads}'
        f"</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def _cell(value: Any, form: str) -> str:
    if value is None:
        return ""
    if form == "s":
        return html.escape(str(value))
    return format(int(value) if form == "d" else float(value), form)


def _figure(name: str, caption: str) -> str:
    return (
        f'<figure><div class="chart" id="{name}" role="img" aria-label="{caption}"></div>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _worst(pair: ShownPair, clouds: Clouds) -> dict[str, Any]:
    found: dict[str, Any] = {"samples": samples_chart(pair)}
    key = (pair.recording, pair.i, pair.j)
    if key in clouds:
        found["clouds"] = clouds_chart(*clouds[key], pair.T_mean)
    return found


def _asset(name: str) -> str:
    return (resources.files(__package__) / "assets" / name).read_text(encoding="utf-8")


def _plotly() -> str:
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise Cello3dError(
            f"a report needs plotly: pip install 'cello3d_ros[report]' ({error})"
        ) from None
    return str(get_plotlyjs())
