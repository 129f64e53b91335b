"""3-D rendering of the view state: cameras as frusta, rays to present detections, trajectories, uncertainty."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hub.view.panels import SIGNS, track_text
from hub.view.state import CameraState, CameraView, PathView, ViewState
from protocols.core.jpeg import decode_jpeg
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats

if TYPE_CHECKING:
    import viser

Points32 = npt.NDArray[np.float32]

COLOURS: dict[CameraState, tuple[int, int, int]] = {
    "calibrated": (30, 110, 190),
    "degraded": (150, 90, 160),
    "searching": (120, 120, 120),
    "refused": (200, 60, 30),
    "collecting": (120, 120, 120),
    "silent": (200, 140, 0),
    "gone": (190, 190, 190),
}
_PATHS = ((214, 96, 20), (30, 130, 90), (120, 70, 170), (20, 120, 160), (170, 40, 90))
"""RGB, for the colour-blind too."""
_IMAGES_PER_S = 24.0  # over all cameras: decoding and encoding one image costs 2 ms
_PATH_S = 20.0  # length of the trajectory that is drawn [s]
_FADE_S = 1.0  # how often a trajectory fades: between, only what is new is sent [s]
_MAX_GAP_S = 0.5  # a longer gap is not bridged
_DASH_S = 0.1  # of the dashes while a track coasts
_HEAD_OPACITY = {"confirmed": None, "tentative": 0.5, "coasting": 0.6, "stale": 0.25}
_HINT_WIDTH = 34  # letters
_ELEVATION = math.radians(35.0)  # of the initial viewpoint
_TAN_HALF_FOV = 0.9 * math.tan(math.radians(75.0) / 2)  # of viser's default camera, less a margin for labels


class DisplayOptions:
    """Display options of the view. uncertainty_scale: magnification of the drawn uncertainties."""

    def __init__(self) -> None:
        self.pictures = True
        self.rays = True
        self.paths = True
        self.uncertainty = True
        self.uncertainty_scale = 10.0


class SceneRenderer:
    """Keeps viser's scene up to date with the view state; sends only changes."""

    def __init__(self, server: viser.ViserServer, options: DisplayOptions) -> None:
        self._scene = server.scene
        self._server = server
        self.options = options
        self._frusta: dict[str, Any] = {}
        self._labels: dict[str, Any] = {}
        self._ellipsoids: dict[str, Any] = {}
        self._paths: dict[str, Any] = {}
        self._numbers: dict[str, int] = {}
        self._faded: dict[str, float] = {}
        self._placed: dict[str, Pose] = {}
        self._lenses: dict[str, Intrinsics | None] = {}
        self._drawn: dict[str, Any] = {}
        self._rays: Any = None
        self._hint: Any = None
        self._size = 1.0
        self._picture_budget, self._budget_at = 1.0, 0.0
        self._framed: tuple[Floats, float] | None = None

    def clear(self) -> None:
        """Remove everything, as before a seek in a replay."""
        for handles in (self._frusta, self._labels, self._ellipsoids, self._paths):
            for handle in handles.values():
                handle.remove()
            handles.clear()
        if self._rays is not None:
            self._rays.remove()
            self._rays = None
        self._drawn.clear()
        self._numbers.clear()
        self._faded.clear()

    def update(self, state: ViewState, now: float) -> None:
        """Draw what has changed."""
        with self._server.atomic():
            placed = self._poses(state)
            self._remove_cameras(set(placed))
            if placed:
                self._fit_scene(placed, state)
                for name, pose in placed.items():
                    self._draw_camera(state.cameras[name], pose, now)
            self._draw_hint(state, bool(placed))
            self._draw_rays(state, placed, now)
            self._draw_tracks(state, now)
        if placed and self.options.pictures:
            self._draw_pictures(state, placed, now)

    def update_tracks(self, state: ViewState, now: float) -> None:
        """Draw what moves at camera rate, the rays and the tracks: cheap enough for every cycle."""
        with self._server.atomic():
            self._draw_rays(state, self._poses(state), now)
            self._draw_tracks(state, now)

    def _poses(self, state: ViewState) -> dict[str, Pose]:
        """The known poses of the cameras; with the lenses, computed anew for a new calibration only."""
        key = (id(state), state.revision, sum(camera.info is not None for camera in state.cameras.values()))
        if self._drawn.get("poses") != key:
            self._drawn["poses"] = key
            poses = ((name, camera.pose) for name, camera in state.cameras.items())
            self._placed = {name: pose for name, pose in poses if pose is not None}
            self._lenses = {name: _lens(state.cameras[name]) for name in self._placed}
        return self._placed

    def _draw_hint(self, state: ViewState, is_placed: bool) -> None:
        """What to do, in the middle of an empty scene."""
        steps = [] if is_placed else state.next_steps()
        # Instead of it, images of cameras or of a drone may be shown.
        images = any(self._scene.get_handle_by_name(f"/pictures/{name}") is not None for name in state.cameras)
        text = "" if images or not steps else "\n".join(textwrap.wrap(steps[0], _HINT_WIDTH))
        if self._drawn.get("hint", "") == text:
            return
        self._drawn["hint"] = text
        if self._hint is None:
            self._hint = self._scene.add_label(
                "/hint", text, position=(0, 0, 1.2), anchor="center-center", font_screen_scale=1.4
            )
        self._hint.text, self._hint.visible = text, bool(text)

    def _fit_scene(self, placed: dict[str, Pose], state: ViewState) -> None:
        """Set symbol size, ground grid and initial viewpoint from the positions of cameras and points."""
        centres = np.array([pose.position for pose in placed.values()])
        key = (tuple(np.round(centres.ravel(), 2)), any(path.points for path in state.paths.values()))
        if self._drawn.get("measure") == key:
            return
        self._drawn["measure"] = key
        points = [path.array()[:, 1:4] for path in state.paths.values() if path.points]
        everything = np.concatenate([centres, *points])
        low, high = np.percentile(everything, [2, 98], axis=0)
        extent = max(float(np.linalg.norm(high - low)), 1e-6)
        up = _up(placed)
        self._size = extent
        self._scene.set_up_direction(tuple(up))
        floor = (low + high) / 2 - up * float(np.max(np.abs((everything - (low + high) / 2) @ up)))
        self._scene.add_grid(
            "/ground",
            width=3 * extent,
            height=3 * extent,
            cell_size=_round(extent / 10),
            section_size=5 * _round(extent / 10),
            position=tuple(floor),
            wxyz=_quaternion_z_to(up),
        )
        path = np.concatenate(points) if points else np.empty((0, 3))
        # The viewpoint includes every camera, but not the outliers of a trajectory.
        near = path[((path >= low) & (path <= high)).all(axis=1)]
        eye, middle = fit_viewpoint(np.concatenate([centres, near]), up, 0.1 * extent)
        if self._framed is None or np.linalg.norm(self._framed[0] - middle) > self._framed[1] / 3:
            # Move the viewpoint only if the scene has moved substantially.
            self._framed = (middle, extent)
            set_viewpoint(self._server, eye, middle, up)

    def _draw_camera(self, camera: CameraView, pose: Pose, now: float) -> None:
        status = camera.state(now)
        found = camera.calibration
        assert found is not None
        name, scale = camera.name, 0.07 * self._size
        wxyz, position = so3.quaternion(pose.rotation.T), pose.position
        place = (tuple(position), tuple(wxyz), status, round(scale, 3))
        if self._drawn.get(f"camera {name}") != place:
            self._drawn[f"camera {name}"] = place
            frustum = self._frusta.get(name)
            if frustum is None:
                fov, aspect = _field_of_view(camera)
                frustum = self._scene.add_camera_frustum(
                    f"/cameras/{name}", fov=fov, aspect=aspect, scale=scale, thickness=2.0, thickness_units="screen",
                    wxyz=wxyz, position=position,
                )  # fmt: skip
                self._frusta[name] = frustum
                self._labels[name] = self._scene.add_label(f"/labels/{name}", "", anchor="bottom-center")
            frustum.wxyz, frustum.position = wxyz, position
            frustum.scale, frustum.color = scale, COLOURS[status]
            self._labels[name].position = position + 0.25 * scale * _up({name: pose})
        std_ms = 1e3 * found.time_offset_std
        sharp = f"± {std_ms:.2g} ms" if std_ms > 0.0 else "" if found.time_offset else "reference clock"
        text = f"{SIGNS[status]} {name}  {sharp if status == 'calibrated' else status}"
        if self._drawn.get(f"text {name}") != text:
            self._drawn[f"text {name}"] = text
            self._labels[name].text = text
        self._draw_uncertainty(f"/uncertainty/{name}", pose.position, np.array(found.position_std), COLOURS[status])

    def _draw_uncertainty(self, name: str, centre: Floats, std: Floats, colour: tuple[int, int, int]) -> None:
        """An ellipsoid of three standard deviations, magnified by ``uncertainty_scale``."""
        wanted = self.options.uncertainty and len(std) == 3 and float(np.max(std)) > 0.0
        radii = tuple(np.maximum(3.0 * self.options.uncertainty_scale * std, 1e-9)) if wanted else ()
        key = (tuple(centre), radii)
        if self._drawn.get(name) == key:
            return
        self._drawn[name] = key
        ellipsoid = self._ellipsoids.get(name)
        if not wanted:
            if ellipsoid is not None:
                ellipsoid.visible = False
            return
        if ellipsoid is None:
            ellipsoid = self._scene.add_icosphere(name, 1.0, colour, subdivisions=2, opacity=0.35)
            self._ellipsoids[name] = ellipsoid
        ellipsoid.position, ellipsoid.scale, ellipsoid.visible = centre, radii, True

    def _draw_rays(self, state: ViewState, placed: dict[str, Pose], now: float) -> None:
        """A line from each camera towards its present detections, as long as the distance of the last point."""
        starts, ends = [], []
        last = [path.points[-1][1:4] for path in state.paths.values() if path.points]
        for name, pose in placed.items() if self.options.rays else ():
            camera = state.cameras[name]
            lens = self._lenses.get(name)
            if lens is None or camera.last_seen is None or now - camera.last_seen > 0.3 or not camera.detections:
                continue
            pixels = np.array([[u, v] for u, v, _ in camera.detections[:16]])
            rays = lens.unproject(pixels)
            far = min((float(np.linalg.norm(np.array(p) - pose.position)) for p in last), default=self._size)
            seen = np.column_stack([rays, np.ones(len(rays))])
            seen = seen / np.linalg.norm(seen, axis=1, keepdims=True) * far
            starts += [pose.position] * len(rays)
            ends += list(pose.world_from_camera(seen))
        intersection = _nearest_point(np.array(starts), np.array(ends), 0.05 * self._size)
        points = np.array(
            [[start, end if intersection is None else intersection] for start, end in zip(starts, ends, strict=True)],
            dtype=np.float32,
        ).reshape(-1, 2, 3)
        key = points.tobytes()
        if self._drawn.get("rays") == key:
            return
        self._drawn["rays"] = key
        if not len(points):
            if self._rays is not None:
                self._rays.visible = False
            return
        if self._rays is None:
            colour = COLOURS["calibrated"]
            self._rays = self._scene.add_line_segments("/rays", points, colour, thickness=1.5, thickness_units="screen")
        self._rays.points, self._rays.visible = points, True

    def _draw_tracks(self, state: ViewState, now: float) -> None:
        for label in [label for label in self._numbers if label not in state.paths]:
            key = f"/paths/{self._numbers.pop(label)}"
            for name in (key, f"{key}/recent", f"{key}/head", f"{key}/label"):
                if name in self._paths:
                    self._paths.pop(name).remove()
            self._draw_uncertainty(f"/uncertainty{key}", np.zeros(3), np.zeros(0), (0, 0, 0))
            self._drawn.pop(f"path {label}", None)
            self._faded.pop(key, None)
        options = (self.options.paths, self.options.uncertainty_scale, self.options.uncertainty, self._size)
        for label, path in state.paths.items():
            if label not in self._numbers:
                free = set(range(len(self._numbers) + 1)) - set(self._numbers.values())
                self._numbers[label] = min(free)
            drawn = (path.count, path.state(now), int(now - path.at), len(state.paths), *options)
            if self._drawn.get(f"path {label}") != drawn:
                self._drawn[f"path {label}"] = drawn
                key, paint = f"/paths/{self._numbers[label]}", _PATHS[self._numbers[label] % len(_PATHS)]
                self._draw_trail(key, path, paint)
                self._draw_head(key, path, paint, now, named=len(state.paths) > 1)

    def _draw_trail(self, key: str, path: PathView, paint: tuple[int, int, int]) -> None:
        """The trajectory: what is older than ``_FADE_S`` is sent that often, what is newer each time."""
        newest = path.points[-1][0]
        faded = self._faded.get(key)
        if faded is None or not 0.0 <= newest - faded < _FADE_S:
            # From the newest point that is certainly kept.
            self._faded[key] = faded = path.points[-min(2, len(path.points))][0]
            segments, times = trail_segments(path.array(newest - _PATH_S))
            fade = 0.75 * np.clip((newest - times) / _PATH_S, 0.0, 1.0)[:, None]
            shades = np.repeat(((1 - fade) * paint + fade * 235)[:, None], 2, axis=1).astype(np.uint8)
            self._draw_lines(key, segments, shades)
        self._draw_lines(f"{key}/recent", trail_segments(path.array(faded))[0], np.array(paint, dtype=np.uint8))

    def _draw_lines(self, name: str, segments: Points32, colours: npt.NDArray[np.uint8]) -> None:
        lines = self._paths.get(name)
        visible = self.options.paths and len(segments) > 0
        if not visible:
            if lines is not None:
                lines.visible = False
        elif lines is None:
            self._paths[name] = self._scene.add_line_segments(
                name.replace("/recent", "-recent"), segments, colours, thickness=3.0, thickness_units="screen"
            )
        else:
            lines.points, lines.colors, lines.visible = segments, colours, True

    def _draw_head(self, key: str, path: PathView, paint: tuple[int, int, int], now: float, *, named: bool) -> None:
        """A ball at the newest point, hollow while the track coasts, and what it is in words if it is not confirmed."""
        status, (_, *place, std, _) = path.state(now), path.points[-1]
        head, label = self._paths.get(f"{key}/head"), self._paths.get(f"{key}/label")
        if head is None or label is None:
            head = self._scene.add_icosphere(f"{key}-head", 1.0, paint, subdivisions=1)
            label = self._scene.add_label(f"{key}-label", "", anchor="bottom-left")
            self._paths[f"{key}/head"], self._paths[f"{key}/label"] = head, label
        head.position, head.scale = np.array(place), 0.012 * self._size
        head.wireframe, head.opacity = status == "coasting", _HEAD_OPACITY.get(status)
        text = "" if status == "confirmed" and not named else track_text(path, now)
        label.position, label.text, label.visible = np.array(place), text, bool(text)
        stds = np.full(0 if status == "stale" else 3, std)
        self._draw_uncertainty(f"/uncertainty{key}", np.array(place), stds, paint)

    def _draw_pictures(self, state: ViewState, placed: dict[str, Pose], now: float) -> None:
        """Show the newest images in the frusta, those that have waited longest first."""
        elapsed, self._budget_at = now - self._budget_at, now
        self._picture_budget = min(self._picture_budget + elapsed * _IMAGES_PER_S, _IMAGES_PER_S)
        waiting = [
            (self._drawn.get(f"picture at {name}", -math.inf), name)
            for name in placed
            if state.cameras[name].picture is not None
            and self._drawn.get(f"picture {name}") != state.cameras[name].pictures
        ]
        for _, name in sorted(waiting):
            if self._picture_budget < 1.0:
                return
            self._picture_budget -= 1.0
            camera = state.cameras[name]
            assert camera.picture is not None
            self._drawn[f"picture {name}"], self._drawn[f"picture at {name}"] = camera.pictures, now
            image = decode_rgb(camera.picture.jpeg)
            if image is not None:
                self._frusta[name].image = image

    def _remove_cameras(self, placed: set[str]) -> None:
        for name in set(self._frusta) - placed:
            self._frusta.pop(name).remove()
            self._labels.pop(name).remove()
            ellipsoid = self._ellipsoids.pop(f"/uncertainty/{name}", None)
            if ellipsoid is not None:
                ellipsoid.remove()
            for key in [key for key in self._drawn if key.endswith((f" {name}", f"/{name}"))]:
                del self._drawn[key]


