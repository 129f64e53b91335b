"""Which model of a camera's clock is chosen: an even clock, a step, a rolling shutter's readout, jitter of the stamps.

    python -m tests.bench.clock_models [--sessions 6] [--first 7000] [--only step30,...] [--seconds 40] [--jobs 2]

Four cameras round one path, calibrated once for each effect put into the first, a random one or all of the cameras.
Chosen: cameras by what was put in (rows) and what is reported (columns); errors of sizes over their stds.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from hub.calibration.pipeline import calibrate  # noqa: E402
from protocols.core.errors import Refused  # noqa: E402
from tests.support import rigs  # noqa: E402
from protocols.session.observations import Observations, Track

# name: (step [s], readout / frame interval, jitter [s], of all cameras)
EFFECTS = {
    "none": (0, 0, 0, False),
    "step15": (0.015, 0, 0, False),
    "step30": (0.03, 0, 0, False),
    "step60": (0.06, 0, 0, False),
    "readout": (0, 0.5, 0, False),
    "readouts": (0, 0.5, 0, True),
    "jitter5": (0, 0, 0.005, False),
    "jitter20": (0, 0, 0.02, False),
    "jitters5": (0, 0, 0.005, True),
    "step30+readouts": (0.03, 0.5, 0, True),
    "step30+jitter": (0.03, 0, 0.01, False),
    "readout+jitter": (0, 0.5, 0.005, False),
}


def session(seed, effect, seconds, fps, noise, focal_error=0.0):
    step, share, jitter, every = EFFECTS[effect]
    rng = np.random.default_rng([seed, 31])
    one = rigs.simulate(seed, 4, seconds, fps=fps, noise=0.0, ppm=50.0, drops=0.0, fastest=float(os.environ.get("FASTEST", "0.7")))
    chosen = f"cam{rng.integers(4)}"
    path = one.paths["object"] if "object" in one.paths else next(iter(one.paths.values()))
    tracks = {}
    truth = {}
    obs = one.observations()
    rig_c = dict(one.rig.cameras)
    for (name, label), t in obs.tracks.items():
        cam = one.rig.cameras[name]
        readout = share / cam.fps if (every or name == chosen) else 0.0
        jit = jitter if (every or name == chosen) else 0.0
        true = np.array([one.true_time(name, float(s)) for s in t.time])
        v = np.full(len(true), 360.0)
        for _ in range(4):
            p = cam.intrinsics.project(one.poses[name].camera_from_world(path.at(true + readout * (v / 720 - 0.5))))
            v = p[:, 1]
        p = p + rng.normal(0, noise, p.shape)
        stamps = t.time.copy()
        at = size = 0.0
        if step and name == chosen:
            at = t.time[0] + rng.uniform(0.25, 0.75) * np.ptp(t.time)
            size = step * rng.choice([-1.0, 1.0])
            stamps = stamps + np.where(t.time >= at, size, 0.0)
        if jit:
            stamps = stamps + rng.normal(0, jit, len(stamps))
        with np.errstate(invalid="ignore"):
            ok = ((p >= 0) & (p < rigs.SIZE)).all(axis=1) & (rng.random(len(p)) > 0.05)
        ok &= np.diff(np.maximum.accumulate(stamps), prepend=-np.inf) > 0
        truth[name] = (at, size, readout, jit)
        tracks[name, label] = replace(t, time=stamps, pixels=p).select(ok)
        if focal_error:
            m = cam.intrinsics.matrix.copy(); m[:2, :2] *= 1 + rng.normal(0, focal_error)
            rig_c[name] = replace(cam, intrinsics=replace(cam.intrinsics, matrix=m))
    return one, replace(one.rig, cameras=rig_c), Observations(tracks), truth, chosen


def one(task, seconds, noise, fps, focal_error):
    effect, seed = task
    s, rig, obs, truth, chosen = session(seed, effect, seconds, fps, noise, focal_error)
    began = time.process_time()
    try:
        found = calibrate(rig, obs)
    except Refused as e:
        return effect, seed, None, str(e), time.process_time() - began
    out = []
    for name, (at, size, readout, jit) in truth.items():
        c = found.cameras.get(name)
        if c is None:
            out.append((name, (at, size, readout, jit), None)); continue
        out.append((name, (at, size, readout, jit), (c.clock_steps, c.readout, getattr(c, "readout_std", 0.0), next((float(w.split("jitter by ")[1].split(" ms")[0]) * 1e-3 for w in found.warnings if w.startswith(name + ": its stamps jitter by ")), 0.0))))
    return effect, seed, out, s.turn_error({k: v.pose for k, v in found.cameras.items()}) if len(found.cameras) == 4 else -1, time.process_time() - began


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--sessions", type=int, default=6)
    ap.add_argument("--first", type=int, default=7000)
    ap.add_argument("--only", default=",".join(EFFECTS))
    ap.add_argument("--seconds", type=float, default=40.0)
    ap.add_argument("--noise", type=float, default=0.5)
    ap.add_argument("--focal-error", type=float, default=0.0)
    ap.add_argument("--fps", default="30,25,29.97,50")
    ap.add_argument("--jobs", type=int, default=1)
    ap.add_argument("-v", action="store_true")
    o = ap.parse_args()
    fps = tuple(float(x) for x in o.fps.split(","))
    tasks = [(e, s) for e in o.only.split(",") for s in range(o.first, o.first + o.sessions)]
    with ProcessPoolExecutor(o.jobs) as pool:
        res = list(pool.map(partial(one, seconds=o.seconds, noise=o.noise, fps=fps, focal_error=o.focal_error), tasks))
    print(f"{'effect':>18} refused steps:found/put wrong  readouts:found/put wrong  jitter:found/put wrong  rms z readout, step, ratio jitter  cpu")
    for e in o.only.split(","):
        mine = [r for r in res if r[0] == e]
        ref = sum(r[2] is None for r in mine); refc = 0
        sp = sf = sw = rp = rf = rw = jp = jf = jw = 0
        zs, zr, js = [], [], []
        for r in mine:
            for name, (at, size, readout, jit), got in r[2] or []:
                if got is None:
                    refc += 1; continue
                steps, ro, ros, j = got
                j = j or 0.0
                sp += size != 0; rp += readout != 0; jp += jit != 0
                hit = [x for x in steps if size and abs(x[1] - size) < 0.5 * abs(size) and abs(x[0] - at) < 5]
                sf += bool(hit); sw += len(steps) - bool(hit)
                zs += [(hit[0][1] - size) / hit[0][2]] if hit else []
                if readout: rf += ro > 0
                else: rw += ro > 0
                if ro > 0 and ros: zr.append((ro - readout) / ros)
                if jit: jf += j > 0
                else: jw += j > 0
                if jit and j: js.append(j / jit)
                if o.v: print(e, r[1], name, "truth", (round(at,2), size, round(readout*1e3,2), jit), "got", [tuple(round(float(v),4) for v in x) for x in steps], "ro %.2f±%.2f ms" % (1e3*ro, 1e3*(ros or 0)), "jit", j)
        rms = lambda z: np.sqrt(np.mean(np.square(z))) if z else np.nan
        print(f"{e:>18} {ref}+{refc:<4} {sf:3}/{sp:<3} {sw:3}       {rf:3}/{rp:<3} {rw:3}     {jf:3}/{jp:<3} {jw:3}     {rms(zr):.2f} {rms(zs):.2f} {np.mean(js) if js else np.nan:.2f}  turn {np.degrees(np.median([r[3] for r in mine if r[2]] or [0])):.3f} cpu {np.mean([r[4] for r in mine]):.1f}", flush=True)

if __name__ == "__main__":
    main()
