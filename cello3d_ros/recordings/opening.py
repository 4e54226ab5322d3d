"""Any recording by its path."""

from __future__ import annotations

from pathlib import Path

from cello3d_ros.errors import RecordingError
from cello3d_ros.recordings.recording import ReadOptions, Recording

_BAGS = (".bag", ".mcap", ".db3", ".mcap.zstd", ".db3.zstd")


def open_recording(path: Path | str, options: ReadOptions | None = None) -> Recording:
    """Return the recording at a path, whatever it is.

    A KITTI folder (it has ``velodyne/``), a ROS bag, the 'Challenging data sets' (a folder or zip
    archive with ``Hokuyo_<i>.csv``), or a folder of clouds.  options: what a user says of it.
    Raises RecordingError.
    """
    path, options = Path(path), options or ReadOptions()
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder")
    kind = kind_of(path)
    if kind is None:
        raise RecordingError(
            f"{path}: no recording; expected a rosbag2 folder (metadata.yaml), a .bag, .mcap or "
            ".db3 file, a KITTI folder (velodyne/), a folder or zip archive with Hokuyo_<i>.csv, "
            "or a folder of .ply, .pcd, .bin, .npy or .csv clouds"
        )
    if kind != "ROS bag" and options.is_for_bags:
        raise RecordingError(f"{path}: a {kind} has no topics to choose from")
    if kind == "folder of clouds":
        from cello3d_ros.recordings.folder import FolderRecording

        return FolderRecording(path, options)
    recording = _recording(path, kind, options)
    if options.poses is None:
        return recording
    from cello3d_ros.recordings.start_poses import PosedRecording, start_track

    track = start_track(options.poses, recording)
    return PosedRecording(recording, track, keeps_odometry=True)


def _recording(path: Path, kind: str, options: ReadOptions) -> Recording:
    if kind == "KITTI folder":
        from cello3d_ros.recordings.kitti import KittiRecording

        return KittiRecording(path, options)
    if kind == "ROS bag":
        from cello3d_ros.recordings.bag import BagRecording

        return BagRecording(path, options)
    from cello3d_ros.recordings.challenging import ChallengingRecording

    return ChallengingRecording(path)


def kind_of(path: Path) -> str | None:
    """Return what recording is at a path, None if it is none.

    Raises RecordingError for a zip archive that is damaged.
    """
    if (path / "velodyne").is_dir():
        return "KITTI folder"
    if path.name.endswith(_BAGS) or (path / "metadata.yaml").exists():
        return "ROS bag"
    if path.is_dir() and any(f.name.endswith(_BAGS) for f in path.iterdir()):
        return "ROS bag"
    if path.is_dir() or path.suffix.lower() == ".zip":
        from cello3d_ros.recordings.challenging import is_challenging
        from cello3d_ros.recordings.folder import clouds_in

        if is_challenging(path):
            return "'Challenging data sets' sequence"
        if clouds_in(path):
            return "folder of clouds"
    return None
