"""Step 3b of the published method: merging areas such as pedestrian crossings (paper, section II-B.3).

The areas of a component are laid over one grid; each cell holds the share of them that cover it. The grid is
blurred, the cells above the coverage threshold are kept, and the rotated minimum rectangle of what is left
is the merged area.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from skimage.draw import polygon as polygon_cells
from skimage.filters import gaussian
from skimage.measure import label

#: Side of a cell, metres.
CELL_M = 0.1

#: Standard deviation of the blur, metres: what the authors' program amounts to.
BLUR_M = 0.35

#: No side of a grid has more cells than this: larger areas get coarser cells.
MAX_CELLS = 2000

#: Where the kernel of the blur is cut off, in standard deviations.
_TRUNCATE = 4.0


class CoverageGrid(NamedTuple):
    """The share of areas that cover each cell."""

    #: Between 0 and 1; float, shape (rows, columns), y grows with the row.
    values: NDArray[np.float64]
    #: Centre of the cell in row 0 and column 0, metres.
    x0: float
    y0: float
    #: Side of a cell, metres.
    cell: float


class AreaMerge(NamedTuple):
    """One area from many."""

    #: Rotated minimum rectangle of the cells that were kept.
    polygon: shapely.Polygon
    #: The coverage that was asked of a cell.
    threshold: float
    #: Whether no cell reached the threshold asked for, so that the highest coverage present was taken.
    lowered: bool


def coverage_grid(polygons: NDArray[np.object_], *, cell: float = CELL_M, margin: float = 0.0) -> CoverageGrid:
    """Count how much of a set of areas covers each cell of one grid.

    Parameters
    ----------
    polygons : ndarray of shapely Polygon, shape (n,)
        In a CRS in metres; holes count as not covered.
    cell : float, default 0.1
        Side of a cell, metres; coarser where a side of the grid would pass `MAX_CELLS` cells.
    margin : float, default 0.0
        Empty border around the areas' bounding box, metres.

    Returns
    -------
    CoverageGrid
        A cell is covered by an area that holds its centre. The grid is anchored at the centroid of all
        corners, so that the result does not depend on where on Earth the areas lie.
    """
    corners = shapely.get_coordinates(polygons)
    anchor = corners.mean(axis=0)
    low, high = corners.min(axis=0) - anchor - margin, corners.max(axis=0) - anchor + margin
    cell = max(cell, float((high - low).max()) / (MAX_CELLS - 2))
    first = np.floor(low / cell)
    columns, rows = (np.ceil(high / cell) - first + 1).astype(int)
    values = np.zeros((rows, columns))
    for area in polygons:
        values[_covered_cells(area, anchor + first * cell, cell, (rows, columns))] += 1.0
    x0, y0 = (anchor + first * cell).tolist()
    return CoverageGrid(values / len(polygons), x0, y0, cell)


def merge_areas(
    polygons: NDArray[np.object_], *, coverage: float = 0.5, cell: float = CELL_M, sigma: float = BLUR_M
) -> AreaMerge:
    """Merge areas by a coverage vote (paper, section II-B.3 and figure 5).

    Parameters
    ----------
    polygons : ndarray of shapely Polygon, shape (n,)
        The areas of one component, in a CRS in metres.
    coverage : float, default 0.5
        Th_cov: the share of areas that must cover a cell for it to be kept. 0.1 gives a large area, 0.95 a
        small one, 0.5 the median one.
    cell : float, default 0.1
        Side of a grid cell, metres.
    sigma : float, default 0.35
        Standard deviation of the Gaussian blur, metres.

    Returns
    -------
    AreaMerge
        The rotated minimum rectangle of the largest connected part that was kept, and the threshold used.
        Where no cell reaches `coverage` after the blur, the highest value present takes its place.

    Raises
    ------
    ValueError
        If there are no areas.
    """
    if len(polygons) == 0:
        raise ValueError("there are no areas to merge")
    # The border gives the blur its full width: nothing is folded back at the edges of the grid.
    grid = coverage_grid(polygons, cell=cell, margin=_TRUNCATE * sigma)
    blurred = gaussian(grid.values, sigma=sigma / grid.cell, mode="constant", truncate=_TRUNCATE)
    # Summing and blurring leave rounding behind; 1e-9 of a vote must not decide about a cell.
    highest = float(blurred.max())
    threshold = min(coverage, highest)
    kept = label(blurred >= threshold - 1e-9, connectivity=1)
    rows, columns = _largest_part(kept)
    # The rectangle is found near the origin: far from it, rounding would choose between rectangles of like size.
    centres = np.column_stack([columns, rows]) * grid.cell
    rectangle = shapely.oriented_envelope(shapely.multipoints(centres))
    grown = shapely.buffer(rectangle, grid.cell / 2, join_style="mitre", cap_style="square")
    corners = shapely.get_coordinates(shapely.oriented_envelope(grown)) + np.array([grid.x0, grid.y0])
    return AreaMerge(shapely.Polygon(corners), threshold, highest < coverage)


def _covered_cells(
    area: shapely.Polygon, origin: NDArray[np.float64], cell: float, shape: tuple[int, int]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of the cells whose centre lies in an area."""

    def cells(ring: shapely.LinearRing) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        column, row = ((shapely.get_coordinates(ring) - origin) / cell).T
        rows, columns = polygon_cells(row, column, shape)
        return rows, columns

    if not area.interiors:
        return cells(area.exterior)
    inside = np.zeros(shape, dtype=bool)
    for index, ring in enumerate((area.exterior, *area.interiors)):
        inside[cells(ring)] = index == 0
    rows, columns = np.nonzero(inside)
    return rows, columns


def _largest_part(parts: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and last cell of each row of the part with the most cells (the first of equal ones).

    The cells between them lie within the same rectangle.
    """
    largest = np.bincount(parts.ravel())[1:].argmax() + 1
    rows, columns = np.nonzero(parts == largest)
    ends = np.flatnonzero(np.diff(rows, prepend=-1) | np.diff(rows, append=-1))
    return rows[ends], columns[ends]
