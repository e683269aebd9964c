"""Pictures of maps: what went into a merge and what came out of it.

Figures are made without pyplot, so that no display, back end or global state of the caller is touched, and
without dates in the file, so that the same map gives the same bytes.
"""

from __future__ import annotations

import os
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
import pyproj
import shapely
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from polymerge_core.crs import Bounds, is_local, working_crs
from polymerge_core.errors import CrsError, InputError, OptionError
from polymerge_core.outputs import StagedOutputs

if TYPE_CHECKING:
    import geopandas as gpd
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

#: Colours that the colour-blind can tell apart (Okabe and Ito); other classes take what is left, in turn.
_COLOURS = {"ped_crossing": "#0072B2", "divider": "#D55E00", "boundary": "#009E73"}
_OTHER_COLOURS = ("#CC79A7", "#E69F00", "#56B4E9", "#000000")
_REFERENCE_COLOUR = "#8a8a8a"
_REFERENCE_DASHES = (0, (4, 3))
_AREAL = (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON)

_WIDTH_IN = 16.0
_DPI = 100


class _Lines(NamedTuple):
    """A layer as lines to draw: the class of each line, its vertices, and which line each vertex is of."""

    classes: NDArray[np.object_]
    vertices: NDArray[np.float64]
    owner: NDArray[np.intp]
    features: int


def before_after(
    observations: gpd.GeoDataFrame,
    elements: gpd.GeoDataFrame,
    path: str | os.PathLike[str],
    *,
    reference: gpd.GeoDataFrame | None = None,
    title: str | None = None,
    region: Bounds | None = None,
    zoom: Bounds | None = None,
) -> None:
    """Draw all observations and the merged elements side by side into a PNG file, 1600 pixels wide.

    Parameters
    ----------
    observations : GeoDataFrame
        What went in: lines or polygons, with a column ``class`` (without one all is class ``line``).
    elements : GeoDataFrame
        What came out, likewise; their vertices are marked, so that zigzag is seen.
    path : path-like
        The PNG file; an existing one is replaced.
    reference : GeoDataFrame, optional
        A true map, drawn in dashed grey beneath both; only what lies in the picture.
    title : str, optional
        Headline of the figure.
    region : tuple of float, optional
        ``(xmin, ymin, xmax, ymax)`` of both panels in the CRS of `observations`; all observations and
        elements by default.
    zoom : tuple of float, optional
        Bounds of a spot, likewise, that is drawn larger in a second row.

    Raises
    ------
    InputError
        If there is nothing to draw.
    OptionError
        If `region` or `zoom` has no area.
    CrsError
        If some layers have a CRS and others do not.
    OutputError
        If the file cannot be written.

    Notes
    -----
    Layers in degrees are drawn in a metric CRS centred on them; axes are metres from the lower left corner.
    """
    frames = [observations, elements] if reference is None else [observations, elements, reference]
    crs, frames = _in_metres(frames)
    before, after, *beneath = (_as_lines(frame) for frame in frames)
    views = [_view(region, observations.crs, crs, "region") or _bounds(before, after)]
    spot = _view(zoom, observations.crs, crs, "zoom")
    views += [spot] if spot else []
    figure, rows = _panels(views)
    if title:
        figure.suptitle(title, fontsize=16, fontweight="bold")
    colours = _class_colours(before, after)
    origin = np.array(views[0][:2])
    for axes, view in zip(rows, views, strict=True):
        for panel, lines, name in zip(axes, (before, after), ("Before", "After"), strict=True):
            for truth in beneath:
                _draw_reference(panel, truth, origin)
            _draw_classes(panel, lines, colours, origin, merged=lines is after, close=view is spot)
            _frame(panel, view, origin, _panel_title(name, lines, close=view is spot))
    if spot:
        _mark(rows[0], spot, origin)
    _legend(figure, colours, with_reference=bool(beneath))
    _save(figure, Path(path))


def _in_metres(frames: list[gpd.GeoDataFrame]) -> tuple[pyproj.CRS | None, list[gpd.GeoDataFrame]]:
    """Bring all layers to the first one's CRS, or to a metric one where that is not in metres."""
    given = frames[0].crs
    on_earth = [frame.crs is not None and not is_local(frame.crs) for frame in frames]
    if not any(on_earth):
        return given, frames
    if not all(on_earth):
        raise CrsError("some layers of the figure have a CRS and others have none; declare the CRS of every layer")
    filled = [frame for frame in frames if np.isfinite(frame.total_bounds).all()]
    crs = working_crs(given, tuple(filled[0].to_crs(given).total_bounds)) if filled else given
    return crs, [frame.to_crs(crs) for frame in frames]


def _as_lines(frame: gpd.GeoDataFrame) -> _Lines:
    """Take lines, and polygons by their rings, apart into vertices."""
    names = frame["class"].astype(str).to_numpy(object) if "class" in frame else np.full(len(frame), "line", object)
    parts, feature = line_parts(frame)
    vertices, owner = shapely.get_coordinates(parts, return_index=True)
    return _Lines(names[feature], vertices, owner, len(frame))


def line_parts(frame: gpd.GeoDataFrame) -> tuple[NDArray[np.object_], NDArray[np.intp]]:
    """Return a layer as single lines, polygons by their rings, and the row of each."""
    geometry = frame.geometry.to_numpy()
    areal = np.isin(shapely.get_type_id(geometry), _AREAL)
    parts, feature = shapely.get_parts(np.where(areal, shapely.boundary(geometry), geometry), return_index=True)
    return parts, feature


def _bounds(*layers: _Lines) -> Bounds:
    vertices = np.concatenate([lines.vertices for lines in layers])
    if len(vertices) == 0:
        raise InputError("observations and elements are both empty: there is nothing to draw")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    margin = max(0.03 * float((high - low).max()), 1.0)
    xmin, ymin, xmax, ymax = (float(value) for value in (*(low - margin), *(high + margin)))
    return xmin, ymin, xmax, ymax


