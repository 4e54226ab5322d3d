"""The charts of a report, as plain dictionaries that plotly.js draws.

Texts that plotly.js shows may hold markup: what comes from a file is escaped.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from cello3d_ros.evaluation.result import Calibration, Pair, Paths, ShownPair
from cello3d_ros.geometry.se3 import Array, transform

Chart = dict[str, Any]  # data and layout

_COLORS = {
    "cello3d": "#1b7837",
    "mean_covariance": "#888888",
    "constant": "#5aae61",
    "sandwich": "#d95f02",
    "hessian": "#e7298a",
    "censi": "#b2182b",
    "sigma_points": "#7570b3",
    "monte_carlo": "#a6761d",
    "fused": "#2166ac",
}
_SHOWN_FIRST = ("cello3d", "mean_covariance", "censi", "fused")  # others by a click in the legend
_REFERENCE, _READING = "#2166ac", "#b2182b"
_SAMPLED, _PREDICTED, _DROPPED = "#1b7837", "#a040c8", "#d95f02"
_N_SIGMA = 2.0


def calibration_chart(found: Calibration) -> Chart:
    """Return measured quantiles of D_M^2 over those of chi-square with 6 degrees of freedom."""
    p = np.array(found.probabilities)
    ideal = chdtri(6, 1.0 - p)
    data = [
        {
            **_line(name),
            "x": ideal.tolist(),
            "y": np.maximum(values, 1e-9).tolist(),
            "text": [f"{name_of(name)}, quantile {q:g}" for q in p],
            "mode": "lines+markers",
        }
        for name, values in found.dm2.items()
    ]
    ends = [float(ideal[0]), float(ideal[-1])]
    data.append(
        {
            **{"x": ends, "y": ends, "mode": "lines", "name": "calibrated"},
            "line": {"color": "#999999", "dash": "dash"},
        }
    )
    layout = {
        "xaxis": {
            "title": {"text": "quantile of chi-square with 6 dof"},
            "type": "log",
        },
        "yaxis": {"title": {"text": "the same quantile of D_M²"}, "type": "log"},
    }
    return {"data": data, "layout": layout}


def divergence_chart(pairs: Sequence[Pair]) -> Chart:
    """Return the KL of each pair by each method, pairs in the order of the model's."""
    ordered = sorted(pairs, key=lambda pair: pair.kl["cello3d"])
    names = list(dict.fromkeys(name for pair in ordered for name in pair.kl))
    data = []
    for name in names:
        known = [(k, pair) for k, pair in enumerate(ordered, start=1) if name in pair.kl]
        line = _line(name)
        line["marker"]["symbol"] = [
            "circle-open" if pair.flagged else "circle" for _, pair in known
        ]
        data.append(
            {
                **line,
                "mode": "markers",
                "x": [k for k, _ in known],
                "y": [max(pair.kl[name], 1e-6) for _, pair in known],
                "text": [f"{pair_name(pair)}: {name_of(name)}" for _, pair in known],
            }
        )
    layout = {
        "xaxis": {"title": {"text": "pairs, from the best predicted to the worst"}},
        "yaxis": {"title": {"text": "KL divergence"}, "type": "log"},
    }
    return {"data": data, "layout": layout}


def trajectory_chart(paths: Paths) -> Chart:
    """Return the true path and the runs from above; ellipses of 2 sigma of the first run.

    Errors and ellipses are drawn larger about the truth by a factor that the axis states.
    """
    truth, C = paths.truth, paths.covariances
    factor = _magnification(truth, C)
    runs = truth[1:] + factor * (paths.positions - truth[1:])
    data = []
    for k, run in enumerate(runs):
        line = _path(np.vstack([truth[:1], run]), "odometry", "#2166ac", 1)
        data.append({**line, "opacity": 0.6, "legendgroup": "runs", "showlegend": k == 0})
    for k in range(len(truth) - 1 if len(runs) else 0):
        last = k == len(truth) - 2
        name = f"{_N_SIGMA:g}σ {'at the end' if last else 'on the way'}"
        ellipse = _ellipse(truth[k + 1, :2], factor**2 * C[0, k, :2, :2])
        line = _path(ellipse, name, _SAMPLED if last else "#888888", 2 if last else 1)
        data.append({**line, "legendgroup": f"ellipse{last}", "showlegend": last or k == 0})
    data.append(_path(truth, "truth", "#8a8a8a", 3))
    data[-1]["line"]["dash"] = "dot"
    if len(runs):
        ends = _path(runs[:, -1], "ends", _SAMPLED, 1)
        data.append({**ends, "mode": "markers", "marker": {"color": _SAMPLED, "size": 6}})
    layout = {
        "xaxis": {"title": {"text": "x in m"}},
        "yaxis": {
            "title": {"text": f"y in m, errors × {factor:g}" if factor > 1 else "y in m"},
            "scaleanchor": "x",
        },
    }
    return {"data": data, "layout": layout}