def trail_segments(table: Floats) -> tuple[Points32, Floats]:
    """The lines (m, 2, 3) of a trajectory and their times (m,) [s]: no line over a gap, dashes where it coasts.

    table: as `PathView.array`.
    """
    times, coasting = table[1:, 0], table[1:, 5] > 0.0
    kept = (np.diff(table[:, 0]) < _MAX_GAP_S) & ~(coasting & ((times / _DASH_S).astype(np.int64) % 2 == 1))
    segments = np.stack([table[:-1, 1:4], table[1:, 1:4]], axis=1)[kept]
    return segments.astype(np.float32), times[kept]


def fit_viewpoint(points: Floats, up: Floats, radius: float) -> tuple[Floats, Floats]:
    """Eye position and look-at point, (3,) each, from which all of ``points`` (n, 3) are in view with a margin.

    radius: the margin around each point. The elevation is 35 degrees, and the widest horizontal direction of the points
    is parallel to the image. A point at depth d is in view within d tan(fov / 2) of the axis, so each point gives a
    lower limit of the distance.
    """
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    centred = points - middle
    horizontal = centred - np.outer(centred @ up, up)
    _, _, axes = np.linalg.svd(horizontal)
    widest = axes[0] - (axes[0] @ up) * up
    if np.linalg.norm(widest) < 0.1:
        widest = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    # The sign of a singular vector is arbitrary: fix it, so that a scene is always viewed from the same side.
    widest = widest / np.linalg.norm(widest)
    widest = widest * math.copysign(1.0, widest[int(np.argmax(np.abs(widest)))])
    towards = math.cos(_ELEVATION) * np.cross(widest, up) + math.sin(_ELEVATION) * up
    depth = centred @ towards
    lateral = np.maximum(np.abs(centred @ widest), np.abs(centred @ np.cross(towards, widest)))
    distance = float(np.max((lateral + radius) / _TAN_HALF_FOV + depth + radius))
    return middle + distance * towards, middle


