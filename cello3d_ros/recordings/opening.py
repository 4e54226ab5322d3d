"""Any recording by its path."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from cello3d_ros.errors import RecordingError

if TYPE_CHECKING:
    from cello3d_ros.geometry.se3 import Array
    from cello3d_ros.recordings.recording import Recording

_BAGS = (".bag", ".mcap", ".db3")


def open_recording(
    path: Path | str,
    points_topic: str | None = None,
    odometry_topic: str | None = None,
    ground_truth_topic: str | None = None,
    *,
    ground_truth_frames: tuple[str, str] | None = None,
    T_base_sensor: Array | None = None,
    poses: Path | str | None = None,
) -> Recording:
    """Return the recording at a path, whatever it is.

    A KITTI folder (it has ``velodyne/``), a ROS bag, the 'Challenging data sets' (a folder or zip
    archive with ``Hokuyo_<i>.csv``), or a folder of clouds.  Topics, frames and T_base_sensor are
    for bags, see BagRecording; ``poses`` is for folders of clouds.  Raises RecordingError.
    """
    path = Path(path)
    topics = (points_topic, odometry_topic, ground_truth_topic)
    bag_options = any(topics) or ground_truth_frames is not None or T_base_sensor is not None
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder")
    kind = kind_of(path)
    if kind is None:
        raise RecordingError(
            f"{path}: no recording; expected a rosbag2 folder (metadata.yaml), a .bag, .mcap or "
            ".db3 file, a KITTI folder (velodyne/), a folder or zip archive with Hokuyo_<i>.csv, "
            "or a folder of .ply, .pcd, .bin, .npy or .csv clouds"
        )
    if kind != "ROS bag" and bag_options:
        raise RecordingError(f"{path}: a {kind} has no topics to choose from")
    if kind != "folder of clouds" and poses is not None:
        raise RecordingError(f"{path}: a {kind} has poses of its own")
    if kind == "KITTI folder":
        from cello3d_ros.recordings.kitti import KittiRecording

        return KittiRecording(path)
    if kind == "ROS bag":
        from cello3d_ros.recordings.bag import BagRecording

        return BagRecording(
            path, *topics, ground_truth_frames=ground_truth_frames, T_base_sensor=T_base_sensor
        )
    if kind == "folder of clouds":
        from cello3d_ros.recordings.folder import FolderRecording

        return FolderRecording(path, poses)
    from cello3d_ros.recordings.challenging import ChallengingRecording

    return ChallengingRecording(path)


def kind_of(path: Path) -> str | None:
    """Return what recording is at a path, None if it is none.

    Raises RecordingError for a zip archive that is damaged.
    """
    if (path / "velodyne").is_dir():
        return "KITTI folder"
    if path.suffix in _BAGS or (path / "metadata.yaml").exists():
        return "ROS bag"
    if path.is_dir() and any(f.suffix in _BAGS for f in path.iterdir()):
        return "ROS bag"
    if path.is_dir() or path.suffix.lower() == ".zip":
        from cello3d_ros.recordings.challenging import is_challenging
        from cello3d_ros.recordings.folder import clouds_in

        if is_challenging(path):
            return "'Challenging data sets' sequence"
        if clouds_in(path):
            return "folder of clouds"
    return None