def _view(bounds: Bounds | None, given: Any, crs: pyproj.CRS | None, name: str) -> Bounds | None:
    """Return bounds that a caller gave in the CRS of the figure."""
    if bounds is None:
        return None
    xmin, ymin, xmax, ymax = bounds
    if not (xmin < xmax and ymin < ymax):
        raise OptionError(f"{name} is {bounds}; give XMIN,YMIN,XMAX,YMAX with XMIN < XMAX and YMIN < YMAX")
    if given is None or given == crs:
        return bounds
    transformer = pyproj.Transformer.from_crs(given, crs, always_xy=True)
    west, south, east, north = transformer.transform_bounds(xmin, ymin, xmax, ymax)
    return west, south, east, north


def _panels(views: list[Bounds]) -> tuple[Figure, list[list[Axes]]]:
    """Lay out two panels for each view, as high as the views ask for."""
    panel_in = _WIDTH_IN / 2 - 0.9
    heights = [float(np.clip(panel_in * (ymax - ymin) / (xmax - xmin), 2.0, 12.0)) for xmin, ymin, xmax, ymax in views]
    size = (_WIDTH_IN, sum(heights) + 0.8 * len(views) + 0.9)
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    grid = figure.add_gridspec(len(views), 2, height_ratios=heights)
    rows = [[figure.add_subplot(grid[row, column]) for column in range(2)] for row in range(len(views))]
    return figure, rows


def _class_colours(*layers: _Lines) -> dict[str, str]:
    present = pd.unique(np.concatenate([lines.classes for lines in layers]))
    known = [name for name in _COLOURS if name in present]
    others = sorted(set(present) - set(known))
    taken = {name: _OTHER_COLOURS[number % len(_OTHER_COLOURS)] for number, name in enumerate(others)}
    return {name: _COLOURS[name] for name in known} | taken


def _segments(lines: _Lines, chosen: NDArray[np.bool_], origin: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the vertices of each chosen line, relative to the corner of the picture."""
    keep = chosen[lines.owner]
    starts = np.flatnonzero(np.diff(lines.owner[keep])) + 1
    return np.split(lines.vertices[keep] - origin, starts) if keep.any() else []


def _draw_reference(panel: Axes, lines: _Lines, origin: NDArray[np.float64]) -> None:
    every = np.ones(len(lines.classes), dtype=bool)
    segments = _segments(lines, every, origin)
    beneath = LineCollection(
        segments, colors=_REFERENCE_COLOUR, linewidths=1.1, linestyles=[_REFERENCE_DASHES], zorder=1
    )
    panel.add_collection(beneath, autolim=False)


def _draw_classes(
    panel: Axes,
    lines: _Lines,
    colours: dict[str, str],
    origin: NDArray[np.float64],
    *,
    merged: bool,
    close: bool,
) -> None:
    width, alpha = (1.6, 0.95) if merged else (0.9, 0.45)
    width, mark = (1.3 * width, 4.2) if close else (width, 3.0)
    for name, colour in colours.items():
        segments = _segments(lines, lines.classes == name, origin)
        drawn = LineCollection(segments, colors=colour, linewidths=width, alpha=alpha, zorder=2)
        panel.add_collection(drawn, autolim=False)
        if merged and segments:
            x, y = np.concatenate(segments).T
            panel.plot(x, y, "o", markersize=mark, color=colour, markeredgewidth=0.0, zorder=3)


def _panel_title(name: str, lines: _Lines, *, close: bool) -> str:
    what = "observations" if name == "Before" else "merged elements"
    return f"{name}: the spot in the frame above" if close else f"{name}: {lines.features:,} {what}"


def _frame(panel: Axes, view: Bounds, origin: NDArray[np.float64], title: str) -> None:
    """Set a panel's extent, axes and title."""
    xmin, ymin, xmax, ymax = np.array(view) - np.tile(origin, 2)
    panel.set(xlim=(xmin, xmax), ylim=(ymin, ymax), xlabel="metres", ylabel="metres")
    panel.set_aspect("equal")
    panel.set_title(title, fontsize=13)
    panel.grid(color="#e6e6e6", linewidth=0.6)
    panel.set_axisbelow(True)


def _mark(panels: list[Axes], spot: Bounds, origin: NDArray[np.float64]) -> None:
    """Frame the spot that the second row shows."""
    (xmin, ymin), (xmax, ymax) = np.array(spot).reshape(2, 2) - origin
    for panel in panels:
        size = (xmax - xmin, ymax - ymin)
        panel.add_patch(Rectangle((xmin, ymin), *size, fill=False, edgecolor="black", linewidth=1.2, zorder=4))


def _legend(figure: Figure, colours: dict[str, str], *, with_reference: bool) -> None:
    handles = [
        Line2D([], [], color=colour, linewidth=2.5, label=name.replace("_", " ")) for name, colour in colours.items()
    ]
    if with_reference:
        handles.append(Line2D([], [], color=_REFERENCE_COLOUR, linestyle=_REFERENCE_DASHES, label="reference"))
    handles.append(Line2D([], [], color="black", marker="o", markersize=4, linestyle="none", label="vertex, after"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=12)


def _save(figure: Figure, path: Path) -> None:
    """Write the picture so that a crash leaves no half file."""
    with StagedOutputs(overwrite=True) as outputs:
        outputs.stage(path).write_bytes(png(figure))


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG file without a date or the like, so that the same figure gives the same bytes."""
    picture = BytesIO()
    figure.savefig(picture, format="png", metadata={"Software": None})
    return picture.getvalue()
