"""Plausible ranges of what cameras, rigs and logs say: one table for messages and files, with units and reasons.

A value beyond them is a fault or an attack. Within them squares, sums and differences of all of them are finite in
double precision, and differences of times do not overflow 64 bits.
"""

from __future__ import annotations

MAX_PIXEL = 1e6
"""px. A detection may lie outside the image (a predicted one does), but not a million pixels away."""
MAX_IMAGE_SIDE = 65_535
"""px. The largest side of a JPEG; the largest sensors have a third of it."""
MIN_FOCAL, MAX_FOCAL = 1.0, 1e7
"""px. A fisheye's image of a few pixels; ten metres of focal length over pixels of 1 µm."""
MAX_DISTORTION = 1e9
"""1. A k3 that bends the corner of an image by 5 % has 7e7 at a focal length of 100,000 px and 2,000 px to the corner
(0.05 / 0.03⁶), and less at every shorter one."""
MAX_FPS = 100_000.0
"""Hz. High-speed cameras at full width stay below it."""
MAX_LENGTH = 1e11
"""Rig units. The circumference of the Earth is 4e10 mm: map coordinates in mm fit in."""
MIN_STD = 1e-9
"""Rig units or rad. Below it only 0, which means exactly known: a weight 1/std² must stay finite."""
MAX_TURN = 100.0
"""rad, of one component of a Rodrigues vector: some turns."""
MAX_TIME_S = 1e11
"""s. 3,000 years; beyond it a double does not resolve 10 µs."""
MAX_TIME_NS = 2**62
"""ns. 146 years before and after 1970: differences of two fit into 64 bits."""
MAX_EXPOSURE_NS = 3_600 * 10**9
"""ns. An hour; astronomers expose for minutes."""
MIN_CLOCK_RATE, MAX_CLOCK_RATE = 1e-3, 1e3
"""Seconds of one clock in a second of another. Slow motion of 1,000 times, slower or faster."""
MAX_CAMERAS = 1024
"""Of a rig, a hub and a message: more are split among several."""
MAX_COUNT = 2**53
"""Of frames and messages: what a double counts exactly. 4,000 years at 100,000 Hz."""
