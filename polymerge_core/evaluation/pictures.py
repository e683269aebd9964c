"""The pictures of an evaluation: maps of one class, the error along its lines, a histogram.

Each is a PNG as bytes, made without pyplot and without a date, so that the same evaluation gives the same bytes.
"""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from polymerge_core.crs import Bounds
from polymerge_core.evaluation.lengths import LATERAL_M
from polymerge_core.figures import line_parts, png

_DPI = 110
_WIDTH_IN = 11.0
_REFERENCE, _DRAWN, _BEYOND = "#9a9a9a", "#0072B2", "#D55E00"
#: From good to bad; told apart by the colour-blind, and in grey.
_ERRORS = "viridis_r"

#: Edges of the histogram, metres.
BINS = np.linspace(0.0, LATERAL_M, 31)


def class_bounds(*layers: gpd.GeoDataFrame | None) -> Bounds | None:
    """Return what holds all layers that are not empty, with a margin; None where all are."""
    bounds = [frame.total_bounds for frame in layers if frame is not None and len(frame)]
    if not bounds:
        return None
    low, high = np.min(bounds, axis=0)[:2], np.max(bounds, axis=0)[2:]
    margin = max(0.03 * float((high - low).max()), 1e-9)
    xmin, ymin, xmax, ymax = (float(value) for value in (*(low - margin), *(high + margin)))
    return xmin, ymin, xmax, ymax


def map_picture(panels: dict[str, gpd.GeoDataFrame], reference: gpd.GeoDataFrame, view: Bounds) -> bytes:
    """Draw layers side by side, the reference in grey beneath each."""
    figure, axes = _figure(len(panels), view)
    for panel, (title, frame) in zip(axes, panels.items(), strict=True):
        _frame(panel, view, title)
        _draw(panel, reference, _REFERENCE, 3.0, 0.7)
        _draw(panel, frame, _DRAWN, 1.1, 0.9 if len(frame) < 200 else 0.4)
    return png(figure)


def error_picture(errors: gpd.GeoDataFrame, reference: gpd.GeoDataFrame, view: Bounds) -> bytes:
    """Draw the merged map coloured by its distance to the reference; what has none near in a colour of its own."""
    figure, (panel,) = _figure(1, view)
    _frame(panel, view, "Distance to the nearest reference line")
    _draw(panel, reference, _REFERENCE, 3.5, 0.5)
    beyond = errors["beyond"].to_numpy(dtype=bool)
    _draw(panel, errors[beyond], _BEYOND, 2.0, 1.0)
    near = errors[~beyond]
    lines = LineCollection(_segments(near), array=near["error_m"].to_numpy(dtype=float), cmap=_ERRORS, linewidths=2.0)
    lines.set_clim(0.0, LATERAL_M)
    panel.add_collection(lines, autolim=False)
    bar = figure.colorbar(lines, ax=panel, shrink=0.8, pad=0.01)
    bar.set_label(f"metres; orange: more than {LATERAL_M:g} m, or no reference")
    return png(figure)


def histogram_picture(error: NDArray[np.float64]) -> bytes:
    """Draw how often each lateral error occurs, its median and 95th percentile."""
    figure = Figure(figsize=(_WIDTH_IN * 0.6, 2.6), dpi=_DPI, layout="constrained")
    panel = figure.add_subplot()
    panel.hist(error, bins=BINS.tolist(), color=_DRAWN)
    for share, style in ((50, "-"), (95, "--")):
        value = float(np.percentile(error, share))
        panel.axvline(value, color=_BEYOND, linestyle=style, label=f"{share} % are below {value:.2f} m")
    panel.set(xlabel="lateral error, metres", ylabel="points", xlim=(0.0, LATERAL_M))
    panel.legend(frameon=False)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)
    return png(figure)


def _figure(count: int, view: Bounds) -> tuple[Figure, list[Axes]]:
    xmin, ymin, xmax, ymax = view
    width = _WIDTH_IN / count
    height = float(np.clip(width * (ymax - ymin) / (xmax - xmin), 1.5, 9.0))
    figure = Figure(figsize=(_WIDTH_IN, height + 0.5), dpi=_DPI, layout="constrained")
    return figure, [figure.add_subplot(1, count, number + 1) for number in range(count)]


def _frame(panel: Axes, view: Bounds, title: str) -> None:
    xmin, ymin, xmax, ymax = view
    panel.set(xlim=(xmin, xmax), ylim=(ymin, ymax), xticks=[], yticks=[])
    panel.set_aspect("equal")
    panel.set_title(title, fontsize=11)


def _draw(panel: Axes, frame: gpd.GeoDataFrame, colour: str, width: float, alpha: float) -> None:
    panel.add_collection(LineCollection(_segments(frame), colors=colour, linewidths=width, alpha=alpha), autolim=False)


def _segments(frame: gpd.GeoDataFrame) -> list[NDArray[np.float64]]:
    """Return the vertices of each line, and of the rings of areas."""
    vertices, owner = shapely.get_coordinates(line_parts(frame)[0], return_index=True)
    return np.split(vertices, np.flatnonzero(np.diff(owner)) + 1) if len(vertices) else []
