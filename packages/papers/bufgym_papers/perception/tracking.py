"""Camera tracking by KinectFusion on the frames that arrived alone, and where it fails.

See packages/papers/PERCEPTION.md, "Tracking".
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from bufgym.traces.poses import rotations
from bufgym.traces.trace import Float64Array
from bufgym.utils.errors import BufgymError
from bufgym_papers.perception import icp, tsdf
from bufgym_papers.perception.frames import Camera, Depth, Sequence
from bufgym_papers.perception.mapping import FAR_M, Map, VoxelGrid, grid_of

LEVELS: Final = ((4, 10), (2, 5), (1, 2))
"""(stride, most steps) from coarse to fine. KinectFusion takes four steps at the finest; with two the results here are
the same, a millisecond faster."""
MODEL_WIDTH: Final = 80
"""About the pixels per row through which the model is seen: every second of 160. They are 2.7 cm apart at 2 m, finer
than voxels."""
SMALL_STEP: Final = 3e-4  # Step below which a level ends early, rad and m
SAME_SURFACE: Final = 0.05  # Largest relative difference of neighbouring pixels' distances on one surface
SMOOTH_RADIUS: Final = 2  # Depths are smoothed over 5x5 pixels, within one surface, before normals are taken
MOST_WEIGHT: Final = 64.0  # Limit on frames in the model's running mean, which forgets as in KinectFusion
APART_M: Final = 0.1  # Pairs farther apart than this are none, m
APART_DEG: Final = 30.0  # Nor are pairs whose normals differ by more, degrees
LEAST_PAIRS: Final = 0.3  # Lost if fewer of the frame's points than this share have a pair
MOST_ERROR_M: Final = 0.1  # Lost if one step is off by more, m
MOST_ERROR_DEG: Final = 5.0  # Lost if the turn of one step is off by more, degrees


@dataclass(frozen=True, eq=False)
class Track:
    poses: Float64Array
    """float64[m, 4, 4], the poses found for the frames that arrived, camera to world; NaN from the failure on."""
    where: int | None  # the frame (index of the sequence) at which tracking failed; None if it never did
    model: Map  # map of the frames until then, at the poses found

    @property
    def failed(self) -> bool:
        return self.where is not None


def smoothed(depth: Depth) -> Depth:
    result = np.empty_like(depth)
    icp.smooth(depth, SMOOTH_RADIUS, SAME_SURFACE / 2, result)
    return result


def track(
    sequence: Sequence,
    frames: Iterable[int],
    grid: VoxelGrid | None = None,
    smooth: Callable[[int], Depth] | None = None,
) -> Track:
    """Follow the camera through the frames that arrived, in order, until that fails.

    ``sequence`` is meant to be reduced to about 160x120. ``smooth`` returns `smoothed` of frame k, for callers that
    keep it.
    """
    arrived = np.array(list(frames), np.int64)
    if not len(arrived) or (np.diff(arrived) <= 0).any() or arrived[0] < 0 or arrived[-1] >= len(sequence):
        raise BufgymError(f"frames: must be at least one index below {len(sequence)}, increasing")
    poses = np.full((len(arrived), 4, 4), np.nan)
    truth = sequence.poses[arrived]
    poses[0] = truth[0]
    tracker = Tracker(sequence.camera, grid or grid_of(sequence))
    tracker.add(sequence.depth(int(arrived[0])), poses[0])
    for n, k in enumerate(arrived.tolist()[1:], 1):
        pose = tracker.follow(sequence.depth(k), smooth(k) if smooth else None)
        if pose is None or jumped(poses[n - 1], pose, truth[n - 1], truth[n]):
            return Track(poses, k, tracker.model)
        poses[n] = pose
    return Track(poses, None, tracker.model)


def jumped(before: Float64Array, pose: Float64Array, true_before: Float64Array, truth: Float64Array) -> bool:
    """Whether the step between two poses is too far from the true step."""
    off_m, off_deg = difference(np.linalg.inv(before) @ pose, np.linalg.inv(true_before) @ truth)
    return off_m > MOST_ERROR_M or off_deg > MOST_ERROR_DEG


def difference(pose: Float64Array, truth: Float64Array) -> tuple[float, float]:
    """Distance between two poses, m and degrees."""
    turn = pose[:3, :3].T @ truth[:3, :3]
    sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    angle = np.arctan2(sine, np.trace(turn) - 1)  # the arc cosine would lose small angles
    return float(np.linalg.norm(pose[:3, 3] - truth[:3, 3])), float(np.degrees(angle))


class Tracker:
    """A growing model and the camera's pose in it."""

    def __init__(self, camera: Camera, grid: VoxelGrid) -> None:
        self.model = Map.empty(grid)
        self.pose = np.eye(4)
        self._camera, self._lens = camera, camera.lens
        stride = max(1, camera.width // MODEL_WIDTH)
        self._stride = 1 if camera.height % stride or camera.width % stride else stride
        model_camera = camera.every(self._stride)
        self._model_lens = model_camera.lens
        shape, model_shape = ((c.height, c.width, 3) for c in (camera, model_camera))
        self._normals = np.zeros(shape, np.float32)
        self._seen, self._seen_normals = np.zeros(model_shape, np.float32), np.zeros(model_shape, np.float32)
        self._jacobian, self._sums = np.zeros(8), np.zeros((8, 8))
        self._hint: Depth = np.zeros(model_shape[:2], np.float32)

    def follow(self, depth: Depth, smooth: Depth | None = None) -> Float64Array | None:
        """Find the pose of the next frame, camera to world, and add it to the model; None if it is lost.

        ``smooth`` is the frame's `smoothed` depth, if known.
        """
        pose = self._aligned(smoothed(depth) if smooth is None else smooth)
        if pose is not None:
            self.add(depth, pose)
        return pose

    def add(self, depth: Depth, pose: Float64Array) -> None:
        self.pose, self._hint = pose, np.ascontiguousarray(depth[:: self._stride, :: self._stride])
        self.model.add(depth, self._camera, pose, MOST_WEIGHT)

    def _aligned(self, smooth: Depth) -> Float64Array | None:
        model, grid, lens, pose = self.model, self.model.grid, self._lens, self.pose
        self._points = icp.unproject(smooth, FAR_M, lens)
        icp.orient(self._points, np.zeros(3), SAME_SURFACE, self._normals)
        place = np.array(grid.origin_m), grid.voxel_m, grid.truncation_m, FAR_M, self._model_lens, pose
        tsdf.raycast(model.tsdf, model.weight, *place, self._hint, self._seen)
        icp.orient(self._seen, np.ascontiguousarray(pose[:3, 3]), SAME_SURFACE, self._seen_normals)
        to_model_camera = np.asarray(np.linalg.inv(pose), np.float64)
        for stride, most_steps in LEVELS:
            for _ in range(most_steps):
                step = self._step(stride, pose, to_model_camera)
                if step is None:
                    return None
                pose = _moved(pose, step)
                if np.abs(step).max() < SMALL_STEP:
                    break
        return pose

    def _step(self, stride: int, pose: Float64Array, to_model_camera: Float64Array) -> Float64Array | None:
        """The rotation and translation that bring the points into the model's planes; None if too few have a pair."""
        model = self._seen, self._seen_normals, to_model_camera, self._model_lens
        limits = APART_M, float(np.cos(np.radians(APART_DEG)))
        points = icp.normal_equations(
            self._points, self._normals, stride, pose, *model, *limits, self._jacobian, self._sums
        )
        if self._sums[7, 7] < max(6.0, LEAST_PAIRS * points):
            return None
        try:
            return np.asarray(np.linalg.solve(self._sums[:6, :6], -self._sums[:6, 6]), np.float64)
        except np.linalg.LinAlgError:  # the view leaves a direction open, such as a single wall
            return None


def _moved(pose: Float64Array, step: Float64Array) -> Float64Array:
    """Apply a small rotation about the world's origin, rad, and a translation, m."""
    angle = float(np.linalg.norm(step[:3]))
    axis = step[:3] / angle if angle > 0 else step[:3]
    quaternion = np.append(np.sin(angle / 2) * axis, np.cos(angle / 2))
    change = np.eye(4)
    change[:3, :3], change[:3, 3] = rotations(quaternion[None])[0], step[3:]
    return np.asarray(change @ pose, np.float64)
