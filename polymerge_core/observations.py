"""From layers as users have them to one table of observations in metres, in canonical order.

Every feature of every layer becomes one observation or more (a multi-part feature has one for each part), or
is left out with a reason. Rows come out sorted by content (`polymerge_core.ordering`), never by their place
in a file, so that whatever reads the table from top to bottom gives the same result for the same data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
import pyproj
import shapely
from numpy.typing import NDArray

from polymerge_core.columns import Layer, read_columns
from polymerge_core.crs import (
    SCALE_TOLERANCE,
    check_coordinates,
    is_local,
    parse_crs,
    scale_error_over,
    transform_coordinates,
    transformer,
    working_crs,
)
from polymerge_core.errors import CrsError, InputError
from polymerge_core.options import Options
from polymerge_core.ordering import canonical_order
from polymerge_core.schema import ALIAS_COLUMNS, LEFT_OUT_COLUMNS, LINE_CLASSES, LocalMaps, empty_table

#: Vertices nearer than this to the one before (metres) are the same vertex: no map is finer.
MIN_SEGMENT_M = 1e-9

#: Beyond this (metres) a floating-point number no longer tells a tenth of a millimetre.
MAX_COORDINATE = 1e12

_POLYGON, _LINES = 3, (1, 2)
_FIRST_MULTI = 4


@dataclass(frozen=True)
class Observations:
    """All observations of a merge, in metres and in canonical order.

    Parameters
    ----------
    table : DataFrame
        One row an observation, main map first. `shape` is a LineString or, for an area, a Polygon, in the working
        CRS; `original` is the same in the layer's own CRS. `as_polygon` tells in which of the two types an area
        came. `from_m` and `to_m` are the interval of the source feature that the observation is.
    attributes : DataFrame
        The user's columns, row by row.
    left_out : DataFrame
        What is in no observation, with reasons.
    crs, out_crs : pyproj.CRS
        Where the work happens, and the CRS of the output.
    layer_crs : list of pyproj.CRS
        CRS of each layer, by the number in ``table["layer"]``.
    id_aliases : DataFrame
        What became of ids of the main map in earlier merges: `old_id`, `element_id`.
    main_ids : ndarray of int
        Ids of the main map's elements, also of those that cannot be used.
    highest_id : int
        The highest id that the main map ever gave, 0 where there is none.
    notes : dict
        What the report says about reading: instance rule, counts of what was cleaned, warnings.
    """

    table: pd.DataFrame
    attributes: pd.DataFrame
    left_out: pd.DataFrame
    crs: pyproj.CRS
    out_crs: pyproj.CRS
    layer_crs: list[pyproj.CRS]
    id_aliases: pd.DataFrame
    main_ids: NDArray[np.int64]
    highest_id: int
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def lines(self) -> NDArray[np.object_]:
        """Each observation as a line: itself, or an area's outer ring."""
        return as_lines(self.table["shape"].to_numpy())

    def to_output(self, shapes: NDArray[np.object_]) -> NDArray[np.object_]:
        """Carry shapes from the working CRS to the output CRS."""
        if self.crs == self.out_crs:
            return shapes.copy()
        moved: NDArray[np.object_] = shapely.transform(
            shapes, lambda xy: transform_coordinates(xy, self.crs, self.out_crs)
        )
        return moved


