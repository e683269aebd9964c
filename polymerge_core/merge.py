"""From layers to a map, by either method: the consensus, or the method as it was published.

The consensus finds the lines that all looks show together (`polymerge_core.consensus`). The order of the steps of the
published method is the paper's (section II-B): concatenate the local maps and the main map, find who is to be merged
with whom, class by class, and merge each connected set under its class. Every observation ends in an element (table
`lineage`) or among those left out (table `left_out`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from polymerge_core.area import merge_areas
from polymerge_core.batch import PolylineSets, merge_sets
from polymerge_core.consensus import describe_corrections, merge_by_consensus
from polymerge_core.crs import crs_name
from polymerge_core.elements import build_elements, build_lineage
from polymerge_core.observations import Observations, observe
from polymerge_core.options import Options
from polymerge_core.schema import (
    ALIASES_TABLE,
    AREA_CLASSES,
    AREAS_LAYER,
    ELEMENTS_LAYER,
    LEFT_OUT_TABLE,
    LINEAGE_TABLE,
    LocalMaps,
    polygons_apart,
)
from polymerge_core.sets import ElementSets, Input, Progress, as_local_maps, find_network, note_layers_apart, order_sets


@dataclass(frozen=True)
class MergeResult:
    """What a merge gives.

    Parameters
    ----------
    elements : GeoDataFrame
        The merged map: `element_id`, `class`, `score`, `n_observations`, `n_instances`, `length_m`, in "consensus"
        `sigma_m` (median standard error, metres; NaN where nothing is known of it), the user's columns, geometry in
        the type in which it came, in the output CRS; ordered by `element_id`.
    lineage : DataFrame
        Which interval (metres along the source feature) of which observation went into which element.
    left_out : DataFrame
        What is in no element, with a reason. With `lineage` it covers each observation exactly once.
    id_aliases : DataFrame
        Ids of main-map elements that became part of another one: `old_id`, `element_id`; -1 where all of the element is
        left out.
    report : dict
        Counts, options and CRSs, and under `warnings` a list of sentences on what may be wrong with the inputs, such as
        features that nothing can be merged with; ready for JSON.
    """

    elements: gpd.GeoDataFrame
    lineage: pd.DataFrame
    left_out: pd.DataFrame
    id_aliases: pd.DataFrame
    report: dict[str, Any]

    def as_main_map(self) -> LocalMaps:
        """Return the map as the main map of another merge, which then gives no id to two elements."""
        return LocalMaps(self.elements, source="main_map", id_aliases=self.id_aliases)

    def layers(self) -> dict[str, pd.DataFrame]:
        """Return what there is by layer name, ready for `polymerge_core.write_layers`.

        Returns
        -------
        dict of GeoDataFrame and DataFrame
            `elements`, the tables, and, where the map holds polygons beside lines, the polygons apart in
            `elements_areas`: the formats hold one type of geometry.
        """
        layers = polygons_apart(ELEMENTS_LAYER, AREAS_LAYER, self.elements)
        tables = {LINEAGE_TABLE: self.lineage, LEFT_OUT_TABLE: self.left_out, ALIASES_TABLE: self.id_aliases}
        return layers | tables


def merge(  # noqa: PLR0913 - each option by its name, as geopandas users know it
    local_maps: Input,
    main_map: Input | None = None,
    *,
    class_field: str | None = None,
    class_name: str = "line",
    drive_field: str | None = None,
    instance_field: str | None = None,
    instance_from: str | None = None,
    score_field: str | None = None,
    min_score: float = 0.0,
    timestamp_field: str | None = None,
    method: str = "consensus",
    proximity: float = 1.0,
    coverage: float = 0.5,
    area: str | Sequence[str] = (),
    aggregate: str | Mapping[str, str] = "first",
    crs: Any = None,
    out_crs: Any = None,
    strict: bool = False,
    progress: Progress | None = None,
) -> MergeResult:
    """Merge local maps into one map.

    Parameters
    ----------
    local_maps : GeoDataFrame, LocalMaps, or sequence of them
        Lines or polygons in any CRS; one observation a row. The inputs are not changed.
    main_map : GeoDataFrame, LocalMaps, or sequence of them, optional
        The map to merge into; its `element_id` are kept. Lines and areas may come as two
        layers. In "polymerge", without one, the first instance plays its part.
    class_field : str, optional
        Column of the class, `class` by default. Only observations of one class are merged.
    class_name : str, default "line"
        The class of the features of a layer without a class column.
    drive_field, instance_field : str, optional
        Columns that tell which local map an observation belongs to, `drive` and `instance` by default.
    instance_from : {"column", "layer", "feature"}, optional
        What a local map is. By default the instance column; without one each layer where there are several,
        each feature where there is one.
    score_field : str, optional
        Column of the predictor's confidence, `score` by default; 1 where there is none.
    min_score : float, default 0
        Observations under it are left out (the paper uses 0.8).
    timestamp_field : str, optional
        Column that orders the instances, `timestamp` by default: dates with times, or integer nanoseconds.
    method : {"consensus", "polymerge"}, default "consensus"
        How observations become elements: "consensus" one smooth line from all looks at it, robustly averaged;
        "polymerge" as published.
    proximity : float, default 1.0
        Metres. In "consensus" the scale of all lengths: looks that run alongside each other no farther apart than this
        are of one line. In "polymerge" Th_prox: polylines with a vertex nearer than this to each other are merged.
    coverage : float, default 0.5
        Of "polymerge" alone, Th_cov, for area classes: the share of areas that must cover a place.
    area : str or sequence of str, optional
        Classes that are areas, beside `ped_crossing`. Polygons of other classes are areas too, but for those of
        the classes `divider` and `boundary`.
    aggregate : str or mapping, default "first"
        How the user's columns are carried: `first` (the base observation's: the main map's, else the longest one of
        "consensus", the longest one of the earliest instance of "polymerge"), `mode`, `mean`, `min`, `max` or `sum`;
        one for all columns, or by column name.
    crs : any, optional
        CRS of layers without one, or "local" for plain metric coordinates.
    out_crs : any, optional
        CRS of the result; the main map's, else the first layer's by default.
    strict : bool, default False
        Whether a feature that has to be left out is an error.
    progress : callable, optional
        Called with the fraction done and a message; may raise to stop the work.

    Returns
    -------
    MergeResult
        Elements, lineage, left-out, id aliases and report; read ``report["warnings"]``, which is printed by the command
        line alone.

    Raises
    ------
    OptionError
        If an option has a value that it cannot have.
    SchemaError, CrsError, InputError
        If a layer cannot be used.

    References
    ----------
    Sayed, Perminov, Tsetserukou, "PolyMerge: A Novel Technique aimed at Dynamic HD Map Updates Leveraging
    Polylines", section II-B, for "polymerge"; the modules of `polymerge_core.consensus` name theirs.

    Examples
    --------
    >>> import geopandas as gpd
    >>> from shapely import LineString
    >>> looks = gpd.GeoSeries([LineString([(5, y), (14, y)]) for y in (0.0, 0.1, 0.2)])
    >>> merge(looks, crs="local").elements.geometry.to_wkt(rounding_precision=1).tolist()
    ['LINESTRING (5 0.1, 14 0.1)']
    >>> looks = gpd.GeoSeries([LineString([(0, 0), (9, 0)]), LineString([(1, 0.5), (8, -0.5)])])
    >>> merge(looks, crs="local", method="polymerge").elements.geometry.to_wkt(rounding_precision=2).tolist()
    ['LINESTRING (0 0, 1 0.25, 8.01 -0.23, 9 0)']
    """
    options = Options.of(
        class_field=class_field,
        class_name=class_name,
        drive_field=drive_field,
        instance_field=instance_field,
        instance_from=instance_from,
        score_field=score_field,
        min_score=min_score,
        timestamp_field=timestamp_field,
        method=method,
        proximity=proximity,
        coverage=coverage,
        area=area,
        aggregate=aggregate,
        crs=crs,
        out_crs=out_crs,
        strict=strict,
    )
    report_progress = progress or (lambda _fraction, _message: None)
    if options.method == "consensus":
        return _merge_by_consensus(local_maps, main_map, options, report_progress)
    network = find_network(local_maps, main_map, options, report_progress, distances=False)
    sets = order_sets(network)
    shapes, lowered = _merge_shapes(network.observations, sets, options, report_progress)
    report_progress(0.95, "writing the tables")
    elements, ids, aliases = build_elements(network.observations, sets, shapes, options)
    lineage = build_lineage(network.observations, sets, ids)
    report = _report(network.observations, network.observations.left_out, sets, elements, options)
    report = _with_areas(report, network.observations, sets, options, lowered=lowered)
    report_progress(1.0, "merged")
    return MergeResult(elements, lineage, network.observations.left_out, aliases, report)


def _merge_by_consensus(local_maps: Input, main_map: Input | None, options: Options, progress: Progress) -> MergeResult:
    """Merge by consensus: one line from all looks at it."""
    progress(0.0, "reading the layers")
    main: list[LocalMaps] = [] if main_map is None else as_local_maps(main_map, "main_map")
    layers = as_local_maps(local_maps, "local_maps")
    observations = observe(layers, main, options)
    note_layers_apart(observations, options)
    merged = merge_by_consensus(
        observations, layers, options, lambda share: progress(0.1 + 0.85 * share, "finding the consensus")
    )
    progress(0.95, "writing the tables")
    pieces, sets = merged.observations, merged.sets
    elements, ids, aliases = build_elements(pieces, sets, merged.shapes, options, merged.columns)
    lineage = build_lineage(pieces, sets, ids)
    report = _report(observations, pieces.left_out, sets, elements, options)
    report["corrections"] = describe_corrections(merged.corrections)
    progress(1.0, "merged")
    return MergeResult(elements, lineage, pieces.left_out, aliases, report)


def _merge_shapes(
    observations: Observations, sets: ElementSets, options: Options, progress: Progress
) -> tuple[NDArray[np.object_], int]:
    """Merge each component into one shape; return them, and for how many areas the threshold was lowered."""
    table = observations.table
    shapes = table["shape"].to_numpy()
    merged = shapes[sets.base]
    is_area = table["is_area"].to_numpy()[sets.base]
    several = np.diff(sets.bounds) > 1
    total = max(1, int(shapely.get_num_coordinates(shapes).sum()))
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        progress(0.4 + 0.55 * min(1.0, done / total), "merging")

    lines = np.flatnonzero(several & ~is_area)
    merged[lines] = _merge_lines(shapes, sets, lines, advance)
    lowered = 0
    for number in np.flatnonzero(several & is_area).tolist():
        members = shapes[sets.order[sets.bounds[number] : sets.bounds[number + 1]]]
        result = merge_areas(members, coverage=options.coverage)
        merged[number] = result.polygon
        lowered += result.lowered
        advance(int(shapely.get_num_coordinates(members).sum()))
    return merged, lowered


def _merge_lines(
    shapes: NDArray[np.object_], sets: ElementSets, chosen: NDArray[np.intp], advance: Callable[[int], object]
) -> NDArray[np.object_]:
    """Merge the lines of the chosen components."""
    if len(chosen) == 0:
        return np.empty(0, dtype=object)
    size = np.diff(sets.bounds)[chosen]
    # Positions in `order` of all members of the chosen components, one after the other.
    ends = np.cumsum(size)
    members = sets.order[np.repeat(sets.bounds[chosen] - (ends - size), size) + np.arange(ends[-1])]
    counts = shapely.get_num_coordinates(shapes[members])
    first = ends - size
    bounds = np.append(0, np.cumsum(counts))[np.append(first, ends[-1])]
    flat = PolylineSets(shapely.get_coordinates(shapes[members]), bounds, counts[first].astype(np.intp))
    result = merge_sets(flat, advance=advance)
    owner = np.repeat(np.arange(len(result)), [len(line) for line in result])
    lines = shapely.linestrings(np.concatenate(result), indices=owner)
    # In exact arithmetic no vertex comes twice in a row; rounding can make it so.
    cleaned: NDArray[np.object_] = shapely.remove_repeated_points(lines, 0.0)
    return cleaned


def _with_areas(
    report: dict[str, Any], observations: Observations, sets: ElementSets, options: Options, *, lowered: int
) -> dict[str, Any]:
    """Say in the report what the published method does to areas."""
    table, warnings = observations.table, report["warnings"]
    several = np.diff(sets.bounds) > 1
    kinds = table.loc[sets.base[several], ["is_area", "class"]]
    drawn = kinds.loc[kinds["is_area"] & ~kinds["class"].isin(AREA_CLASSES), "class"]
    if len(drawn):
        warnings.append(
            f"{len(drawn)} merged areas of class {', '.join(sorted(map(repr, drawn.unique())))} became rectangles, as "
            f"method={options.method} makes of every area"
        )
    if lowered:
        warnings.append(
            f"{lowered} areas have no place that {options.coverage:.0%} of their observations cover; "
            "their highest coverage was used instead"
        )
    return report | {"areas_with_lowered_coverage": lowered}


def _report(
    observations: Observations,
    left_out: pd.DataFrame,
    sets: ElementSets,
    elements: gpd.GeoDataFrame,
    options: Options,
) -> dict[str, Any]:
    table = observations.table
    local = table[~table["is_main"]]
    made = elements.groupby("class")["length_m"].agg(elements="size", elements_m="sum")
    seen = local.groupby("class")["length_m"].agg(observations="size", observed_m="sum")
    by_class = made.join(seen).fillna(0)
    classes = {
        str(row.Index): {
            "observations": int(row.observations),
            "observed_m": round(float(row.observed_m), 3),
            "elements": int(row.elements),
            "elements_m": round(float(row.elements_m), 3),
        }
        for row in by_class.itertuples()
    }
    sizes = np.diff(sets.bounds)
    return {
        "method": options.method,
        "proximity_m": options.proximity,
        "coverage": options.coverage,
        "min_score": options.min_score,
        "working_crs": crs_name(observations.crs),
        "out_crs": crs_name(observations.out_crs),
        "instance_from": observations.notes["instance_from"],
        "footprints": observations.notes["footprints"],
        "observations": len(local),
        "main_map_elements": len(table) - len(local),
        "instances": int(local["group"].nunique()),
        "elements": len(elements),
        "largest_set": int(sizes.max()) if len(sizes) else 0,
        "left_out": {str(reason): int(count) for reason, count in left_out["reason"].value_counts(sort=False).items()},
        "cleaned_vertices": observations.notes["cleaned_vertices"],
        "classes": classes,
        "warnings": list(observations.notes["warnings"]),
    }