def set_viewpoint(server: viser.ViserServer, eye: Floats, middle: Floats, up: Floats) -> None:
    """Move the viewpoint of all browsers, and of those that come."""
    server.initial_camera.position, server.initial_camera.look_at, server.initial_camera.up = eye, middle, up
    for client in server.get_clients().values():
        client.camera.up_direction = up
        client.camera.position = eye
        client.camera.look_at = middle


def _nearest_point(starts: Floats, ends: Floats, tolerance: float) -> Floats | None:
    """Least-squares intersection (3,) of rays (n, 3) to (n, 3), None if a ray misses it by more than ``tolerance``.

    The rays are simultaneous only by their time of arrival: accurate enough for drawing, not for measuring.
    """
    if len(starts) < 2:
        return None
    along = ends - starts
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    try:
        point = np.linalg.solve(across.sum(axis=0), (across @ starts[:, :, None]).sum(axis=0)[:, 0])
    except np.linalg.LinAlgError:
        return None
    off = np.linalg.norm((across @ (point - starts)[:, :, None])[:, :, 0], axis=1)
    return np.asarray(point) if float(off.max()) < tolerance else None


def decode_rgb(jpeg: bytes) -> Any:
    """A JPEG decoded to (H, W, 3) RGB; None if it is invalid or too large."""
    image = decode_jpeg(jpeg)
    return None if image is None else np.ascontiguousarray(image[..., ::-1])


