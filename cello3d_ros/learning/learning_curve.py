"""A picture of the loss over the iterations of training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cello3d_ros.atomic import new_file


def plot_learning_curve(
    curve: Sequence[tuple[int, float, float]], best_iteration: int, judged_by: str, path: Path
) -> None:
    """Write a PNG of training loss and of what Theta was judged by, over the iterations.

    curve: (iteration, training loss, judged) as ``Training.curve``.  judged_by: name of the
    latter.  Raises WriteError where the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    iterations, training, judged = zip(*curve)
    axes.plot(iterations, training, label="training recordings, each from the others")
    axes.plot(iterations, judged, label=judged_by)
    axes.axvline(best_iteration, color="grey", linestyle=":", label="kept")
    axes.set(xlabel="iteration", ylabel="loss")
    axes.grid(alpha=0.3)
    axes.legend()
    with new_file(path) as partial:
        figure.savefig(partial, format="png", metadata={"Software": None})
