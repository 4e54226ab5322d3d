"""Any recording by its path."""

from __future__ import annotations

from pathlib import Path

from cello3d_ros.errors import RecordingError
from cello3d_ros.recordings.recording import Recording


def open_recording(
    path: Path | str,
    points_topic: str | None = None,
    odometry_topic: str | None = None,
    ground_truth_topic: str | None = None,
) -> Recording:
    """Return the recording at a path: a KITTI folder (it has ``velodyne/``), or a ROS bag.

    The topics are for bags only, see BagRecording.  Raises RecordingError.
    """
    path = Path(path)
    topics = (points_topic, odometry_topic, ground_truth_topic)
    if (path / "velodyne").is_dir():
        if any(topics):
            raise RecordingError(f"{path}: a KITTI folder has no topics to choose from")
        from cello3d_ros.recordings.kitti import KittiRecording

        return KittiRecording(path)
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder")
    if (path / "metadata.yaml").exists() or path.suffix in (".bag", ".mcap", ".db3"):
        from cello3d_ros.recordings.bag import BagRecording

        return BagRecording(path, *topics)
    raise RecordingError(
        f"{path}: no recording; expected a rosbag2 folder (metadata.yaml), a .bag, .mcap or .db3 "
        "file, or a KITTI folder (velodyne/)"
    )
