"""Reproduction of the background-aware tracking paper on simulated flights: its figures, and numbers.

``python -m tests.papers.uav_paper --out DIR`` draws figures 1 to 5 and 7 and writes numbers.txt. Section 3.3 (figure
1): a winding road, a drone that keeps the estimate in the middle; without and with the road. Section 4.1 (figures 2 to
5): the frame, its regions by colour, the road's shape, the regions corrected by it. Section 4.4 (figure 7): the town.
The paper shows images only; the numbers are the means over several seeds of the same scenario.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from edge.uav.base import Estimate, Tracker, TrackState
from edge.uav.baselines import regions
from edge.uav.baselines.paper_tracker import PaperTracker
from edge.uav.baselines.plain_tracker import PlainTracker
from edge.uav.world import scenarios
from edge.uav.world.flight_world import FlightWorld
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image

WINDING, TOWN = "paper-3.3", "paper-4.4"
NEAR = 20.0
"""Largest error [px] of a correct estimate."""
_CANVAS = 1.9  # size of the figures relative to the camera's image
_SAME_ROAD = 0.94  # cosine of the largest turn of a road that counts as the same one
_DIM = 0.55  # brightness outside the camera's image
_YELLOW, _CYAN, _RED, _GREEN, _WHITE = (0, 230, 255), (255, 200, 0), (40, 40, 255), (60, 230, 60), (255, 255, 255)

Maker = Callable[[FlightWorld, int], Tracker]


def plain(world: FlightWorld, seed: int) -> Tracker:
    """Section 2."""
    return PlainTracker(world.size, fps=world.fps, seed=seed)


def road_steered(world: FlightWorld, seed: int) -> PaperTracker:
    """Section 3.2."""
    return PaperTracker(world.size, fps=world.fps, seed=seed, section=3)


def background_aware(world: FlightWorld, seed: int) -> PaperTracker:
    """Section 4.3."""
    return PaperTracker(world.size, fps=world.fps, seed=seed)


@dataclass(frozen=True, slots=True)
class Score:
    """Scores of one run. Fractions 0..1, nan without such frames.

    seen_near: of the frames with the car in the image, off by less than 20 px. out_near, out_car: of those with no
    part of it in the image, off by less than 20 px, or less than its length. false_visible: of those, called visible.
    back: whether it was within 20 px in the last 20 frames' median, with the car in the image then.
    """

    seen_near: float
    out_near: float
    out_car: float
    false_visible: float
    back: float


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Estimates and errors (n,) [px] of a tracker over a world."""

    world: FlightWorld
    estimates: list[Estimate]
    errors: Floats

    def score(self) -> Score:
        truths = [self.world.truth(k) for k in range(self.world.length)]
        inside = np.array([truth.inside for truth in truths])
        length = np.array([max(truth.width, truth.height) for truth in truths])
        claimed = np.array([estimate.state is TrackState.VISIBLE for estimate in self.estimates])
        errors = np.where(np.isnan(self.errors), np.inf, self.errors)
        out, seen, tail = inside == 0.0, inside > 0.5, np.arange(len(inside)) >= len(inside) - 20
        after = tail & seen
        return Score(
            _share(errors[seen] < NEAR),
            _share(errors[out] < NEAR),
            _share(errors[out] < length[out]),
            _share(claimed[out]),
            float(np.median(errors[after]) < NEAR) if after.any() else float("nan"),
        )


def run(
    world: FlightWorld, tracker: Tracker, frames: int | None = None, look: Callable[[int], None] | None = None
) -> Run:
    """Follow the world's target from its first frame on. look is called with each frame's number, after it."""
    truth = world.truth(0)
    estimates = [tracker.begin(world.frame(0), world.time(0), truth.box)]
    errors = [0.0]
    for k in range(1, min(frames or world.length, world.length)):
        estimates.append(tracker.handle_frame(world.frame(k), world.time(k)))
        truth = world.truth(k)
        errors.append(float(np.hypot(estimates[-1].x - truth.x, estimates[-1].y - truth.y)))
        if look is not None:
            look(k)
    return Run(world, estimates, np.array(errors))


def route(world: FlightWorld, frame: int) -> Floats:
    """The target's whole route (n, 2) in the pixels of one frame, nan behind the camera: its lane."""
    pose = world.truth(frame).camera
    ground = np.column_stack([world.target.ground[:, :2], np.zeros(len(world.target.ground))])
    return world.lens.project((ground - pose.position) @ pose.rotation.T)


