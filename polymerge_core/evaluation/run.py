"""`evaluate`: how close a map is to a reference, class by class."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from polymerge_core.crs import crs_name
from polymerge_core.curves import Curves, count_up
from polymerge_core.errors import OptionError
from polymerge_core.evaluation import areas, detection, lengths, paired, region
from polymerge_core.evaluation.inputs import Maps, lines_of, read_maps
from polymerge_core.evaluation.mapping import PcmSample, sample_pairs
from polymerge_core.evaluation.matching import Sections, match
from polymerge_core.evaluation.measures import METRES, NONE, Measure, mean_of
from polymerge_core.evaluation.nearest import NearestLine
from polymerge_core.evaluation.result import MEASURE_COLUMNS, Evaluation
from polymerge_core.options import Options
from polymerge_core.sets import Input, Progress

#: What can say which part of the reference counts.
REGION_FROM = ("region", "observations", "footprints", "all")

#: A piece of the layer of errors is this many of the pieces that lengths are measured by: 2 m.
_PIECES = 4


def evaluate(  # noqa: PLR0913 - each option by its name, as in merge
    merged: Input,
    reference: Input,
    *,
    local_maps: Input | None = None,
    region: gpd.GeoDataFrame | gpd.GeoSeries | None = None,
    region_from: str | None = None,
    pcm: bool = False,
    class_field: str | None = None,
    class_name: str = "line",
    score_field: str | None = None,
    area: str | Sequence[str] = (),
    crs: Any = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Measure how close a map is to a reference.

    Parameters
    ----------
    merged : GeoDataFrame, LocalMaps, or sequence of them
        The map: lines or polygons in any CRS. A merged map, or single observations.
    reference : GeoDataFrame, LocalMaps, or sequence of them
        The true map, likewise.
    local_maps : GeoDataFrame, LocalMaps, or sequence of them, optional
        The observations that the map was made from: for the paired comparison, the region and the pictures.
    region : GeoDataFrame or GeoSeries, optional
        Polygons of the part that counts.
    region_from : {"region", "observations", "footprints", "all"}, optional
        Which part of the reference counts: inside `region`; within 2 m of an observation of the class; inside the
        footprints of the local maps; or all. By default the first of region and observations that is given, else all.
        Of the merged map, only what is inside a region or footprints counts; else all of it.
    pcm : bool, default False
        Whether to work out the partial curve mapping too: a few milliseconds a pair, on at most 2,000 pairs.
    class_field, score_field : str, optional
        Columns of class and confidence, in the layers that have them; `class` and `score` by default.
    class_name : str, default "line"
        The class of the features of a layer without a class column.
    area : str or sequence of str, optional
        Classes that are areas, beside `ped_crossing`.
    crs : any, optional
        CRS of layers without one, or "local" for plain metric coordinates.
    progress : callable, optional
        Called with the fraction done and a message; may raise to stop the work.

    Returns
    -------
    Evaluation
        The table of measures, the errors along the lines, and a report.

    Raises
    ------
    OptionError
        If an option has a value that it cannot have.
    SchemaError, CrsError, InputError
        If a layer cannot be used, or the reference holds nothing.

    References
    ----------
    DF and PCM: Sayed, Perminov, Tsetserukou, "PolyMerge", section IV. Average precision: Li et al., "VectorMapNet".

    Examples
    --------
    >>> import geopandas as gpd
    >>> from shapely import LineString
    >>> truth = gpd.GeoSeries([LineString([(0, 0), (90, 0)])])
    >>> drawn = gpd.GeoSeries([LineString([(10, 0.5), (50, 0.5)])])
    >>> evaluate(drawn, truth, crs="local").value("line", "frechet_best")
    0.5
    """
    options = Options.of(class_field=class_field, class_name=class_name, score_field=score_field, area=area, crs=crs)
    chosen = _chosen_region(region, region_from, local_maps)
    tell = progress or (lambda _fraction, _message: None)
    tell(0.0, "reading the layers")
    maps = read_maps(merged, reference, local_maps, region, options)
    if chosen == "footprints" and len(maps.footprints) == 0:
        raise OptionError("region_from=footprints needs local maps with their instances, which project writes")
    names = maps.classes()
    judged = []
    for number, name in enumerate(names):
        tell(0.2 + 0.6 * number / len(names), f"measuring {name}")
        judged.append(_judge(maps, name, chosen))
    sample = sample_pairs([(each.drawn, each.reference, each.sections) for each in judged]) if pcm else None
    if sample is not None:
        sample.measure(lambda share: tell(0.8 + 0.14 * share, "partial curve mapping"))
    tell(0.95, "putting the figures together")
    return _put_together(maps, judged, sample, chosen)


