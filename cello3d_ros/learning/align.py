"""Reference poses from the recording itself: every scan registered to all its neighbours.

Pairs of scans in a row give first poses (``align_chain``).  Then sweeps, in turns forwards and
backwards, register each scan to the union of up to 8 scans before and 8 after it, until the
median change of a step is below a millimetre.  What all neighbours share, a bias of the
registration, stays.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cello3d_ros.atomic import new_file
from cello3d_ros.clouds.shape import Cloud, with_shape
from cello3d_ros.errors import CloudError, RecordingError, counted
from cello3d_ros.geometry.pose_track import PoseTrack
from cello3d_ros.geometry.se3 import Array, adjoint, exp, inverse, log
from cello3d_ros.learning.align_carried import Carried, carried_of
from cello3d_ros.learning.align_chain import Chain, Placed, build_chain
from cello3d_ros.learning.align_scans import ScanStore, ShapedScan, filtered_scan
from cello3d_ros.learning.align_smear import Smear, smear_of
from cello3d_ros.learning.align_sweeps import (
    N_BEFORE,
    AlignSettings,
    cloud_of,
    motion_of,
    neighbors_of,
    own_points,
    visit,
)
from cello3d_ros.learning.identity import fingerprint
from cello3d_ros.recordings.recording import Recording, Scan
from cello3d_ros.registration.icp import register

MAX_SWEEPS = 8
_FEWEST_SWEEPS = 4
_TOLERANCE_M = 1e-3  # median change of the steps in a sweep that ends them
_KEYFRAME_M, _KEYFRAME_RAD = 0.05, 0.02  # motion that makes a new keyframe
_SAVE_S = 20.0
_SPREAD = 4  # scans before and after, over which the spread of half-sets is averaged
_FACTOR = 1.2  # of the half-sets' spread, from errors against exact truth: docs/align.md
_FLOOR_M, _FLOOR_RAD = 1e-4, 1e-5
_OUTLIER = 8.0  # times the usual difference of half-sets: a scan that does not hold,
_OUTLIER_M, _OUTLIER_RAD = 0.03, 0.015  # from these on
_STATE = "state.npz"
_VERSION = 4  # of the state
_FACTS = (
    *("sweep", "position", "is_last", "is_done", "moves_m", "compensated", "smear", "carried"),
)
_ARRAYS = ("stamps_ns", "keyframes", "held", "moved", "halves", "first_poses", "pairs")

_DEFAULTS = AlignSettings()

Progress = Callable[[int, int], None]  # scans visited so far, and in all as far as known


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """Reference poses of a recording.

    poses: (n, 4, 4), T_part_sensor; the first scan of a part keeps the pose it started with.
    covariances: (n, 6, 6), of each pose beside its neighbours, (u, omega), sensor side, as
    ``T_true = T exp(xi)``; zeros where the scan is left out.  part: (n,), scans of one number
    have poses in one frame; 0 is the longest, -1 is left out.  reasons: why a scan is left out.
    pairwise: (m, 6), of scans in a row: registration of the two alone, from the joint poses.
    moves_m: median change of the steps in each sweep.  compensated: whether the motion within
    scans was undone.  smear: where points carry no times, what undoing it would do.  carried: what
    moves with the sensor.
    """

    name: str
    stamps_ns: NDArray[np.int64]
    poses: Array
    covariances: Array
    part: NDArray[np.int64]
    reasons: dict[int, str]
    pairwise: Array
    moves_m: tuple[float, ...]
    n_contradicted: int = 0
    n_searched: int = 0
    compensated: bool = False
    smear: Smear | None = None
    carried: Carried | None = None

    @property
    def rests(self) -> bool:
        """Whether the last sweep hardly changed the steps."""
        return not self.moves_m or self.moves_m[-1] < 2.0 * _TOLERANCE_M

    @property
    def n_parts(self) -> int:
        """Number of parts."""
        return int(self.part.max(initial=-1)) + 1

    def members(self, part: int = 0) -> NDArray[np.int64]:
        """Return the scans of a part."""
        return np.flatnonzero(self.part == part)

    def step_covariance(self, i: int, j: int) -> Array:
        """Return the covariance (6, 6) of ``T_i^-1 T_j``, on the side of scan j."""
        Ad = adjoint(inverse(self.poses[j]) @ self.poses[i])
        return np.asarray(Ad @ self.covariances[i] @ Ad.T + self.covariances[j])

    def sigmas(self) -> tuple[float, float]:
        """Return the root mean square errors of a step that are expected, in m and rad."""
        Y = [
            self.step_covariance(int(i), int(j))
            for part in range(self.n_parts)
            for i, j in zip(self.members(part)[:-1], self.members(part)[1:], strict=True)
        ]
        D = np.mean([np.diagonal(C) for C in Y], axis=0)
        return float(np.sqrt(D[:3].sum())), float(np.sqrt(D[3:].sum()))

    def pairwise_rms(self) -> tuple[float, float]:
        """Return how far pairwise registrations are from these poses, rms, in m and rad."""
        squares = (self.pairwise**2).mean(axis=0) if len(self.pairwise) else np.zeros(6)
        return float(np.sqrt(squares[:3].sum())), float(np.sqrt(squares[3:].sum()))


@dataclass
class _State:
    """What an interrupted alignment goes on from."""

    chain: Chain
    reasons: dict[int, str]
    stamps_ns: NDArray[np.int64]
    keyframes: NDArray[np.bool_]
    held: NDArray[np.bool_]
    moved: Array
    halves: Array
    first_poses: Array
    pairs: Array
    sweep: int = 1
    position: int = 0
    is_last: bool = False
    is_done: bool = False
    moves_m: list[float] = field(default_factory=list)
    compensated: bool = False
    smear: Smear | None = None
    carried: Carried | None = None


def align(
    recording: Recording,
    settings: AlignSettings = _DEFAULTS,
    start: PoseTrack | None = None,
    *,
    folder: Path | None = None,
    progress: Progress = lambda done, total: None,
) -> Alignment:
    """Find the poses of a recording's scans from the scans.

    start: poses to start from; without them odometry, else the poses of the recording, else none.
    folder: where scans and the state are kept, so that the same call goes on after an interrupt;
    without it a temporary one; of a finished alignment the poses stay there.  The result depends
    on the recording, start and seed alone.
    Raises RecordingError when fewer than 3 scans hold to one another.
    """
    with ExitStack() as stack:
        if folder is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="align-")))
        store = ScanStore(folder, 4 * N_BEFORE + 2)
        key = _key(recording, settings, start)
        state = _load(folder, key)
        if state is None:
            with _kept_if_begun(folder):
                state = _begin(recording, settings, start, store, progress)
                _save(folder, key, state)
        _sweep(state, store, settings, folder, key, progress)
    return _finished(recording.name, state)


@contextmanager
def _kept_if_begun(folder: Path) -> Iterator[None]:
    """Make a folder, and remove it where its first state is not reached: nothing can go on."""
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for path in made:
            shutil.rmtree(path, ignore_errors=True)
        raise


def _begin(
    recording: Recording,
    settings: AlignSettings,
    start: PoseTrack | None,
    store: ScanStore,
    progress: Progress,
) -> _State:
    """Read all scans once, keep them in the store and build the chain."""
    n = len(recording)
    reasons: dict[int, str] = {}
    stamps = np.zeros(n, np.int64)
    compensated = False

    def scans() -> Iterator[Placed]:
        nonlocal compensated
        last = b""
        for k, scan in enumerate(recording):
            progress(k + 1, n * (1 + MAX_SWEEPS))
            stamps[k] = scan.stamp_ns
            digest = hashlib.sha256(np.ascontiguousarray(scan.points).tobytes()).digest()
            if digest == last:
                reasons[k] = "repeats the scan before"
                continue
            try:
                cloud, has_times = _stored(k, scan, settings, store)
            except CloudError as error:
                reasons[k] = str(error)
                continue
            last = digest
            compensated |= has_times
            yield Placed(k, scan.stamp_ns, cloud, _start_pose(scan, start))

    chain = build_chain(scans(), n, settings.pipeline.icp, settings.seed)
    for k in np.flatnonzero(chain.part < 0):
        reasons.setdefault(int(k), "holds to none of the scans around it")
    if not (chain.part >= 0).any():
        raise RecordingError(_nothing(recording.name, n, reasons))
    return _first_state(chain, reasons, stamps, compensated)


def _stored(k: int, scan: Scan, settings: AlignSettings, store: ScanStore) -> tuple[Cloud, bool]:
    """Keep scan k; return its cloud and whether its points have times.  Raises CloudError."""
    pipeline, seed, _ = settings
    raw = filtered_scan(scan, pipeline.cloud, np.random.default_rng([seed, k]))
    store.add_raw(k, raw)
    cloud = with_shape(cloud_of(raw.points), pipeline.cloud)
    store.add_shaped(k, 0, ShapedScan(cloud.points, cloud.normals))
    return cloud, raw.time_s is not None


def _first_state(
    chain: Chain, reasons: dict[int, str], stamps: NDArray[np.int64], compensated: bool
) -> _State:
    """Return the state before the first sweep."""
    n = len(stamps)
    return _State(
        chain=chain,
        reasons=reasons,
        stamps_ns=stamps,
        keyframes=_keyframes(chain),
        held=chain.part >= 0,
        moved=np.zeros((n, 6)),
        halves=np.zeros((n, 6)),
        first_poses=chain.poses.copy(),
        pairs=np.zeros((n, 6)),
        compensated=compensated,
    )


def _start_pose(scan: Scan, start: PoseTrack | None) -> Array | None:
    if start is not None:
        return start.at(scan.stamp_ns)
    return scan.T_odom_sensor if scan.T_odom_sensor is not None else scan.T_world_sensor


def _nothing(name: str, n: int, reasons: dict[int, str]) -> str:
    if n < 3:
        return f"{name} has {counted(n, 'scan')}; aligning needs at least 3"
    counts: dict[str, int] = {}
    for reason in reasons.values():
        counts[reason] = counts.get(reason, 0) + 1
    most = max(counts, key=lambda reason: counts[reason])
    return f"no 3 of the {n} scans of {name} hold to one another; most often: a scan {most}"


def _keyframes(chain: Chain) -> NDArray[np.bool_]:
    """Return which scans others are registered to: the first of a part, then after each motion.

    A part that hardly moves has 17 of them, evenly spaced, or all of its scans.
    """
    is_key = np.zeros(len(chain.part), np.bool_)
    for p in range(int(chain.part.max()) + 1):
        members = np.flatnonzero(chain.part == p)
        longest = -(-len(members) // (2 * N_BEFORE + 1))
        last = -longest
        for at, k in enumerate(members):
            if at > 0:
                xi = log(inverse(chain.poses[members[last]]) @ chain.poses[k])
                moved = np.linalg.norm(xi[:3]) >= _KEYFRAME_M
                moved |= np.linalg.norm(xi[3:]) >= _KEYFRAME_RAD
            if at == 0 or moved or at - last >= longest:
                is_key[k], last = True, at
    return is_key


def _sweep(
    state: _State,
    store: ScanStore,
    settings: AlignSettings,
    folder: Path,
    key: str,
    progress: Progress,
) -> None:
    """Visit all scans until they rest; goes on where the state says."""
    members = np.flatnonzero(state.chain.part >= 0)
    n = len(state.chain.part)
    saved = time.monotonic()
    if state.is_done:
        return
    while True:
        order = members if state.sweep % 2 else members[::-1]
        done = set(order[: state.position].tolist())
        for k in order[state.position :].tolist():
            _visit(state, store, settings, k, done)
            done.add(k)
            state.position += 1
            progress(n * state.sweep + state.position, n * (1 + MAX_SWEEPS))
            if time.monotonic() - saved > _SAVE_S:
                _save(folder, key, state)
                saved = time.monotonic()
        state.moves_m.append(_median_move(state.moved[members, :3], state.chain.part[members]))
        if state.is_last:
            break
        rests = state.moves_m[-1] < _TOLERANCE_M and state.sweep >= _FEWEST_SWEEPS
        state.sweep, state.position = state.sweep + 1, 0
        state.is_last = rests or state.sweep == MAX_SWEEPS
        _save(folder, key, state)
    _register_pairs(state, store, settings)
    _look_at_scans(state, store, settings)
    state.is_done = True
    _save(folder, key, state)
    store.clear()


def _median_move(moved: Array, part: NDArray[np.int64]) -> float:
    """Return the median change of a step, m: what all scans of a part share moves no step."""
    steps = np.diff(moved, axis=0)[part[1:] == part[:-1]]
    return float(np.median(np.linalg.norm(steps, axis=1))) if len(steps) else 0.0


def _visit(
    state: _State, store: ScanStore, settings: AlignSettings, k: int, done: set[int]
) -> None:
    """Register a scan to its neighbours.

    The first sweep looks back only and takes the scans after it along: the drift of the chain is
    gone before scans on both sides hold a scan in place.
    """
    chain, sweep = state.chain, state.sweep
    is_first = sweep == 1
    is_member = (chain.part == chain.part[k]) & state.held
    is_member[k] = True
    members = np.flatnonzero(is_member)
    keyframes = members[state.keyframes[members]]
    if is_first:
        keyframes = keyframes[keyframes < k]
    around = neighbors_of(k, keyframes[keyframes != k]).tolist()
    neighbors = {j: store.shaped(j, sweep if j in done else sweep - 1) for j in around}
    own = own_points(store, k, motion_of(k, chain.poses, state.stamps_ns, members))
    if is_first and not neighbors:
        store.add_shaped(k, sweep, store.shaped(k, sweep - 1))
        return
    found = visit(k, chain.poses, neighbors, own, settings, state.is_last)
    if is_first:
        after = members[members > k]
        moved = exp(log(found.T @ inverse(chain.poses[k])))  # a rotation to rounding
        chain.poses[after] = moved @ chain.poses[after]
    chain.poses[k] = found.T
    state.held[k] = found.holds or is_first
    state.moved[k] = found.moved if found.holds else 0.0
    state.halves[k] = found.halves
    store.add_shaped(k, sweep, found.shaped)


def _register_pairs(state: _State, store: ScanStore, settings: AlignSettings) -> None:
    """Register each scan to the one before it alone, from the joint poses."""
    chain = state.chain
    for p in range(int(chain.part.max()) + 1):
        members = np.flatnonzero((chain.part == p) & state.held)
        clouds: dict[int, Cloud] = {}
        for i, j in pairwise(members.tolist()):
            for k in (i, j):
                if k not in clouds:
                    scan = store.shaped(k, state.sweep)
                    clouds[k] = cloud_of(scan.points, scan.normals)
            T = inverse(chain.poses[i]) @ chain.poses[j]
            rng = np.random.default_rng([settings.seed, j, i])
            found = register(clouds[j], clouds.pop(i), T, settings.pipeline.icp, rng)
            state.pairs[j] = log(inverse(T) @ found.T_ref_read)


def _look_at_scans(state: _State, store: ScanStore, settings: AlignSettings) -> None:
    """Find what may be wrong with the scans of the longest part: smeared, or with the vehicle.

    A vehicle has normals only in a single scan: those of all scans together are blurred by it.
    """
    poses = state.chain.poses
    members = np.flatnonzero((state.chain.part == 0) & state.held)

    def shaped(k: int) -> ShapedScan:
        return store.shaped(k, state.sweep)

    def alone(k: int) -> ShapedScan:
        cloud = with_shape(cloud_of(shaped(k).points), settings.pipeline.cloud)
        return ShapedScan(cloud.points, cloud.normals)

    if len(members) >= 3:
        state.carried = carried_of(poses, members, alone)
        if not state.compensated:
            state.smear = smear_of(poses, members, shaped, settings.seed)


def _finished(name: str, state: _State) -> Alignment:
    chain, reasons = state.chain, dict(state.reasons)
    part = chain.part.copy()
    for k in np.flatnonzero((part >= 0) & ~state.held):
        part[k] = -1
        reasons[int(k)] = "does not hold to its neighbours"
    for k in np.flatnonzero((part >= 0) & _torn(state.halves, part >= 0)):
        part[k] = -1
        reasons[int(k)] = f"halves of its neighbours put it {_words(state.halves[k])} apart"
    cut = _torn(state.pairs, part >= 0)
    part = _split(part, cut)
    for k in np.flatnonzero((part < 0) & (chain.part >= 0)):
        reasons.setdefault(int(k), "too few scans hold together around it")
    poses, covariances = chain.poses.copy(), np.zeros((len(part), 6, 6))
    for p in range(int(part.max(initial=-1)) + 1):
        members = np.flatnonzero(part == p)
        covariances[members] = _spread(state.halves[members])
        first = state.first_poses[members[0]] @ inverse(poses[members[0]])
        poses[members] = first @ poses[members]
    if not (part >= 0).any():
        raise RecordingError(_nothing(name, len(part), reasons))
    pairs = state.pairs[(part >= 0) & state.pairs.any(axis=1) & ~cut]
    return Alignment(
        name=name,
        stamps_ns=state.stamps_ns,
        poses=poses,
        covariances=covariances,
        part=part,
        reasons=dict(sorted(reasons.items())),
        pairwise=pairs,
        moves_m=tuple(state.moves_m),
        n_contradicted=chain.n_contradicted,
        n_searched=chain.n_searched,
        compensated=state.compensated,
        smear=None if state.smear is None else Smear(*state.smear),
        carried=None if state.carried is None else Carried(*state.carried),
    )


def _split(part: NDArray[np.int64], cut: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return parts, cut before some scans, of at least 3 scans, numbered from the longest."""
    pieces = [
        piece
        for p in range(int(part.max(initial=-1)) + 1)
        for members in [np.flatnonzero(part == p)]
        for piece in np.split(members, np.flatnonzero(cut[members]))
        if len(piece) >= 3
    ]
    found = np.full(len(part), -1)
    for p, piece in enumerate(sorted(pieces, key=lambda piece: -len(piece))):
        found[piece] = p
    return found