def canvas(world: FlightWorld, frame: int) -> tuple[Image, Floats]:
    """The image on a larger, darker rendering of its surroundings; and the position (2,) of its pixel (0, 0)."""
    width, height = world.size
    wide, high = int(width * _CANVAS), int(height * _CANVAS)
    origin = np.array([(wide - width) // 2, (high - height) // 2], dtype=np.float64)
    matrix = world.lens.matrix.copy()
    matrix[:2, 2] += origin
    around = replace(world, lens=Intrinsics(wide, high, matrix)).render(frame)
    result = (around * _DIM).astype(np.uint8)
    x, y = origin.astype(int)
    result[y : y + height, x : x + width] = world.frame(frame)
    cv2.rectangle(result, (x - 1, y - 1), (x + width, y + height), _WHITE, 1)
    return result, origin


def drawn(world: FlightWorld, frame: int, estimate: Estimate, title: str) -> Image:
    """One panel: particles, road, estimate and truth on the canvas."""
    image, origin = canvas(world, frame)
    for name, points in estimate.layers.items():
        line = np.rint((points + origin) * 8).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(image, [line], False, _YELLOW if "line" in name else _CYAN, 1, cv2.LINE_AA, 3)
    if estimate.particles is not None:
        for x, y in np.rint(estimate.particles + origin).astype(int):
            cv2.circle(image, (int(x), int(y)), 2, _RED, -1)
    truth = world.truth(frame)
    cv2.circle(image, (round(truth.x + origin[0]), round(truth.y + origin[1])), 16, _GREEN, 2, cv2.LINE_AA)
    error = float(np.hypot(estimate.x - truth.x, estimate.y - truth.y))
    if np.isfinite(error):
        at = (round(estimate.x + origin[0]), round(estimate.y + origin[1]))
        cv2.drawMarker(image, at, _WHITE, cv2.MARKER_CROSS, 26, 2, cv2.LINE_AA)
    text = f"{title}  frame {frame}  {estimate.state.value}  off by {error:.0f} px, std {estimate.std:.0f} px"
    cv2.rectangle(image, (0, 0), (image.shape[1], 34), (0, 0, 0), -1)
    cv2.putText(image, text, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, _WHITE, 1, cv2.LINE_AA)
    return image


def figure_1(world: FlightWorld, seed: int, frames: Sequence[int]) -> tuple[Image, list[str]]:
    """Columns: (a) without, (b) with the road's shape. Rows: the frames."""
    columns, lines = [], []
    for title, maker in (("(a) colour only", plain), ("(b) with the road", road_steered)):
        done = run(world, maker(world, seed))
        columns.append(np.vstack([drawn(world, k, done.estimates[k], title) for k in frames]))
        errors = ", ".join(f"frame {k}: {done.errors[k]:.0f} px" for k in frames)
        lines.append(f"figure 1 {title}: off by {errors}")
    return np.hstack(columns), lines


def figures_2_to_5(world: FlightWorld, frame: int, seed: int) -> tuple[dict[str, Image], list[str]]:
    """The frame, its regions, the road's shape in it and the corrected regions."""
    tracker = background_aware(world, seed)
    run(world, tracker, frame + 1)
    diagnostics = tracker.diagnostics
    image = world.frame(frame)
    size = world.size
    shape = image.copy()
    if diagnostics.course is not None:
        known = diagnostics.course.points[diagnostics.course.known]
        normal = np.column_stack([-np.sin(diagnostics.course.headings), np.cos(diagnostics.course.headings)])[
            diagnostics.course.known
        ]
        for side in (-diagnostics.course.half_width, 0.0, diagnostics.course.half_width):
            line = np.rint((known + side * normal) * 8).astype(np.int32).reshape(-1, 1, 2)
            cv2.polylines(shape, [line], False, _YELLOW if side else _CYAN, 2, cv2.LINE_AA, 3)
    images: dict[str, Image] = {
        "figure-2.png": image,
        "figure-3.png": _in_colours(diagnostics.labels, size),
        "figure-4.png": shape,
        "figure-5.png": _in_colours(diagnostics.corrected, size),
    }
    return images, [
        f"figure 3, frame {frame}: {road_share(world, frame, diagnostics.labels):.0%} of the car's route in the "
        f"image is road; of all pixels {_shares(diagnostics.labels)}",
        "figure 4: the road's middle keeps its distance from the car's route to "
        f"{lane_scatter(world, frame, tracker):.1f} px (std within the image)",
        f"figure 5: {road_share(world, frame, diagnostics.corrected):.0%} of the car's route is road; of all pixels "
        f"{_shares(diagnostics.corrected)}",
    ]


def road_share(world: FlightWorld, frame: int, labels: regions.Labels) -> float:
    """Share of the target's route within the image that is labelled road."""
    places = _seen_route(world, frame) / regions.SCALE
    index = np.clip(np.rint(places).astype(int), 0, np.array(labels.shape[::-1]) - 1)
    return float((labels[index[:, 1], index[:, 0]] == regions.ROAD).mean())


def lane_scatter(world: FlightWorld, frame: int, tracker: PaperTracker) -> float:
    """Std [px] of the distance from the target's route in the image to the road's midline: 0 if it is parallel."""
    course = tracker.diagnostics.course
    return float("nan") if course is None else float(course.nearest(_seen_route(world, frame))[0].std())


def figure_7(world: FlightWorld, seed: int, frames: Sequence[int]) -> tuple[Image, list[str]]:
    """Four frames of the town."""
    done = run(world, background_aware(world, seed))
    panels = [drawn(world, k, done.estimates[k], "section 4") for k in frames]
    errors = ", ".join(f"frame {k}: {done.errors[k]:.0f} px" for k in frames)
    return np.vstack([np.hstack(panels[:2]), np.hstack(panels[2:])]), [f"figure 7: off by {errors}"]


def table(scenario: str, makers: dict[str, Maker], seeds: Sequence[int]) -> list[str]:
    """One line a model: the mean of its scores over seeds."""
    lines = [
        f"{scenario}, {len(seeds)} seeds".ljust(30) + "| in < 20 px | out < 20 px | out < 1 car | out, visible | back"
    ]
    for name, maker in makers.items():
        scores = [run(world, maker(world, 0)).score() for world in (scenarios.get(scenario, seed) for seed in seeds)]
        values = [
            np.nanmean([getattr(score, part) for score in scores])
            for part in ("seen_near", "out_near", "out_car", "false_visible", "back")
        ]
        lines.append(name.ljust(30) + " ".join(f"| {value:10.0%} " for value in values))
    return lines


def exit_frames(world: FlightWorld) -> tuple[int, int, int]:
    """Before the car leaves the image, the middle of its absence, and after its return, for the figures."""
    first, end = world.out_of_view
    return max(first - 15, 1), (first + end) // 2, min(end + 15, world.length - 1)


def main() -> None:
    """Draw everything into --out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0, help="of the worlds in the figures")
    parser.add_argument("--seeds", type=int, default=5, help="how many worlds the numbers are means of")
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    winding, town = scenarios.get(WINDING, chosen.seed), scenarios.get(TOWN, chosen.seed)
    before, _, _ = exit_frames(town)
    images, lines = figures_2_to_5(town, min(40, before), chosen.seed)
    images["figure-1.png"], first = figure_1(winding, chosen.seed, exit_frames(winding))
    images["figure-7.png"], last = figure_7(town, chosen.seed, (min(40, before), *exit_frames(town)))
    for name, image in images.items():
        if not cv2.imwrite(str(chosen.out / name), image):
            raise OSError(f"cannot write {chosen.out / name}")
    makers: dict[str, Maker] = {
        "section 2 (plain)": plain,
        "section 3 (road)": road_steered,
        "section 4 (paper)": background_aware,
    }
    numbers = first + lines + last
    for scenario in (WINDING, TOWN):
        numbers += ["", *table(scenario, makers, range(chosen.seeds))]
    (chosen.out / "numbers.txt").write_text("\n".join(numbers) + "\n")
    print("\n".join(numbers))


def _seen_route(world: FlightWorld, frame: int) -> Floats:
    """The part of the route that is in the image and on the road that the target drives on in this frame."""
    turned = np.cos(world.target.course - world.target.course[frame])
    places = route(world, frame)[turned > _SAME_ROAD]
    inside = ((places > 0.0) & (places < np.array(world.size) - 1.0)).all(axis=1)
    return np.asarray(places[inside], dtype=np.float64)


def _in_colours(labels: regions.Labels, size: tuple[int, int]) -> Image:
    coloured = cv2.resize(regions.COLOURS[labels], size, interpolation=cv2.INTER_NEAREST)
    return np.asarray(coloured, dtype=np.uint8)


def _share(mask: np.ndarray) -> float:
    return float(mask.mean()) if len(mask) else float("nan")


def _shares(labels: regions.Labels) -> str:
    names = {regions.ROAD: "road", regions.OTHER: "other", regions.BUILDING: "building"}
    return ", ".join(f"{(labels == label).mean():.0%} {name}" for label, name in names.items())


if __name__ == "__main__":
    main()
