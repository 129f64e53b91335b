"""A calibrated camera for tracking, and the detections of one frame in normalised coordinates and reference time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hub.tracking.filter.target_models import KIND_INDEX
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats, Ints
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration

_DEFAULT_STD_PX = 1.5
"""Of a detection without a covariance."""
MIN_STD_PX = 0.2  # the best detectors reach 0.1 px; added to every covariance
_BORDER = 0.02
"""Border as a fraction of the image's sides in which no detection is expected: targets are truncated there."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackingCamera:
    """One calibrated camera. boot_id: the boot whose clock the time map refers to; "" = any.

    time_std: of the time map's offset [s]. noise_px: root mean square of the calibration's residuals. readout: seconds
    from the image's first row to its last. extrinsics: (12,) rotation, by rows, and position. low, high: (2,) corners
    of the image without its border, in normalised coordinates.
    """

    name: str
    intrinsics: Intrinsics
    pose: Pose
    time_map: TimeMap
    time_std: float = 0.0
    noise_px: float = 0.0
    boot_id: str = ""
    readout: float = 0.0
    extrinsics: Floats = field(init=False)
    low: Floats = field(init=False)
    high: Floats = field(init=False)

    def __post_init__(self) -> None:
        lens = self.intrinsics
        object.__setattr__(self, "extrinsics", np.concatenate([self.pose.rotation.ravel(), self.pose.position]))
        x, y = np.linspace(_BORDER, 1 - _BORDER, 9) * lens.width, np.linspace(_BORDER, 1 - _BORDER, 9) * lens.height
        edge = np.concatenate([[(u, v) for u in x for v in (y[0], y[-1])], [(u, v) for u in (x[0], x[-1]) for v in y]])
        border = lens.unproject(np.asarray(edge))
        object.__setattr__(self, "low", np.nanmin(border, axis=0))
        object.__setattr__(self, "high", np.nanmax(border, axis=0))

    @classmethod
    def from_calibration(cls, camera: CameraCalibration, boot_id: str = "") -> TrackingCamera:
        """From a solved calibration."""
        return cls(
            camera.name,
            camera.intrinsics,
            camera.pose,
            camera.time_map,
            camera.time_offset_std,
            min(camera.rms_px, 5.0),
            boot_id,
            camera.readout,
        )

    def reference_ns(self, device_time_ns: int) -> int:
        """The reference time [ns] of a time on the camera's clock; Unix times as floats would be too coarse."""
        rate, offset = self.time_map.clock_rate, self.time_map.time_offset
        return device_time_ns + round((rate - 1.0) * device_time_ns) + round(offset * NANOSECONDS)

    def device_ns(self, reference_ns: int) -> int:
        """The inverse of `reference_ns`, to a nanosecond."""
        behind = reference_ns - round(self.time_map.time_offset * NANOSECONDS)
        return behind - round((1.0 - 1.0 / self.time_map.clock_rate) * behind)

    def sees(self, normalised: Floats, depth: Floats) -> Bools:
        """Whether points (n, 2), normalised, at depths (n,) are inside the image without its border."""
        with np.errstate(invalid="ignore"):
            inside = ((normalised > self.low) & (normalised < self.high)).all(axis=1)
        return np.asarray(inside & (depth > 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class FrameDetections:
    """The n detections of one frame in normalised image coordinates, NaN where missing.

    reference_ns: capture time on the reference clock. point, head, foot: (n, 2). noise: (n, 2, 2) covariance of the
    point; units_per_px: (n,) normalised units per pixel there. size: (n,). colour: (n, 3). kind: (n,) index in
    TARGET_MODELS. target: label of the track that the camera's own tracker matched, "" = none. is_box: (n,) whether
    head and foot are the middles of a box's top and bottom: in one column of the image.
    """

    camera: TrackingCamera
    reference_ns: int
    boot_id: str
    sequence: int
    point: Floats
    noise: Floats
    units_per_px: Floats
    head: Floats
    foot: Floats
    size: Floats
    colour: Floats
    kind: Ints
    target: tuple[str, ...]
    is_box: Bools

    @property
    def key(self) -> tuple[int, str, str, int]:
        """The order in which frames are processed, whatever their order of arrival."""
        return self.reference_ns, self.camera.name, self.boot_id, self.sequence

    def __len__(self) -> int:
        return len(self.point)

    def slanted(self, up: Floats | None) -> FrameDetections:
        """The same with the points of each box on the image of the vertical through its centre.

        A box has the image's axes, a body is seen along the vertical ``up`` (3,): beside the vertical line through the
        principal point, and where a camera is rolled, head and foot are not above each other.
        """
        if up is None or not self.is_box.any():
            return self
        axis = self.camera.pose.rotation @ up
        centre = 0.5 * (self.head + self.foot)
        along = axis[:2] - axis[2] * centre
        steep = np.flatnonzero(self.is_box & (np.abs(along[:, 0]) < np.abs(along[:, 1])))
        points = np.stack([self.point, self.head, self.foot])
        slope = along[steep, 0] / along[steep, 1]
        points[:, steep, 0] = centre[steep, 0] + slope * (points[:, steep, 1] - centre[steep, 1])
        return replace(self, point=points[0], head=points[1], foot=points[2])


def frame_detections(camera: TrackingCamera, message: pb.Observation) -> FrameDetections:
    """The trackable detections of an observation; those that cannot be undistorted are left out."""
    found = [detection for detection in message.detections if tracked_kind(detection)]
    pixel_pairs = [((d.u, d.v), _pixel_or_nan(d.head), _pixel_or_nan(d.foot)) for d in found]
    pixels = np.array(pixel_pairs, dtype=np.float64).reshape(-1, 2)
    normalised = np.full(pixels.shape, np.nan)
    given = np.isfinite(pixels[:, 0])
    if given.any():
        normalised[given] = camera.intrinsics.unproject(pixels[given])
    parts = normalised.reshape(-1, 3, 2)
    good = np.isfinite(parts[:, 0]).all(axis=1)
    if not good.all():
        found = [detection for detection, kept in zip(found, good, strict=True) if kept]
        parts = parts[good]
    point = parts[:, 0]
    inverse = np.linalg.inv(camera.intrinsics.pixel_jacobian(point)) if len(found) else np.zeros((0, 2, 2))
    entries = np.array([_covariance(d) for d in found], dtype=np.float64).reshape(-1, 3)
    noise = entries[:, [[0, 1], [1, 2]]] + camera.noise_px**2 * np.eye(2)
    units_per_px = np.sqrt(np.abs(np.linalg.det(inverse)))
    colour = [(d.colour.red, d.colour.green, d.colour.blue) if d.HasField("colour") else (np.nan,) * 3 for d in found]
    return FrameDetections(
        camera=camera,
        reference_ns=camera.reference_ns(message.device_time_ns),
        boot_id=message.boot_id,
        sequence=message.sequence,
        point=point,
        noise=inverse @ noise @ inverse.transpose(0, 2, 1),
        units_per_px=units_per_px,
        head=parts[:, 1],
        foot=parts[:, 2],
        size=np.array([d.size if d.size > 0.0 else np.nan for d in found], dtype=np.float64) * units_per_px,
        colour=np.array(colour, dtype=np.float64).reshape(-1, 3),
        kind=np.array([KIND_INDEX[tracked_kind(d)] for d in found], dtype=np.int64),
        target=tuple(d.target for d in found),
        is_box=np.array([bool(d.head and d.foot) and d.head[0] == d.foot[0] for d in found], dtype=np.bool_),
    )


def tracked_kind(detection: pb.Detection) -> str:
    """The kind under which a detection is tracked; "" for a labelled marker or corner: its label identifies it."""
    kind: str = detection.kind
    if kind == "marker" or kind == "corner":  # of each detection: a tuple takes longer
        return "" if detection.label else "marker"
    return kind


def _covariance(detection: pb.Detection) -> tuple[float, float, float]:
    """The entries uu, uv, vv [px²]."""
    given = detection.covariance
    if len(given) != 3:
        return _DEFAULT_STD_PX**2, 0.0, _DEFAULT_STD_PX**2
    return given[0] + MIN_STD_PX**2, given[1], given[2] + MIN_STD_PX**2


def _pixel_or_nan(pixel_pairs: Sequence[float]) -> tuple[float, float]:
    return (pixel_pairs[0], pixel_pairs[1]) if len(pixel_pairs) == 2 else (np.nan, np.nan)
