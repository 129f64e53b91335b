"""Rows of labelled markers: one detection of one camera, undistorted, in reference time."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, pi, tan

from hub.tracking.detections import MIN_STD_PX, TrackingCamera
from protocols.geometry.camera import Intrinsics
from protocols.messages import syncline_pb2 as pb

_NEWTON_STEPS, _TOLERANCE = 20, 1e-11  # it converges quadratically


@dataclass(frozen=True, slots=True, eq=False)
class MarkerRow:
    """One detection of a labelled marker.

    reference_ns: capture time of its image row on the reference clock. point: x, y, normalised. noise: its
    covariance xx, xy, yy. detection, device_ns: as the camera published them.
    """

    camera: TrackingCamera
    reference_ns: int
    boot_id: str
    sequence: int
    device_ns: int
    detection: pb.Detection
    point: tuple[float, float]
    noise: tuple[float, float, float]

    @property
    def key(self) -> tuple[int, str, str, int]:
        """The order in which rows are processed, whatever their order of arrival."""
        return self.reference_ns, self.camera.name, self.boot_id, self.sequence

    def seen_by(self, camera: TrackingCamera) -> MarkerRow | None:
        """The same row under another calibration of its camera."""
        return marker_row(camera, self.device_ns, self.boot_id, self.sequence, self.detection)


def marker_row(
    camera: TrackingCamera, device_ns: int, boot_id: str, sequence: int, detection: pb.Detection
) -> MarkerRow | None:
    """The row of a detection; None if it or its covariance is no use, or the lens has no inverse there.

    Its covariance is the detection's own, but not below the residuals of the calibration.
    """
    lens = camera.intrinsics
    found = undistort(lens, detection.u, detection.v)
    if found is None:
        return None
    x, y, jacobian = found
    (a, b), (c, d) = jacobian
    determinant = a * d - b * c
    uu, uv, vv = detection.covariance if len(detection.covariance) == 3 else (0.0, 0.0, 0.0)
    if not (0.0 <= uu < lens.width**2 and 0.0 <= vv < lens.height**2 and uv * uv <= uu * vv):
        return None
    # noise_px is the root mean square of both coordinates together.
    more = max(max(0.5 * camera.noise_px**2, MIN_STD_PX**2) - 0.5 * (uu + vv), 0.0)
    a, b, c, d = d / determinant, -b / determinant, -c / determinant, a / determinant
    uu, vv = uu + more, vv + more
    noise = (
        a * a * uu + 2.0 * a * b * uv + b * b * vv,
        a * c * uu + (a * d + b * c) * uv + b * d * vv,
        c * c * uu + 2.0 * c * d * uv + d * d * vv,
    )
    row, rows = (detection.u, lens.width) if lens.is_portrait else (detection.v, lens.height)
    row_ns = round(camera.readout * 1e9 * (min(max(row / max(rows - 1, 1), 0.0), 1.0) - 0.5))
    reference_ns = camera.reference_ns(device_ns + row_ns)
    return MarkerRow(camera, reference_ns, boot_id, sequence, device_ns, detection, (x, y), noise)


def undistort(lens: Intrinsics, u: float, v: float) -> tuple[float, float, tuple[tuple[float, float], ...]] | None:
    """One pixel's normalised coordinates, and the derivative (2, 2) of pixels by them; None if there is no inverse.

    The same as `Intrinsics.unproject` and `pixel_jacobian`, in scalars: fifty times as fast for a single point.
    """
    (fx, skew, cx), (_, fy, cy), _ = lens.matrix.tolist()
    yd = (v - cy) / fy
    xd = (u - cx - skew * yd) / fx
    if not abs(xd) + abs(yd) < 100.0:
        return None
    inverse = _fisheye(lens, xd, yd) if lens.fisheye else _pinhole(lens, xd, yd)
    if inverse is None:
        return None
    x, y, a, b, c, d = inverse
    if not fx * fy * (a * d - b * c) > 0.0:
        return None
    return x, y, ((fx * a + skew * c, fx * b + skew * d), (fy * c, fy * d))


def _pinhole(lens: Intrinsics, xd: float, yd: float) -> tuple[float, float, float, float, float, float] | None:
    """Newton's method on Brown's model: x, y and the Jacobian's four entries, by rows."""
    k1, k2, p1, p2, k3 = lens.distortions.tolist()
    x, y = xd, yd
    for _ in range(_NEWTON_STEPS):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)
        a = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        b = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        d = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        ex = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - xd
        ey = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - yd
        if abs(ex) + abs(ey) < _TOLERANCE:
            return (x, y, a, b, b, d) if r2 < lens.fold**2 else None
        determinant = a * d - b * b
        if not abs(determinant) > 1e-9:
            return None
        x, y = x - (d * ex - b * ey) / determinant, y - (a * ey - b * ex) / determinant
        if not abs(x) + abs(y) < 1e3:
            return None
    return None


def _fisheye(lens: Intrinsics, xd: float, yd: float) -> tuple[float, float, float, float, float, float] | None:
    """Newton's method on the angle of OpenCV's fisheye model: as `_pinhole`."""
    k1, k2, k3, k4 = lens.distortions.tolist()
    bent = hypot(xd, yd)
    theta, slope = bent, 1.0
    for _ in range(_NEWTON_STEPS):
        t2 = theta * theta
        error = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - bent
        slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
        if abs(error) < _TOLERANCE:
            break
        if not slope > 1e-6:
            return None
        theta -= error / slope
    else:
        return None
    if not 0.0 <= theta < min(pi / 2 - 1e-3, lens.fold):
        return None
    if bent < 1e-9:
        return xd, yd, 1.0, 0.0, 0.0, 1.0
    radius = tan(theta)
    nx, ny, across = xd / bent, yd / bent, bent / radius
    along = slope / (1.0 + radius * radius)  # d bent / d radius
    off = (along - across) * nx * ny
    return (
        radius * nx,
        radius * ny,
        across + (along - across) * nx * nx,
        off,
        off,
        across + (along - across) * ny * ny,
    )