def observe(
    local_maps: Sequence[LocalMaps],
    main_map: Sequence[LocalMaps],
    options: Options,
    reference: pyproj.CRS | None = None,
) -> Observations:
    """Read layers into one table of observations.

    Parameters
    ----------
    local_maps : sequence of LocalMaps
        The layers to merge.
    main_map : sequence of LocalMaps
        The layers of the map to merge them into, if any.
    options : Options
        Columns, classes and CRS.
    reference : pyproj.CRS, optional
        Where the work happens if that is true to scale; by default the CRS of the main map, else of the first layer.

    Returns
    -------
    Observations
        In canonical order.

    Raises
    ------
    SchemaError, CrsError
        If a layer as a whole cannot be used.
    InputError
        With ``strict``, if any feature is left out.
    """
    layers = [Layer(maps, is_main=True) for maps in main_map] + [Layer(maps, is_main=False) for maps in local_maps]
    if not layers:
        raise InputError("there are no layers to merge")
    features, attributes, notes = read_columns(layers, options)
    parts = _explode(features)
    parts = _resolve_kinds(parts, options)
    layer_crs, reference, work = _choose_crs(layers, parts, options, reference, notes["warnings"])
    if options.crs is not None and all(layer.data.crs is not None for layer in layers):
        notes["warnings"].append("crs was not used: every layer has a CRS of its own")
    out_crs = reference if options.out_crs is None else parse_crs(options.out_crs)
    if is_local(out_crs) != is_local(work):
        raise CrsError("out_crs cannot be used: plain metric coordinates (crs=local) have no place on Earth")
    parts = _to_working_crs(parts, layer_crs, work)
    _check_out_crs(parts, work, out_crs)
    _check_shapes(parts)
    _measure(parts)
    table, duplicates = canonical_order(parts[parts["reason"].isna()], attributes)
    unfit = parts[parts["reason"].notna()]
    left_out = _left_out(pd.concat([unfit, duplicates]) if len(duplicates) else unfit, list(local_maps))
    if options.strict and len(left_out):
        first = left_out.iloc[0]
        raise InputError(
            f"layer {first['source']!r}: feature {first['source_fid']} cannot be used: {first['reason']} "
            f"({len(left_out)} in all); mend the layer, or run without strict to leave such features out"
        )
    notes["cleaned_vertices"] = int(parts["cleaned"].sum())
    attributes = attributes.iloc[table["feature"]].reset_index(drop=True)
    if is_local(work):
        _note_like_degrees(table, notes)
    known = [maps.id_aliases[list(ALIAS_COLUMNS)] for maps in main_map if maps.id_aliases is not None]
    aliases = (
        pd.concat([empty_table(ALIAS_COLUMNS), *known], ignore_index=True) if known else empty_table(ALIAS_COLUMNS)
    )
    main_ids = features["main_id"].to_numpy(dtype=np.int64)
    main_ids = main_ids[main_ids >= 0]
    highest = max(0, main_ids.max(initial=0), *(int(aliases[name].max()) for name in ALIAS_COLUMNS if len(aliases)))
    return Observations(table, attributes, left_out, work, out_crs, layer_crs, aliases, main_ids, int(highest), notes)


def as_lines(shapes: NDArray[np.object_]) -> NDArray[np.object_]:
    """Return LineStrings as they are and Polygons as their outer ring."""
    lines = shapes.copy()
    areas = shapely.get_type_id(shapes) == _POLYGON
    lines[areas] = _ring_to_line(shapely.get_exterior_ring(shapes[areas]))
    return lines


def _explode(features: pd.DataFrame) -> pd.DataFrame:
    """Return one row a part, in two dimensions; what is no line or polygon gets a reason."""
    features = features.assign(feature=np.arange(len(features)))
    shapes = features["shape"].to_numpy()
    reason = features["reason"].to_numpy(dtype=object, copy=True)
    coordinates, owner = shapely.get_coordinates(shapes, return_index=True)
    unfit = {
        "no geometry": shapely.is_missing(shapes),
        "empty geometry": shapely.is_empty(shapes),
        "a coordinate is not a number": _any_of(owner[~np.isfinite(coordinates).all(axis=1)], len(shapes)),
        "a coordinate is too large": _any_of(owner[(np.abs(coordinates) > MAX_COORDINATE).any(axis=1)], len(shapes)),
    }
    for text, chosen in unfit.items():
        _give(reason, chosen, text)
    features["reason"] = reason
    # What is left out for its columns keeps its shape: its length is accounted for like any other.
    shapeless = np.logical_or.reduce(list(unfit.values()))
    row, left = np.flatnonzero(~shapeless), np.flatnonzero(shapeless)
    geometry = shapely.force_2d(shapes[row])
    while (shapely.get_type_id(geometry) >= _FIRST_MULTI).any():
        geometry, part = shapely.get_parts(geometry, return_index=True)
        row = row[part]
    parts = features.iloc[np.concatenate([row, left])].copy()
    parts["shape"] = np.concatenate([geometry, np.full(len(left), None)])
    parts = parts.iloc[np.argsort(parts["feature"], kind="stable")].reset_index(drop=True)
    kind = shapely.get_type_id(parts["shape"].to_numpy())
    _exclude(parts, ~np.isin(kind, (*_LINES, _POLYGON, -1)), "neither a line nor a polygon")
    return parts