@dataclass(frozen=True)
class _Judged:
    """What is known of one class when all has been measured."""

    name: str
    merged: Curves
    reference: Curves
    #: The stretches of the merged map that count, and the element of each.
    drawn: Curves
    element: NDArray[np.intp]
    #: Pairs of such a stretch and a reference line.
    sections: Sections
    followed: lengths.Followed
    overlap: NDArray[np.float64] | None
    shape: list[Measure]
    rest: list[Measure]


def _chosen_region(region: Any, region_from: str | None, local_maps: Any) -> str:
    if region_from is None:
        return "region" if region is not None else "observations" if local_maps is not None else "all"
    if region_from not in REGION_FROM:
        raise OptionError(f"region_from cannot be {region_from!r}; it is one of {', '.join(REGION_FROM)}")
    needed = {"region": region, "observations": local_maps, "footprints": local_maps}
    if region_from in needed and needed[region_from] is None:
        missing = "region" if region_from == "region" else "local_maps"
        raise OptionError(f"region_from={region_from} needs {missing}, which is not given")
    return region_from


def _judge(maps: Maps, name: str, chosen: str) -> _Judged:
    """Measure one class."""
    elements, truth = maps.merged.of(name), maps.reference.of(name)
    merged, reference = Curves(lines_of(elements)), Curves(lines_of(truth))
    of_merged, of_reference = _counting(maps, name, chosen)
    to_reference, to_merged = NearestLine(reference, lengths.LATERAL_M), NearestLine(merged, lengths.LATERAL_M)
    followed = lengths.follow(merged, to_reference, of_merged)
    truth_followed = lengths.follow(reference, to_merged, of_reference)
    drawn, element = lengths.stretches_that_count(followed)
    sections = match(drawn, reference)
    best = sections.take(sections.best())
    shape = [
        mean_of("frechet_best", METRES, best.frechet),
        mean_of("frechet_check", METRES, sections.frechet),
    ]
    rest, overlap = _area_part(elements, truth, truth_followed)
    rest += _paired_part(maps, name, merged, reference)
    score = elements["score"].to_numpy(dtype=float)[element]
    rest += _detection_part(followed, drawn, score, truth_followed)
    rest += lengths.coverage_measures(followed, truth_followed)
    rest += [
        lengths.duplication(followed, reference),
        lengths.fragments(followed),
        lengths.zigzag("zigzag", followed, of_merged),
        lengths.zigzag("zigzag_reference", truth_followed, of_reference),
        *lengths.lateral_measures(followed),
    ]
    return _Judged(name, merged, reference, drawn, element, sections, followed, overlap, shape, rest)


def _counting(maps: Maps, name: str, chosen: str) -> tuple[region.Counts, region.Counts]:
    """Return which points of the merged map and of the reference count."""
    if chosen == "all":
        return region.everywhere, region.everywhere
    if chosen == "observations" and maps.local is not None:
        return region.everywhere, region.near(Curves(lines_of(maps.local.of(name))))
    polygons = maps.footprints if chosen == "footprints" or maps.region is None else maps.region
    inside = region.within(polygons)
    return inside, inside


def _area_part(
    elements: pd.DataFrame, truth: pd.DataFrame, truth_followed: lengths.Followed
) -> tuple[list[Measure], NDArray[np.float64] | None]:
    """Measure the areas of a class, if it has any."""
    drawn, true = elements["is_area"].to_numpy(dtype=bool), truth["is_area"].to_numpy(dtype=bool)
    if not drawn.any() and not true.any():
        return [], None
    shapes, wanted = elements["shape"].to_numpy(dtype=object), truth["shape"].to_numpy(dtype=object)
    pieces = truth_followed.pieces
    seen = np.bincount(pieces.line, truth_followed.counts, minlength=len(truth)) / np.bincount(
        pieces.line, minlength=len(truth)
    )
    overlap = np.full(len(elements), np.nan)
    overlap[drawn], _ = areas.best_overlaps(shapes[drawn], wanted[true])
    # An area of which half was not looked at cannot be drawn right.
    return areas.area_measures(shapes[drawn], wanted[true], seen[true] > 0.5), overlap


def _paired_part(maps: Maps, name: str, merged: Curves, reference: Curves) -> list[Measure]:
    if maps.local is None:
        return []
    rows = maps.local.of(name)
    observations = Curves(lines_of(rows))
    whole = None
    if rows["is_area"].any() and len(maps.footprints):
        footprint = np.where(rows["is_area"], maps.footprint[rows.index.to_numpy()], -1)
        whole = paired.holds_whole(observations, reference, maps.footprints, footprint)
    return paired.paired_measures(*paired.paired_errors(observations, merged, reference, whole))