def _words(xi: Array) -> str:
    return f"{np.linalg.norm(xi[:3]):.3f} m and {np.linalg.norm(xi[3:]):.3f} rad"


def _torn(xi: Array, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which differences (n, 6) are large, and beyond what is usual in the recording."""
    torn = np.zeros(len(xi), np.bool_)
    for columns, least in ((slice(0, 3), _OUTLIER_M), (slice(3, 6), _OUTLIER_RAD)):
        apart = np.linalg.norm(xi[:, columns], axis=1)
        torn |= apart > max(least, _OUTLIER * float(np.median(apart[known])))
    return torn


def _spread(halves: Array) -> Array:
    """Return the covariance (m, 6, 6) of each pose from the half-sets (m, 6) around it.

    A full set errs by half of what its halves differ by.  So few differences give no shape: half
    of the covariance is theirs, half is alike in all directions.
    """
    outer = halves[:, :, None] * halves[:, None, :] / 4.0
    around = [slice(max(0, k - _SPREAD), k + _SPREAD + 1) for k in range(len(halves))]
    local = np.array([outer[rows].mean(axis=0) for rows in around])
    variances = np.diagonal(local, axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=2)
    even = np.repeat(variances, 3, axis=1)[:, :, None] * np.eye(6)
    floor = np.diag(np.repeat([_FLOOR_M**2, _FLOOR_RAD**2], 3))
    return np.asarray(_FACTOR**2 * 0.5 * (local + even) + floor)


def _key(recording: Recording, settings: AlignSettings, start: PoseTrack | None) -> str:
    """Return what tells apart alignments: recording, settings and start."""
    pipeline, seed, _ = settings
    digest = hashlib.sha256(f"{fingerprint(recording)} {len(recording)} {seed}".encode())
    digest.update(repr((pipeline.cloud, pipeline.icp, _VERSION)).encode())
    for stamp_ns, T in start or ():
        digest.update(f"{stamp_ns}".encode() + T.tobytes())
    return digest.hexdigest()[:32]


def _save(folder: Path, key: str, state: _State) -> None:
    chain = state.chain
    facts = {
        "key": key,
        "reasons": {str(k): reason for k, reason in state.reasons.items()},
        "n_contradicted": chain.n_contradicted,
        "n_searched": chain.n_searched,
        **{name: getattr(state, name) for name in _FACTS},
    }
    with new_file(folder / _STATE) as path, path.open("wb") as file:
        np.savez(
            file,
            facts=np.frombuffer(json.dumps(facts).encode(), np.uint8),
            poses=chain.poses,
            part=chain.part,
            **{name: getattr(state, name) for name in _ARRAYS},
        )


def _load(folder: Path, key: str) -> _State | None:
    """Return the state in a folder; None where there is none.

    Raises RecordingError where it is that of another alignment or damaged.
    """
    path = folder / _STATE
    if not path.exists():
        return None
    try:
        with np.load(path) as file:
            arrays = dict(file)
        facts = json.loads(arrays["facts"].tobytes())
        if facts["key"] != key:
            raise RecordingError(
                f"{folder} holds the alignment of another recording or start; remove it"
            )
        chain = Chain(
            arrays["poses"],
            arrays["part"],
            facts["n_contradicted"],
            facts["n_searched"],
        )
        return _State(
            chain=chain,
            reasons={int(k): reason for k, reason in facts["reasons"].items()},
            **{name: arrays[name] for name in _ARRAYS},
            **{name: facts[name] for name in _FACTS},
        )
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        raise RecordingError(f"{path} is damaged; remove {folder} to start again") from None