def _resolve_kinds(parts: pd.DataFrame, options: Options) -> pd.DataFrame:
    """Decide what is an area: declared by the class, else by the geometry (never guessed from the data)."""
    polygon = shapely.get_type_id(parts["shape"].to_numpy()) == _POLYGON
    declared_line = parts["class"].isin(LINE_CLASSES - options.area).to_numpy()
    parts["is_area"] = parts["class"].isin(options.area).to_numpy() | (polygon & ~declared_line)
    parts["as_polygon"] = polygon & parts["is_area"].to_numpy()
    parts = _polygons_to_rings(parts, polygon & declared_line)
    _lines_to_polygons(parts)
    return parts


def _polygons_to_rings(parts: pd.DataFrame, chosen: NDArray[np.bool_]) -> pd.DataFrame:
    """Replace polygons of a line class by their rings, each a closed line."""
    if not chosen.any():
        return parts
    rows = np.flatnonzero(chosen)
    rings, owner = shapely.get_rings(parts["shape"].to_numpy()[rows], return_index=True)
    exploded = parts.iloc[rows[owner]].assign(shape=_ring_to_line(rings))
    parts = pd.concat([parts[~chosen], exploded])
    return parts.iloc[np.argsort(parts["feature"], kind="stable")].reset_index(drop=True)


def _lines_to_polygons(parts: pd.DataFrame) -> None:
    """Close the lines of area classes, in place; two vertices enclose nothing."""
    kind = shapely.get_type_id(parts["shape"].to_numpy())
    rows = np.flatnonzero(parts["is_area"] & np.isin(kind, _LINES))
    lines = shapely.remove_repeated_points(parts["shape"].to_numpy()[rows], 0.0)
    distinct = shapely.get_num_coordinates(lines) - shapely.is_closed(lines)
    _exclude(parts, _any_of(rows[distinct < 3], len(parts)), "an open line of two vertices encloses no area")
    rows, lines = rows[distinct >= 3], lines[distinct >= 3]
    coordinates, owner = shapely.get_coordinates(lines, return_index=True)
    shapes = parts["shape"].to_numpy(copy=True)
    if len(rows):
        shapes[rows] = shapely.polygons(shapely.linearrings(coordinates, indices=owner))
    parts["shape"] = shapes