def _detection_part(
    followed: lengths.Followed, drawn: Curves, score: NDArray[np.float64], truth_followed: lengths.Followed
) -> list[Measure]:
    true, _ = lengths.stretches_that_count(truth_followed)
    if drawn is not followed.curves or true is not truth_followed.curves:
        # Only what counts is there to be found, and to find.
        limit = detection.THRESHOLDS_M[-1]
        followed = lengths.follow(drawn, NearestLine(true, limit), region.everywhere)
        truth_followed = lengths.follow(true, NearestLine(drawn, limit), region.everywhere)
    return detection.detection_measures(detection.nearest_elements(followed, truth_followed), score, len(true))


def _put_together(maps: Maps, judged: list[_Judged], sample: PcmSample | None, chosen: str) -> Evaluation:
    """Make the table, the layers and the report."""
    rows: list[tuple[str, Measure]] = []
    for number, each in enumerate(judged):
        mapped = [] if sample is None else sample.measures(number)
        rows += [(each.name, row) for row in (*each.shape, *mapped, *each.rest)]
    table = pd.DataFrame([(name, *row) for name, row in rows], columns=list(MEASURE_COLUMNS))
    over_all = [_over_classes(table, name) for name in (*(f"ap_{each}" for each in detection.THRESHOLDS_M), "ap")]
    table = pd.concat([table, pd.DataFrame(over_all, columns=list(MEASURE_COLUMNS))], ignore_index=True)
    elements = pd.concat([_elements(maps, each) for each in judged], ignore_index=True)
    errors = pd.concat([_errors(maps, each) for each in judged], ignore_index=True)
    lateral = pd.DataFrame(
        {
            "class": pd.Categorical(
                np.repeat([each.name for each in judged], [int(_known(each).sum()) for each in judged]),
                categories=[each.name for each in judged],
            ),
            "error_m": np.concatenate([each.followed.nearest.distance[_known(each)] for each in judged]),
        }
    )
    report = _report(maps, judged, table, sample, chosen)
    observations = None if maps.local is None else _picture(maps, maps.local.table)
    return Evaluation(
        table,
        _frame(maps, elements),
        _frame(maps, errors),
        lateral,
        _picture(maps, maps.reference.table),
        observations,
        report,
    )


def _known(each: _Judged) -> NDArray[np.bool_]:
    return each.followed.counts & np.isfinite(each.followed.nearest.distance)


def _over_classes(table: pd.DataFrame, measure: str) -> tuple[Any, ...]:
    """Return the mean over the classes that have something to find."""
    values = table.loc[table["measure"] == measure, "value"].to_numpy(dtype=float)
    return ("all", *mean_of(measure, NONE, values))


def _elements(maps: Maps, each: _Judged) -> pd.DataFrame:
    """Return one row an element, with its own figures."""
    table = maps.merged.of(each.name)
    truth = maps.reference.of(each.name)
    best = each.sections.take(each.sections.best())
    # Of several stretches of one element the longest speaks for it.
    best = best.take(np.argsort(each.drawn.length[best.estimate], kind="stable"))
    element = each.element[best.estimate]
    reference_id = np.full(len(table), None, dtype=object)
    frechet = np.full(len(table), np.nan)
    reference_id[element] = truth["id"].to_numpy(dtype=object)[best.reference]
    frechet[element] = best.frechet
    counted = each.followed.counts
    distance = pd.Series(each.followed.nearest.distance[counted]).replace(np.inf, np.nan)
    grouped = distance.groupby(each.followed.pieces.line[counted])
    lateral = pd.DataFrame(
        {"median": grouped.median(), "p95": grouped.quantile(0.95), "near": grouped.count(), "all": grouped.size()}
    ).reindex(np.arange(len(table)))
    return pd.DataFrame(
        {
            "element_id": table["id"].to_numpy(dtype=object),
            "class": each.name,
            "score": table["score"].to_numpy(dtype=float),
            "length_m": each.merged.length,
            "reference_id": reference_id,
            "frechet_m": frechet,
            "iou": np.full(len(table), np.nan) if each.overlap is None else each.overlap,
            "lateral_median_m": lateral["median"].to_numpy(),
            "lateral_p95_m": lateral["p95"].to_numpy(),
            "beyond_share": (1 - lateral["near"] / lateral["all"]).to_numpy(),
            "geometry": table["shape"].where(table["as_polygon"], pd.Series(each.merged.lines, table.index)).to_numpy(),
        }
    )


