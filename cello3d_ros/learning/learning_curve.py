"""A picture of the loss over the iterations of training."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from cello3d_ros.errors import Cello3dError


def plot_learning_curve(
    curve: Sequence[tuple[int, float, float]], best_iteration: int, judged_by: str, path: Path
) -> None:
    """Write a PNG of training loss and of what Theta was judged by, over the iterations.

    curve: (iteration, training loss, judged) as ``Training.curve``.  judged_by: name of the
    latter.  Raises Cello3dError where the file cannot be written.
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
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        figure.savefig(partial, format="png", metadata={"Software": None})
        os.replace(partial, path)
    except OSError as error:
        raise Cello3dError(f"cannot write {path}: {error.strerror or error}") from None
    finally:
        partial.unlink(missing_ok=True)
