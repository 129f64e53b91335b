"""Plan view: paths and cameras from above, to scale, as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from hub.report.svg import THIN, at, drawing, esc, line, number, points, round_below, text, tick_text, ticks
from protocols.geometry.types import Floats

if TYPE_CHECKING:
    from deploy.offline.follow.calibration import GivenCalibration
    from hub.tracking.offline import FollowedTrack

_WIDTH, _MARGIN = 1000.0, 44.0  # px of the drawing, and around the plan in it: room for the axes' numbers
_SMALL = 320.0  # px: width of the plan of one camera's coverage
_MAX_HEIGHT = 820.0  # px: a long and narrow plan still fits on a screen
MOST_NUMBERS = 40
"""Paths with a number in the plan; the others show it under the pointer."""
_SEEN_WITHIN = 0.02
"""Share of the positions at each edge that may lie outside the smallest plan of all paths: one lost track would
otherwise shrink everything."""


def plan_axes(up: Floats | None) -> tuple[Floats, tuple[str, str]]:
    """Two horizontal directions (2, 3) of the world, to the right and upwards in the plan, and their names."""
    vertical = np.array([0.0, 0.0, 1.0]) if up is None else up
    main = int(np.argmax(np.abs(vertical)))
    first, second = ((1, 2), (2, 0), (0, 1))[main]
    across = np.eye(3)[first] - vertical * vertical[first]
    across /= np.linalg.norm(across)
    ahead = np.cross(vertical, across)
    exact = abs(vertical[main]) > 1.0 - 1e-6
    sign = "" if vertical[main] > 0.0 else "−"
    names = ("xyz"[first], f"{sign}{'xyz'[second]}") if exact else ("right", "ahead")
    return np.stack([across, ahead]), names


@dataclass(frozen=True, slots=True, eq=False)
class PlanView:
    """The drawn part of the ground. axes: (2, 3). low, high: (2,) corners [unit]. scale: [px per unit].

    cameras: by name, the place (2,) and the two directions (2, 2) at the edges of its view.
    """

    axes: Floats
    names: tuple[str, str]
    unit: str
    low: Floats
    high: Floats
    cameras: dict[str, tuple[Floats, Floats]]

    @classmethod
    def of(
        cls,
        tracks: Sequence[FollowedTrack],
        known: GivenCalibration,
        axes: tuple[Floats, tuple[str, str]],
        unit: str,
    ) -> Self:
        """A view of all paths, and of cameras no farther away than the paths are wide."""
        turn, names = axes
        cameras = {}
        for name, camera in known.calibration.cameras.items():
            lens = camera.intrinsics
            edge = lens.unproject(np.array([[0.0, lens.height / 2.0], [lens.width - 1.0, lens.height / 2.0]]))
            rays = np.hstack([edge, np.ones((2, 1))]) @ camera.pose.rotation @ turn.T
            cameras[name] = turn @ camera.pose.position, rays / np.maximum(np.linalg.norm(rays, axis=1), 1e-9)[:, None]
        places = np.concatenate([np.zeros((0, 2)), *(track.position @ turn.T for track in tracks)])
        if len(places):
            low, high = np.quantile(places, [_SEEN_WITHIN, 1.0 - _SEEN_WITHIN], axis=0)
            slack = 0.25 * np.maximum(high - low, 0.1 * float((high - low).max()) + 1e-6)
            low, high = np.maximum(places.min(axis=0), low - slack), np.minimum(places.max(axis=0), high + slack)
        else:
            stands = np.array([place for place, _ in cameras.values()])
            low, high = stands.min(axis=0), stands.max(axis=0)
        reach = max(float((high - low).max()), 1e-6)
        near = [place for place, _ in cameras.values() if ((place > low - reach) & (place < high + reach)).all()]
        low, high = np.min([low, *near], axis=0), np.max([high, *near], axis=0)
        pad = 0.03 * max(float((high - low).max()), 1e-6)
        view = cls(turn, names, unit, low - pad, high + pad, cameras)
        return view.turned() if high[1] - low[1] > 1.2 * (high[0] - low[0]) else view

    def turned(self) -> Self:
        """The view turned by a quarter to the right: a page has more room across."""
        quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
        cameras = {name: (quarter @ place, rays @ quarter.T) for name, (place, rays) in self.cameras.items()}
        names = self.names[1], f"−{self.names[0]}" if len(self.names[0]) == 1 else "left"
        low, high = np.array([self.low[1], -self.high[0]]), np.array([self.high[1], -self.low[0]])
        return replace(self, axes=quarter @ self.axes, names=names, low=low, high=high, cameras=cameras)

    def _frame(self, width: float, margin: float) -> tuple[float, float, float]:
        """Scale, width and height of a drawing that is at most ``width`` wide."""
        span = self.high - self.low
        scale = min((width - 2 * margin) / span[0], (_MAX_HEIGHT * width / _WIDTH - 2 * margin) / span[1])
        return float(scale), float(span[0] * scale + 2 * margin), float(span[1] * scale + 2 * margin)

    def _place(self, points_on_plan: Floats, scale: float, margin: float) -> tuple[Floats, Floats]:
        return (
            margin + scale * (points_on_plan[:, 0] - self.low[0]),
            margin + scale * (self.high[1] - points_on_plan[:, 1]),
        )

    def paths(self, tracks: Sequence[FollowedTrack]) -> str:
        """All paths with their numbers, cameras, grid and scale."""
        scale, width, height = self._frame(_WIDTH, _MARGIN)
        parts = [f'<rect class="image" x="0.5" y="0.5" width="{at(width - 1)}" height="{at(height - 1)}"/>']
        parts += self._grid(scale, width, height)
        labels = []
        named = {track.id for track in sorted(tracks, key=lambda track: -len(track.times))[:MOST_NUMBERS]}
        for track in tracks:
            colour = track_colour(track.id)
            x, y = self._place(track.position @ self.axes.T, scale, _MARGIN)
            title = f"{track.id}: {track.times[0]:.2f} to {track.times[-1]:.2f} s"
            for run in _state_runs(track):
                kind = "walk" if track.confirmed[run[-1]] else "walk coasting"
                parts.append(
                    f'<polyline class="{kind}" stroke="{colour}" points="{points(x[run], y[run])}">'
                    f"<title>{esc(title)}</title></polyline>"
                )
            parts.append(
                f'<circle cx="{at(x[0])}" cy="{at(y[0])}" r="3.5" fill="#fff" stroke="{colour}" stroke-width="1.6"/>'
            )
            if track.id not in named:
                continue
            spot = f'x="{at(x[-1] + 4)}" y="{at(y[-1] + 4)}"'
            labels.append(f'<text class="id halo" style="fill:{colour}" {spot}>{track.id}</text>')
        parts += labels
        parts += self._cameras(scale, _MARGIN, 1.0)
        bar = round_below(0.25 * (width - 2 * _MARGIN) / scale)
        digits = max(0, -math.floor(math.log10(bar) + 1e-9))
        parts.append(line(_MARGIN, height - 12, _MARGIN + bar * scale, height - 12, "scalebar"))
        parts.append(text(_MARGIN + bar * scale + 8, height - 8, f"{number(bar, digits)}{THIN}{self.unit}", "tick"))
        vertical = f"{self.names[1][1:]} ↓" if self.names[1].startswith("−") else f"{self.names[1]} ↑"
        parts.append(text(width - 12, height - 8, f"{self.names[0]} → {vertical}  [{self.unit}]", "tick", "end"))
        return drawing(width, height, parts, "Paths from above", max_width=width)

    def coverage(self, camera: str, tracks: Sequence[FollowedTrack], places: Floats) -> str:
        """A small plan with the places (n, 3) where one camera's detections were used."""
        margin = 12.0
        scale, width, height = self._frame(_SMALL, margin)
        parts = [f'<rect class="image" x="0.5" y="0.5" width="{at(width - 1)}" height="{at(height - 1)}"/>']
        for track in tracks:
            x, y = self._place(track.position[:: max(1, len(track.times) // 60)] @ self.axes.T, scale, margin)
            parts.append(f'<polyline class="ghost" points="{points(x, y)}"/>')
        every = max(1, len(places) // 700)
        x, y = self._place(places[::every] @ self.axes.T, scale, margin)
        parts += [f'<circle class="seen small" cx="{at(a)}" cy="{at(b)}" r="1.6"/>' for a, b in zip(x, y, strict=True)]
        parts += self._cameras(scale, margin, 0.6, only=camera)
        caption = f"<figcaption><b>{esc(camera)}</b>{len(places)} used</figcaption>"
        return f"<figure>{drawing(width, height, parts, f'Coverage of {camera}', max_width=width)}{caption}</figure>"

    def _grid(self, scale: float, width: float, height: float) -> list[str]:
        parts = []
        across, along = (
            ticks(float(self.low[0]), float(self.high[0]), 8),
            ticks(float(self.low[1]), float(self.high[1]), 8),
        )
        for value in across:
            x = _MARGIN + scale * (value - self.low[0])
            parts.append(line(x, _MARGIN, x, height - _MARGIN, "grid"))
            parts.append(text(x, height - _MARGIN + 14, tick_text(value, across), "tick", "middle"))
        # The axis names say it where the plan is turned and coordinates run downwards.
        flip = -1.0 if self.names[1].startswith("−") else 1.0
        for value in along:
            y = _MARGIN + scale * (self.high[1] - value)
            parts.append(line(_MARGIN, y, width - _MARGIN, y, "grid"))
            parts.append(text(_MARGIN - 6, y + 4, tick_text(flip * value, along), "tick", "end"))
        return parts

    def _cameras(self, scale: float, margin: float, size: float, only: str = "") -> list[str]:
        parts = []
        taken: list[tuple[float, float]] = []
        for name, (place, rays) in self.cameras.items():
            if only not in ("", name) or ((place < self.low) | (place > self.high)).any():
                continue
            (x,), (y,) = self._place(place[None], scale, margin)
            reach = 34.0 * size
            ends = np.column_stack([x + reach * rays[:, 0], y - reach * rays[:, 1]])
            parts.append(f'<polygon class="frustum" points="{at(x)},{at(y)} {points(ends[:, 0], ends[:, 1])}"/>')
            parts.append(f'<circle class="estimate" cx="{at(x)}" cy="{at(y)}" r="{at(3.5 * size + 0.5)}"/>')
            if not only:
                aside = 1.0 if rays[:, 1].sum() > 0.0 else -1.0  # the label is on the side away from the view
                wide = 8.5 * len(name)
                tries = [float(y) + 4 + 15.0 * aside * k for k in (1.0, 2.0, -1.0, 3.0, -2.0)]
                free = [t for t in tries if not any(abs(x - a) < wide and abs(t - b) < 14 for a, b in taken)]
                taken.append((float(x), (free or tries)[0]))
                parts.append(text(*taken[-1], name, "halo strong", "middle"))
        return parts


def _state_runs(track: FollowedTrack) -> list[list[int]]:
    """Indices of the parts of a path of one state, each joined to the sample before it."""
    breaks = np.flatnonzero(np.diff(track.confirmed)) + 1
    runs = np.split(np.arange(len(track.times)), breaks)
    return [[max(int(run[0]) - 1, 0), *run.tolist()] for run in runs]


def track_colour(number_of: int) -> str:
    """A colour of an identity: successive numbers are far apart on the colour circle (the golden angle)."""
    return f"hsl({round(137.508 * number_of) % 360} {62 + 14 * (number_of % 2)}% {34 + 6 * (number_of % 3)}%)"