def samples_chart(pair: ShownPair) -> Chart:
    """Return where the registrations of a pair ended, and the ellipsoids of their covariances."""
    u = 1e3 * pair.xi.reshape(-1, 6)[:, :3]
    kept = pair.kept.astype(np.bool_)
    Y = [pair.covariance.reshape(6, 6), pair.predicted.reshape(6, 6)]
    reach = 2.5e3 * max(float(np.sqrt(np.diag(F)[:3].max())) for F in Y)
    reach = max(reach, 1.05 * float(np.abs(u[kept]).max(initial=0.0)))
    near = (np.abs(u) <= reach).all(axis=1)
    data: list[Chart] = []
    for mask, name, color in ((kept, "kept", _SAMPLED), (~kept, "dropped", _DROPPED)):
        if mask.any():
            far = (mask & ~near).sum()
            told = f"{mask.sum()}, {far} too far to show" if far else f"{mask.sum()}"
            data.append(_cloud(u[mask & near], f"{name} ({told})", color, 2.5))
    for F, name, color in zip(Y, ("sampled, 2σ", "predicted, 2σ"), (_SAMPLED, _PREDICTED)):
        data.append(_ellipsoid(1e6 * F[:3, :3], name, color))
    data.append(_cloud(np.zeros((1, 3)), "truth", "#8a8a8a", 6.0))
    data[-1]["marker"]["symbol"] = "cross"
    scene = _scene("mm", "cube")
    for axis in "xyz":
        scene[f"{axis}axis"]["range"] = [-reach, reach]
    return {"data": data, "layout": {"scene": scene}}


def clouds_chart(reading: Array, reference: Array, T_mean: ArrayLike) -> Chart:
    """Return both clouds of a pair, the reading where it belongs, in the reference's frame."""
    T = np.array(T_mean, np.float64).reshape(4, 4)
    data = [
        _cloud(reference, "reference", _REFERENCE, 1.2),
        _cloud(transform(T, reading), "reading", _READING, 1.2),
    ]
    return {"data": data, "layout": {"scene": _scene("m", "data")}}


def name_of(method: str) -> str:
    """Return the name of a method for people, escaped."""
    return html.escape(method.replace("_", " "))


def pair_name(pair: Pair | ShownPair) -> str:
    """Return the name of a pair for people, escaped."""
    return html.escape(f"{pair.recording} {pair.i}–{pair.j}")


def _line(name: str) -> Chart:
    color = _COLORS.get(name, "#555555")
    return {
        "name": name_of(name),
        "line": {"color": color},
        "marker": {"color": color, "size": 5},
        "visible": True if name in _SHOWN_FIRST else "legendonly",
        "hovertemplate": "%{text}<br>%{y:.3g}<extra></extra>",
    }


def _cloud(points: Array, name: str, color: str, size: float) -> Chart:
    x, y, z = (_packed(column) for column in points.T)
    return {
        **{"type": "scatter3d", "mode": "markers", "name": name, "hoverinfo": "skip"},
        **{"x": x, "y": y, "z": z, "marker": {"size": size, "color": color}},
    }


def _ellipsoid(C: Array, name: str, color: str) -> Chart:
    """Return the surface of 2 deviations around zero.  C: (3, 3)."""
    values, vectors = np.linalg.eigh(C)
    polar, around = np.meshgrid(np.linspace(0, np.pi, 19), np.linspace(0, 2 * np.pi, 25))
    ball = np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1
    )
    surface = _N_SIGMA * ball @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    x, y, z = (np.round(surface[..., k], 4).tolist() for k in range(3))
    return {
        **{"type": "surface", "x": x, "y": y, "z": z, "name": name, "showlegend": True},
        **{"opacity": 0.3, "showscale": False, "hoverinfo": "skip"},
        "colorscale": [[0, color], [1, color]],
    }


def _path(xy: Array, name: str, color: str, width: int) -> Chart:
    """Return a line through points (N, 2 or more)."""
    x, y = (np.round(xy[:, axis], 6).tolist() for axis in (0, 1))
    line = {"color": color, "width": width}
    return {"x": x, "y": y, "mode": "lines", "name": name, "line": line}


def _ellipse(center: Array, C: Array) -> Array:
    """Return the outline of 2 deviations around a point.  (49, 2)."""
    values, vectors = np.linalg.eigh(C)
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    outline = _N_SIGMA * root @ np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(center + outline.T)


def _magnification(truth: Array, C: Array) -> float:
    """Return 1, 2, 5, 10, ... by which errors are drawn larger so that they are seen."""
    if not C.size:
        return 1.0
    spread = _N_SIGMA * float(np.median(np.sqrt(np.trace(C[:, -1], axis1=1, axis2=2))))
    wanted = 0.1 * float(np.ptp(truth, axis=0).max()) / max(spread, 1e-9)
    steps = [10.0**e * m for e in range(4) for m in (1, 2, 5)]
    return max([1.0, *(step for step in steps if step <= wanted)])


def _packed(values: Array) -> dict[str, str]:
    """Return numbers as plotly.js reads them: float32, in base64."""
    data = np.ascontiguousarray(values, "<f4").tobytes()
    return {"dtype": "f4", "bdata": base64.b64encode(data).decode()}


def _scene(unit: str, aspect: str) -> Chart:
    axes = {f"{axis}axis": {"title": {"text": f"{axis} in {unit}"}} for axis in "xyz"}
    camera = {"eye": {"x": -1.5, "y": -1.9, "z": 1.4}}
    return {**axes, "aspectmode": aspect, "camera": camera}
