"""Strip charts of the cameras' lags and residuals as SVG, one strip for each camera with its own scale."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hub.report.svg import THIN, drawing, esc, line, number, points, rect, short, text
from hub.view.lag_history import LAG_WINDOW_S, LagSample
from hub.view.state import CameraView, ViewState
from protocols.geometry.types import Floats

_LAG_WIDTH, _RMS_LEFT, _RMS_WIDTH, _HEIGHT = 232.0, 248.0, 92.0, 56.0  # px of the drawing
_MIN_SPAN_S = 30.0  # of the time axis
_STEP_S = 2.0  # how often the charts move
_STYLE = (
    "<style>.lags{font:12px/1.35 system-ui,sans-serif;padding:0 .75em .5em}.lags p{margin:.4em 0 .1em}"
    ".lags svg{display:block;width:100%;height:auto;overflow:hidden}.lags .axis{stroke:#999;stroke-width:1}"
    ".lags .lag,.lags .rms{fill:none;stroke:#1e6ebe;stroke-width:1.5}.lags .rms{stroke:#666}"
    ".lags .band{fill:#1e6ebe;fill-opacity:.22}.lags .plot{fill:#f4f4f4}"
    ".lags text{font-size:10px;fill:#444;paint-order:stroke;stroke:#fff;stroke-width:3px}</style>"
)


def lag_charts(state: ViewState, now: float) -> str:
    """For each calibrated camera: how its lag and its residual have changed."""
    moment = _STEP_S * np.ceil(now / _STEP_S)
    solved = state.solved
    samples = {name: camera.lags.recent(now) for name, camera in state.cameras.items()}
    oldest = min((found[0].at for found in samples.values() if found), default=moment)
    start = moment - min(max(moment - oldest, _MIN_SPAN_S), LAG_WINDOW_S)
    strips = [
        _strip(state.cameras[name], found, start, moment, solved is not None and name == solved.reference_camera)
        for name, found in samples.items()
        if found and state.cameras[name].calibration is not None
    ]
    if not strips:
        strips = ["<p>Lags appear with the first calibration.</p>"]
    else:
        strips.append(
            f"<p>Change since the first published lag, ± 2 std; right, the residual; last {moment - start:.0f} s.</p>"
        )
    return f"{_STYLE}<div class='lags'>{''.join(strips)}</div>"


def _strip(camera: CameraView, samples: Sequence[LagSample], start: float, end: float, is_reference: bool) -> str:
    last = samples[-1]
    change = f"{number(1e3 * last.lag, 3, sign=True)} ± {number(2e3 * last.std, 3)}{THIN}ms"
    words = "reference clock" if is_reference else change
    x = np.array([sample.at for sample in samples])
    x = (np.clip(x, start, end) - start) / (end - start)
    lag = 1e3 * np.array([sample.lag for sample in samples])
    double = 2e3 * np.array([sample.std for sample in samples])
    rms = np.array([sample.rms_px for sample in samples])
    parts = [rect(_RMS_LEFT, 0, _RMS_WIDTH, _HEIGHT, "plot")]
    if is_reference:
        parts.append(text(0, 0.5 * _HEIGHT, "The lags of the others are relative to it."))
    else:
        # The first, uncertain lags must not flatten all later ones.
        reach = max(2.0 * double[-1], 1e-4)
        low, high = min(lag.min(), lag[-1] - reach), max(lag.max(), lag[-1] + reach)
        y = np.clip(_down(np.stack([lag, lag - double, lag + double]), low, high), -10.0, _HEIGHT + 10.0)
        across = np.append(x, 1.0) * _LAG_WIDTH
        lag_y, lower, upper = (np.append(row, row[-1]) for row in y)
        outline = points([*across, *across[::-1]], [*lower, *upper[::-1]])
        zero = float(_down(np.zeros(1), low, high)[0])
        parts += [
            rect(0, 0, _LAG_WIDTH, _HEIGHT, "plot"),
            line(0, zero, _LAG_WIDTH, zero, "axis") if 0.0 < zero < _HEIGHT else "",
            f'<polygon class="band" points="{outline}"/>',
            f'<polyline class="lag" points="{points(across, lag_y)}"/>',
            text(3, 11, f"{short(high, sign=True)} ms"),
            text(3, _HEIGHT - 4, f"{short(low, sign=True)} ms"),
        ]
    top = max(float(rms.max()), 1e-3)
    along = _RMS_LEFT + np.append(x, 1.0) * _RMS_WIDTH
    parts += [
        f'<polyline class="rms" points="{points(along, _down(np.append(rms, rms[-1]), 0.0, 1.25 * top))}"/>',
        text(_RMS_LEFT + 3, 11, f"{short(last.rms_px)} px"),
    ]
    name = esc(camera.name)
    chart = drawing(_RMS_LEFT + _RMS_WIDTH, _HEIGHT, parts, f"lag of {camera.name}: {words}")
    return f"<p data-lag='{name}' data-revisions='{len(samples)}'><b>{name}</b> {words}</p>{chart}"


def _down(values: Floats, low: float, high: float) -> Floats:
    """Heights in the drawing, which grow downwards."""
    return _HEIGHT * (high - values) / (high - low)