def _choose_crs(
    layers: list[Layer],
    parts: pd.DataFrame,
    options: Options,
    reference: pyproj.CRS | None,
    warnings: list[str],
) -> tuple[list[pyproj.CRS], pyproj.CRS, pyproj.CRS]:
    """Return the CRS of every layer, the reference one and the working one."""
    declared = None if options.crs is None else parse_crs(options.crs)
    usable = parts[parts["reason"].isna()]
    bounds = {
        int(number): tuple(shapely.total_bounds(group["shape"].to_numpy())) for number, group in usable.groupby("layer")
    }
    found = [_layer_crs(layer, declared, needed=number in bounds) for number, layer in enumerate(layers)]
    given = reference
    if reference is None:
        reference = next((crs for crs in found if crs is not None), declared)
    if reference is None:
        raise CrsError(_no_crs(layers[0].where))
    layer_crs = [reference if crs is None else crs for crs in found]
    plain = [layers[number].where for number in bounds if is_local(layer_crs[number])]
    placed = [layers[number].where for number in bounds if not is_local(layer_crs[number])]
    # That of the reference counts though it may hold nothing.
    placed += [layer.where for layer, crs in zip(layers, found, strict=True) if crs == reference and not is_local(crs)]
    if given is not None:
        (plain if is_local(given) else placed).append("the map")
    if plain and placed:
        raise CrsError(
            f"{plain[0]} has plain metric coordinates (crs=local) and cannot be brought together with {placed[0]}, "
            "which has a CRS; give all layers a CRS, or none"
        )
    for number, box in bounds.items():
        check_coordinates(layer_crs[number], box, layers[number].where)
    if not bounds or is_local(reference):
        return layer_crs, reference, reference
    boxes = np.array(
        [transformer(layer_crs[number], reference).transform_bounds(*box) for number, box in bounds.items()]
    )
    if not np.isfinite(boxes).all():
        raise CrsError(f"the layers lie so far apart that they cannot be brought together in {reference.name}")
    union = (*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist())
    work = working_crs(reference, union)
    error = scale_error_over(work, union, reference)
    if error > SCALE_TOLERANCE:
        warnings.append(
            f"the layers lie so far apart that lengths and the proximity are up to {error:.1%} off; merge places that "
            "are far from each other one by one"
        )
    return layer_crs, reference, work


def _layer_crs(layer: Layer, declared: pyproj.CRS | None, *, needed: bool) -> pyproj.CRS | None:
    crs = layer.data.crs
    if crs is not None:
        return parse_crs(crs)
    if declared is None and needed:
        raise CrsError(_no_crs(layer.where))
    return declared


def _no_crs(where: str) -> str:
    return (
        f"{where}: the layer has no coordinate reference system; declare it with crs (such as EPSG:32632), "
        "or crs=local for plain metric coordinates"
    )


def _to_working_crs(parts: pd.DataFrame, layer_crs: list[pyproj.CRS], work: pyproj.CRS) -> pd.DataFrame:
    """Reproject and clean; the shape in the layer's own CRS stays in the column `original`."""
    shapes = parts["shape"].to_numpy()
    before = shapely.get_num_coordinates(shapes)
    original = shapely.remove_repeated_points(shapes, 0.0)
    moved = original.copy()
    for (number, used), rows in parts.assign(used=parts["reason"].isna()).groupby(["layer", "used"]).indices.items():
        source = layer_crs[int(number)]
        if used or is_local(source) == is_local(work):
            moved[rows] = shapely.transform(
                moved[rows], lambda xy, source=source, used=used: transform_coordinates(xy, source, work, check=used)
            )
    moved = shapely.remove_repeated_points(moved, MIN_SEGMENT_M)
    cleaned = before - shapely.get_num_coordinates(moved)
    return parts.assign(shape=moved, original=original, cleaned=np.maximum(cleaned, 0))


def _check_out_crs(parts: pd.DataFrame, work: pyproj.CRS, out_crs: pyproj.CRS) -> None:
    """Refuse an output CRS in which the result would lie nowhere, or around the world."""
    usable = parts.loc[parts["reason"].isna(), "shape"].to_numpy()
    if work == out_crs or len(usable) == 0:
        return
    xmin, ymin, xmax, ymax = transformer(work, out_crs).transform_bounds(*shapely.total_bounds(usable))
    if not np.isfinite([xmin, ymin, xmax, ymax]).all():
        raise CrsError(f"the result has no place in {out_crs.name}; choose another out_crs")
    if xmin > xmax:
        raise CrsError(
            f"the result lies on both sides of the antimeridian, where {out_crs.name} ends; choose a projected out_crs"
        )
    check_coordinates(out_crs, (xmin, ymin, xmax, ymax), "the result")


