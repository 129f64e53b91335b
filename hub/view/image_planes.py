"""The cameras' images side by side in the 3-D view, for clicking on pixels before anything is calibrated."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from hub.view.page import draw_detections
from hub.view.scene_renderer import decode_rgb, set_viewpoint
from hub.view.state import ViewState
from protocols.geometry.types import Floats

if TYPE_CHECKING:
    import viser

_WIDTH, _GAP = 1.0, 0.06  # of an image and between two, in the scene's units


class ImagePlanes:
    """Images in the plane z = 0, x to the right, y down. clicked: (camera, u, v) in pixels of the camera's image."""

    def __init__(self, server: viser.ViserServer, clicked: Callable[[str, float, float], None]) -> None:
        self._server = server
        self._clicked = clicked
        self._images: dict[str, Any] = {}
        self._labels: dict[str, Any] = {}
        self._shown: dict[str, int] = {}
        self._sizes: dict[str, tuple[int, int]] = {}
        self._count = 0

    def update(self, state: ViewState) -> None:
        """Show the newest images."""
        names = [name for name, camera in state.cameras.items() if camera.picture is not None]
        if len(names) != self._count:
            self.clear()
            self._count = len(names)
            self._look(len(names))
        for index, name in enumerate(names):
            camera = state.cameras[name]
            if camera.picture is None or self._shown.get(name) == camera.pictures:
                continue
            image = decode_rgb(camera.picture.jpeg)
            if image is None:
                continue
            self._shown[name] = camera.pictures
            self._sizes[name] = (camera.picture.width, camera.picture.height)
            image = draw_detections(image, camera)
            if name in self._images:
                self._images[name].image = image
                continue
            height = _WIDTH * camera.picture.height / camera.picture.width
            place = (index * (_WIDTH + _GAP), 0.0, 0.0)
            handle = self._server.scene.add_image(
                f"/pictures/{name}", image, _WIDTH, height, format="jpeg", position=place, cast_shadow=False
            )
            handle.on_click(partial(self._click, name, index))
            self._images[name] = handle
            label = (place[0], -0.5 * height - 0.03, 0.0)
            self._labels[name] = self._server.scene.add_label(
                f"/names/{name}", name, position=label, anchor="bottom-center"
            )

    def clear(self) -> None:
        """Remove the images."""
        for handle in (*self._images.values(), *self._labels.values()):
            handle.remove()
        self._images.clear()
        self._labels.clear()
        self._shown.clear()
        self._count = 0

    def _look(self, count: int) -> None:
        middle = 0.5 * (max(count, 1) - 1) * (_WIDTH + _GAP)
        place, up = (middle, 0.0, -0.72 * max(count, 1) - 0.2), (0.0, -1.0, 0.0)
        self._server.scene.set_up_direction(up)
        set_viewpoint(self._server, np.array(place), np.array([middle, 0.0, 0.0]), np.array(up))

    def _click(self, name: str, index: int, event: Any) -> None:
        pixel = pixel_of(np.array(event.ray_origin), np.array(event.ray_direction), index, self._sizes[name])
        if pixel is not None:
            self._clicked(name, *pixel)


def pixel_of(origin: Floats, direction: Floats, index: int, size: tuple[int, int]) -> tuple[float, float] | None:
    """The pixel of image ``index`` that a ray intersects, None outside. size: the image's (width, height)."""
    if abs(direction[2]) < 1e-12:
        return None
    x, y, _ = origin - direction * (origin[2] / direction[2])
    u = (x - index * (_WIDTH + _GAP)) / _WIDTH + 0.5
    v = y / (_WIDTH * size[1] / size[0]) + 0.5
    if not (0.0 <= u <= 1.0 and 0.0 <= v <= 1.0):
        return None
    return u * size[0] - 0.5, v * size[1] - 0.5
