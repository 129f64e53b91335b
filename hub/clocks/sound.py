"""The lags of videos by their sound tracks, as priors of their clocks and as a check of the lags of the images.

Microphones differ in their frequency response and gain, rooms in their echoes: what recordings of one event share are
its onsets. They are correlated over all lags at once, by FFT (Bello et al., "A Tutorial on Onset Detection in Music
Signals", IEEE Trans. Speech and Audio Processing 13, 2005; Knapp and Carter, "The Generalized Correlation Method for
Estimation of Time Delay", IEEE Trans. ASSP 24, 1976).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from hub.clocks.external_prior import ExternalClockPrior
from protocols.core.acceptance import PairReport
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration

_FALSE_ALARM = 1e-3
"""Probability that unrelated sounds have a lag."""
_ONSET_S = 0.02
"""Duration in which a sound begins [s]."""
_PEAK_S = 0.05
"""Half width of a correlation peak, echoes included [s]."""
_BOUND_S = 0.1
"""Bound of a sound track's lag behind the pictures [s], in which it is acceptable to viewers (ITU-R BT.1359: 0.09 s
ahead to 0.185 s behind), and of sound's way through 10 m of air (0.03 s)."""


def sound_lag(a: Floats, b: Floats, rate: float) -> float | None:
    """The time in ``a`` less the time in ``b`` of the same sounds [s], both from the first sample.

    a, b: energies (n,), (m,) of short windows, ``rate`` of them a second. None where no lag is significant, or several
    are alike, as of rhythmic sounds. The largest of N correlations of unrelated sounds, whose distribution has an
    exponential tail at most, is M = s ln N; one of q M has the probability N^(1 - q).
    """
    if min(len(a), len(b)) < 2.0 * _PEAK_S * rate:
        return None
    first, second = _onset_strength(a, rate), _onset_strength(b, rate)
    count = len(a) + len(b) - 1
    spectrum = np.fft.rfft(first, count)
    correlation = np.fft.irfft(spectrum * np.fft.rfft(second, count).conj(), count)
    # Sounds played backwards have the same onsets, at other times.
    unrelated = np.fft.irfft(spectrum * np.fft.rfft(second[::-1], count).conj(), count)
    best = int(np.argmax(correlation))
    away = np.abs((np.arange(count) - best + count // 2) % count - count // 2) > _PEAK_S * rate
    rival = max(float(correlation[away].max(initial=0.0)), float(unrelated.max()))
    if not correlation[best] > rival * (1.0 + math.log(1.0 / _FALSE_ALARM) / math.log(count)):
        return None
    return (best if best < len(a) else best - count) / rate


def sound_priors(sounds: Mapping[str, tuple[float, Floats]], rate: float) -> dict[str, ExternalClockPrior]:
    """Clock priors of the cameras that heard what the first one of them heard; none where no two heard the same.

    sounds: by camera, camera time of the first energy [s] and the energies (n,), ``rate`` of them a second. The time
    of the first camera takes the place of Unix time, so that ``unix_minus_camera`` is a camera's lag behind it.
    """
    left = dict(sounds)
    while len(left) > 1:
        base = next(iter(left))
        start, energy = left.pop(base)
        lags = {name: sound_lag(energy, other, rate) for name, (_, other) in left.items()}
        behind = {name: lag + start - left[name][0] for name, lag in lags.items() if lag is not None}
        if behind:
            return {name: ExternalClockPrior("", lag, _BOUND_S) for name, lag in ({base: 0.0} | behind).items()}
    return {}


def sound_check(priors: Mapping[str, ExternalClockPrior], calibration: Calibration) -> tuple[str, ...]:
    """A line that compares the lags of the images with ``sound_priors``; none for fewer than two cameras."""
    names = [name for name in priors if name in calibration.cameras]
    off = [calibration.cameras[name].lag - priors[name].unix_minus_camera for name in names]
    if len(off) < 2:
        return ()
    line = f"lags by the images less those by the sound tracks, against {names[0]}: "
    line += ", ".join(f"{name} {one - off[0]:+.3f} s" for name, one in zip(names[1:], off[1:], strict=True))
    wrong = max(off) - min(off) > 2.0 * _BOUND_S
    return (line + ": more than sound explains; look at the synchronised videos (`syncline sync`)" * wrong,)


def sound_pairs(priors: Mapping[str, ExternalClockPrior], known: Iterable[PairReport]) -> tuple[PairReport, ...]:
    """Pairs with the lags of ``sound_priors``, for cameras that have none by their images."""
    timed = {name for pair in known if pair.lag_s is not None for name in pair.cameras}
    base = next(iter(priors), "")
    return tuple(
        PairReport((base, name), "by the sound tracks", prior.unix_minus_camera, 1.0)
        for name, prior in priors.items()
        if name != base and name not in timed
    )


def _onset_strength(energy: Floats, rate: float) -> Floats:
    """Rises (n,) of the logarithm of the energy above the background, less their mean; echoes prolong falls."""
    window = max(round(_ONSET_S * rate), 1)
    smooth = np.convolve(energy, np.full(window, 1.0 / window), "same")
    level = np.log(smooth + float(np.median(smooth)) + 1e-12)
    rises = np.zeros(len(level))
    rises[window:] = np.maximum(level[window:] - level[:-window], 0.0)
    return np.asarray(rises - rises.mean())
