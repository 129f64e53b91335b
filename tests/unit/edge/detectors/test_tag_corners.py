"""Corners of square tags, against images made by averaging finer ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from edge.detectors.board.description import Board
from edge.detectors.board.finder import Finder

SIDE, SIZE, FINER = 24.0, 96, 8


def test_tags_are_as_large_as_they_are() -> None:
    """ArUco's corners made sides 2 % too short: with given lenses, baselines were 1.6 % off at a stated 0.02 %."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    marker = cv2.aruco.generateImageMarker(dictionary, 5, 400)
    print_ = cv2.copyMakeBorder(marker, 200, 200, 200, 200, cv2.BORDER_CONSTANT, value=255.0)
    finder = Finder(Board(kind="apriltag", dictionary="apriltag_36h11", size=0.1))
    rng = np.random.default_rng(0)
    sizes = []
    for turn in np.linspace(0.0, 1.5, 16):
        to = cv2.getRotationMatrix2D((399.5, 399.5), float(np.degrees(turn)), SIDE * FINER / 400.0)
        to = to + np.array([[0.0, 0.0, 1.0]] * 2) * (SIZE * FINER / 2.0 - 400.0)
        fine = cv2.warpAffine(print_, to, (SIZE * FINER, SIZE * FINER), flags=cv2.INTER_AREA, borderValue=255.0)
        image = fine.reshape(SIZE, FINER, SIZE, FINER).mean(axis=(1, 3))
        image = 30.0 + 0.75 * cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0.0, 2.0, image.shape)
        _, corners = finder.find(np.clip(image, 0, 255).astype(np.uint8))
        assert len(corners) == 4
        sizes.append(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())
    assert abs(np.mean(sizes) / SIDE - 1.0) < 0.006


@pytest.mark.parametrize("inverted", [False, True])
def test_sides_that_the_lens_bends_are_not_taken_for_lines(inverted: bool) -> None:
    """Lines through the middle of such sides missed the corners by 0.9 px, and focal lengths by 0.5 %."""
    k1, focal, middle = -0.2, 420.0, np.array([319.5, 239.5])
    camera = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    marker = cv2.aruco.generateImageMarker(dictionary, 5, 320)
    print_ = cv2.copyMakeBorder(marker, 80, 80, 80, 80, cv2.BORDER_CONSTANT, value=255.0)
    flat = np.full((1440, 1920), 255, np.uint8)  # the undistorted picture, three times as fine, from -640 to 1280 px
    corner = np.array([1100, 700])
    flat[corner[1] : corner[1] + 480, corner[0] : corner[0] + 480] = print_
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    lens = np.array([k1, 0.0, 0.0, 0.0])
    rays = cv2.undistortPoints(np.column_stack([u.ravel(), v.ravel()])[:, None], camera, lens)[:, 0]
    fine = ((rays * focal + middle) * 3.0 + 1.0).astype(np.float32).reshape(480, 640, 2)
    image = cv2.remap(cv2.blur(flat, (3, 3)), fine[..., 0], fine[..., 1], cv2.INTER_LINEAR)
    edges = corner + 80.0 - 0.5 + 320.0 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    rays = (((edges - 1.0) / 3.0) - middle) / focal
    truth = cv2.projectPoints(np.column_stack([rays, np.ones(4)]), np.zeros(3), np.zeros(3), camera, lens)[0][:, 0]
    image = 255 - image if inverted else image
    finder = Finder(Board(kind="apriltag", dictionary="apriltag_36h11", size=0.1, inverted=inverted))
    numbers, corners = finder.find(image)
    assert len(corners) == 4
    for found in (corners, finder.refine(image, (numbers, corners + 0.4))[1]):
        assert np.sqrt(np.square(found - truth).sum(axis=1).mean()) < 0.1