def _errors(maps: Maps, each: _Judged) -> pd.DataFrame:
    """Return the map in pieces of two metres, each with its mean error."""
    table, pieces, curves = maps.merged.of(each.name), each.followed.pieces, each.merged
    counts = np.bincount(pieces.line, minlength=len(curves))
    _, number = count_up(counts)
    group = np.cumsum(number % _PIECES == 0) - 1
    first = np.flatnonzero(number % _PIECES == 0)
    last = np.append(first[1:], len(number)) - 1 if len(first) else first
    distance = np.where(each.followed.counts, each.followed.nearest.distance, np.nan)
    near = np.isfinite(distance)
    share = np.bincount(group, near, minlength=len(first))
    total = np.bincount(group, np.where(near, distance, 0.0), minlength=len(first))
    beyond = np.bincount(group, np.isinf(distance), minlength=len(first)) > share
    judged = np.bincount(group, each.followed.counts, minlength=len(first)) > 0
    line = pieces.line[first]
    geometry = curves.stretches(line, pieces.start[first], pieces.stop[last])
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.where(beyond, np.nan, total / share)
    rows = pd.DataFrame(
        {
            "element_id": table["id"].to_numpy(dtype=object)[line],
            "class": each.name,
            "error_m": error,
            "beyond": beyond,
            "geometry": geometry,
        }
    )
    return rows[judged]


def _frame(maps: Maps, table: pd.DataFrame) -> gpd.GeoDataFrame:
    """Return a layer in the CRS of the merged map."""
    geometry = maps.observed.to_output(table["geometry"].to_numpy(dtype=object))
    columns = {name: _typed(table[name]) for name in table.columns if name != "geometry"}
    return gpd.GeoDataFrame(columns, geometry=geometry, crs=maps.observed.out_crs)


def _typed(column: pd.Series) -> pd.Series:
    """Give ids the type that they have: whole numbers, else text."""
    if column.dtype != object:
        return column
    if pd.api.types.infer_dtype(column, skipna=True) in ("integer", "empty"):
        return column.astype("Int64")
    return column.map(lambda value: None if value is None else str(value)).astype("str")


def _picture(maps: Maps, table: pd.DataFrame) -> gpd.GeoDataFrame:
    shapes = table["shape"].to_numpy(dtype=object)
    frame = pd.DataFrame({"class": table["class"].to_numpy(dtype=object), "geometry": shapes})
    return _frame(maps, frame)


def _report(
    maps: Maps, judged: list[_Judged], table: pd.DataFrame, sample: PcmSample | None, chosen: str
) -> dict[str, Any]:
    observed = maps.observed
    known = table.astype(object).where(table.notna(), None)
    by_class: dict[str, dict[str, Any]] = {}
    for row in known.to_dict("records"):
        rest = {name: value for name, value in row.items() if name not in {"class", "measure"}}
        by_class.setdefault(str(row["class"]), {})[str(row["measure"])] = rest
    counts = {
        each.name: {
            "elements": len(each.merged),
            "elements_m": round(float(each.merged.length.sum()), 3),
            "without_reference": len(each.merged) - len(np.unique(each.element[each.sections.estimate])),
            "reference": len(each.reference),
            "reference_m": round(float(each.reference.length.sum()), 3),
        }
        for each in judged
    }
    left_out = observed.left_out["reason"].value_counts(sort=False)
    return {
        "region_from": chosen,
        "working_crs": crs_name(observed.crs),
        "out_crs": crs_name(observed.out_crs),
        "elements": len(maps.merged.table),
        "reference": len(maps.reference.table),
        "observations": None if maps.local is None else len(maps.local.table),
        "pcm_pairs": None if sample is None else sample.count,
        "left_out": {str(reason): int(count) for reason, count in left_out.items()},
        "classes": counts,
        "measures": by_class,
        "warnings": _warnings(maps, judged),
    }


def _warnings(maps: Maps, judged: list[_Judged]) -> list[str]:
    found = list(maps.observed.notes["warnings"])
    for each in judged:
        if len(each.reference) == 0:
            found.append(
                f"the reference has no {each.name!r}: {len(each.merged)} elements of it are compared with nothing"
            )
        elif len(each.merged) == 0:
            found.append(f"the map has no {each.name!r}, of which the reference has {len(each.reference)}")
    if shapely.area(maps.footprints).sum() == 0 and len(maps.footprints):
        found.append("the footprints of the local maps have no area")
    return found