def _lens(camera: CameraView) -> Intrinsics | None:
    found, info = camera.calibration, camera.info
    if found is None or len(found.matrix) != 9:
        return None
    matrix = found.matrix  # its principal point is in the middle, where the size is unknown
    guess = max(round(2 * matrix[2] + 1), 1), max(round(2 * matrix[5] + 1), 1)
    size = guess if info is None else (info.width, info.height)
    return Intrinsics.of_message(found, size)


def _field_of_view(camera: CameraView) -> tuple[float, float]:
    """(vertical field of view [rad], aspect) of a frustum."""
    lens = _lens(camera)
    if lens is None:
        return 0.8, 1.5
    return min(2 * math.atan(0.5 * lens.height / float(lens.matrix[1, 1])), 2.5), lens.width / lens.height


def _up(placed: dict[str, Pose]) -> Floats:
    """Up as the mean of the cameras' up directions; z if they disagree."""
    mean = np.mean([pose.rotation.T @ np.array([0.0, -1.0, 0.0]) for pose in placed.values()], axis=0)
    norm = float(np.linalg.norm(mean))
    if norm < 0.2:
        return np.array([0.0, 0.0, 1.0])
    mean = mean / norm
    axis = np.zeros(3)
    axis[int(np.argmax(np.abs(mean)))] = math.copysign(1.0, mean[int(np.argmax(np.abs(mean)))])
    # A world axis that is nearly up is taken as up.
    return axis if float(axis @ mean) > 0.8 else mean


def _quaternion_z_to(up: Floats) -> Floats:
    """Quaternion (w, x, y, z) of the rotation from z to ``up``."""
    w = 1.0 + float(up[2])
    if w < 1e-9:
        return np.array([0.0, 1.0, 0.0, 0.0])
    turn = np.array([w, -up[1], up[0], 0.0])
    return np.asarray(turn / np.linalg.norm(turn))


def _round(length: float) -> float:
    """The length rounded up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(length))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= length)