def _check_shapes(parts: pd.DataFrame) -> None:
    """Give a reason to what has no length and to rings that cross themselves, in place."""
    usable = np.flatnonzero(parts["reason"].isna())
    shapes = parts["shape"].to_numpy()[usable]
    _exclude(parts, _any_of(usable[shapely.length(shapes) < MIN_SEGMENT_M], len(parts)), "zero length")
    areas = usable[shapely.get_type_id(shapes) == _POLYGON]
    crossed = areas[~shapely.is_valid(parts["shape"].to_numpy()[areas])]
    _exclude(parts, _any_of(crossed, len(parts)), "the ring of an area touches or crosses itself")


def _measure(parts: pd.DataFrame) -> None:
    """Add `from_m` and `to_m`: the parts of a feature follow each other along its length, in place."""
    length = shapely.length(parts["shape"].to_numpy())
    parts["length_m"] = np.where(np.isfinite(length), length, 0.0)
    parts["to_m"] = parts.groupby("feature")["length_m"].cumsum()
    parts["from_m"] = parts["to_m"] - parts["length_m"]


def _note_like_degrees(table: pd.DataFrame, notes: dict[str, Any]) -> None:
    """Say when plain coordinates look like degrees: a proximity of a metre would be a hundred kilometres."""
    if table.empty:
        return
    shapes = table["shape"].to_numpy()
    xmin, ymin, xmax, ymax = shapely.total_bounds(shapes)
    step = table["length_m"].sum() / np.maximum(shapely.get_num_coordinates(shapes).sum() - len(shapes), 1)
    if max(-xmin, xmax) <= 180 and max(-ymin, ymax) <= 90 and step < 0.01:
        notes["warnings"].append(
            "crs=local takes coordinates for metres, but these look like degrees; give their CRS, such as EPSG:4326"
        )


def _left_out(parts: pd.DataFrame, local_maps: list[LocalMaps]) -> pd.DataFrame:
    """List what was left out here and before."""
    earlier = [maps.left_out for maps in local_maps if maps.left_out is not None and len(maps.left_out)]
    return list_left_out([parts, *earlier])


def list_left_out(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """List what was left out, in canonical order.

    Parameters
    ----------
    tables : sequence of DataFrame
        Each with `LEFT_OUT_COLUMNS`, and maybe more.

    Returns
    -------
    DataFrame
        `LEFT_OUT_COLUMNS` of all.
    """
    if not any(map(len, tables)):
        return tables[0][list(LEFT_OUT_COLUMNS)]
    listed = pd.concat([table[list(LEFT_OUT_COLUMNS)] for table in tables])
    listed["instance"] = listed["instance"].astype(str)
    keys = ["source", "drive", "instance", "reason", "from_m", "to_m", "source_fid"]
    text = listed["source_fid"].astype(str)
    return (
        listed.assign(_fid=text.str.zfill(20))
        .sort_values([*keys[:-1], "_fid"])
        .drop(columns="_fid")
        .reset_index(drop=True)
    )


def _ring_to_line(rings: NDArray[np.object_]) -> NDArray[np.object_]:
    coordinates, owner = shapely.get_coordinates(rings, return_index=True)
    lines: NDArray[np.object_] = shapely.linestrings(coordinates, indices=owner) if len(rings) else rings
    return lines


def _any_of(rows: NDArray[np.intp], count: int) -> NDArray[np.bool_]:
    chosen = np.zeros(count, dtype=bool)
    chosen[rows] = True
    return chosen


def _give(reason: NDArray[np.object_], chosen: NDArray[np.bool_], text: str) -> None:
    """Give a reason to the chosen that have none yet, in place."""
    reason[chosen & pd.isna(reason)] = text


def _exclude(parts: pd.DataFrame, chosen: NDArray[np.bool_], text: str) -> None:
    reason = parts["reason"].to_numpy(dtype=object, copy=True)
    _give(reason, np.asarray(chosen), text)
    parts["reason"] = reason
