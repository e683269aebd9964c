"""An evaluation as one page: tables, pictures and their numbers as text, with nothing to load from elsewhere."""

from __future__ import annotations

from base64 import b64encode
from importlib.resources import files
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
from jinja2 import Environment, StrictUndefined

from polymerge_core.evaluation.lengths import LATERAL_M
from polymerge_core.evaluation.pictures import BINS, class_bounds, error_picture, histogram_picture, map_picture
from polymerge_core.evaluation.result import Evaluation

#: Rows of the table of the worst elements.
_WORST = 10


class _Described(NamedTuple):
    """What a measure is called and means on the page."""

    heading: str
    name: str
    text: str


_SHAPE, _FOUND, _LENGTH = "Shape", "What was found", "Along the lines"
_TEXTS = {
    "frechet_best": _Described(
        _SHAPE, "DF, best match", "discrete Frechet distance to the nearest line; less is better"
    ),
    "frechet_check": _Described(_SHAPE, "DF, every match", "the same to every line that comes near, as in the paper"),
    "pcm_best": _Described(_SHAPE, "PCM, best match", "partial curve mapping in a turned frame; less is better"),
    "pcm_check": _Described(_SHAPE, "PCM, every match", "the same to every line that comes near"),
    "pcm_raw_best": _Described(_SHAPE, "PCM as it lies, best match", "without turning; depends on the direction"),
    "pcm_raw_check": _Described(_SHAPE, "PCM as it lies, every match", "the same to every line that comes near"),
    "zigzag": _Described(_SHAPE, "Zigzag", "how much the lines turn; should be the reference's"),
    "zigzag_reference": _Described(_SHAPE, "Zigzag of the reference", "how much its lines turn"),
    "iou": _Described(_SHAPE, "IoU", "overlap of areas, intersection over union; 1 is best"),
    "corner_error": _Described(_SHAPE, "Corner error", "distance of the corners of areas; less is better"),
    "frechet_before": _Described(_SHAPE, "DF of observations", "their own error, where a merged element is near"),
    "frechet_after": _Described(_SHAPE, "DF of the map there", "the merged element's, over the same stretches"),
    "after_better": _Described(_SHAPE, "Observations beaten", "share of them than which the map is better"),
    "chamfer": _Described(_FOUND, "Chamfer distance", "to the nearest reference element; less is better"),
    "ap": _Described(_FOUND, "AP", "mean of the three average precisions; 1 is best"),
    "duplication": _Described(_LENGTH, "Duplication", "how often the reference is drawn; 1 is right"),
    "fragments": _Described(_LENGTH, "Fragments", "elements for each reference line; 1 is right"),
    "lateral": _Described(_LENGTH, "Lateral error", f"distance to the reference, where within {LATERAL_M:g} m"),
    "lateral_median": _Described(_LENGTH, "Lateral error, median", "half of the map is nearer"),
    "lateral_rms": _Described(_LENGTH, "Lateral error, RMS", "root mean square"),
    "lateral_p95": _Described(_LENGTH, "Lateral error, 95 %", "nineteen twentieths of the map are nearer"),
    "lateral_beyond": _Described(
        _LENGTH, "Without reference", f"share of the map farther than {LATERAL_M:g} m from any"
    ),
}
_FAMILIES = {
    "ap_": _Described(_FOUND, "AP at {} m", "average precision by Chamfer distance; 1 is best"),
    "precision_": _Described(_LENGTH, "Precision at {} m", "share of the map so near to the reference"),
    "recall_": _Described(_LENGTH, "Recall at {} m", "share of the reference so near to the map"),
    "f1_": _Described(_LENGTH, "F1 at {} m", "harmonic mean of the two"),
}


def render_page(result: Evaluation) -> str:
    """Lay an evaluation out as a page in HTML.

    Parameters
    ----------
    result : Evaluation
        What `polymerge_core.evaluate` gave.

    Returns
    -------
    str
        The page, with its pictures in it; the same for the same evaluation. It needs no script and asks for nothing.

    Examples
    --------
    >>> from polymerge_core import evaluate
    >>> from shapely import LineString
    >>> truth = gpd.GeoSeries([LineString([(0, 0), (90, 0)])])
    >>> render_page(evaluate(truth, truth, crs="local")).startswith("<!doctype html>")
    True
    """
    source = files("polymerge_core.evaluation").joinpath("page.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    environment.filters["figure"] = _figure_text
    names = [name for name in result.table["class"].drop_duplicates() if name != "all"]
    known = {*result.report["classes"]}
    return environment.from_string(source).render(
        report=result.report,
        names=names,
        headings=_measure_rows(result.table, names),
        over_all=_over_classes(result.table),
        sections=[_section(result, name) for name in names if name in known],
        worst=_worst(result.elements),
        limit=LATERAL_M,
    )


def describe(measure: str) -> tuple[str, str, str]:
    """Return the heading under which a measure stands, its name and its meaning."""
    if measure in _TEXTS:
        return _TEXTS[measure]
    for prefix, entry in _FAMILIES.items():
        if measure.startswith(prefix):
            return _Described(entry.heading, entry.name.format(measure.removeprefix(prefix)), entry.text)
    return _Described(_SHAPE, measure, "")


def _over_classes(table: pd.DataFrame) -> str:
    """Write what is defined over all classes as a sentence."""
    rows = table[table["class"] == "all"]
    figures = [
        f"{describe(str(name))[1].replace('AP', 'mAP')} {_figure_text(float(value))}"
        for name, value in zip(rows["measure"], rows["value"], strict=True)
    ]
    return f"Over all classes: {', '.join(figures)}."


def _figure_text(value: Any) -> str:
    """Write a number as the page has it."""
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _measure_rows(table: pd.DataFrame, names: list[str]) -> dict[str, list[dict[str, Any]]]:
    """Return by heading one row a measure, with the figures of every class."""
    rows: dict[str, list[dict[str, Any]]] = {_SHAPE: [], _FOUND: [], _LENGTH: []}
    for measure, group in table.groupby("measure", sort=False):
        heading, name, text = describe(str(measure))
        figures = {each["class"]: each for each in group.to_dict("records")}
        unit = group["unit"].iloc[0]
        rows[heading].append({"name": name, "text": text, "unit": unit, "cells": [figures.get(each) for each in names]})
    return {heading: entries for heading, entries in rows.items() if entries}


def _section(result: Evaluation, name: str) -> dict[str, Any]:
    """Return the pictures of one class and the numbers that they show."""
    merged, reference, errors = (_of(frame, name) for frame in (result.elements, result.reference, result.errors))
    observations = None if result.observations is None else _of(result.observations, name)
    error = result.lateral.loc[result.lateral["class"] == name, "error_m"].to_numpy(dtype=float)
    beyond = float(errors.loc[errors["beyond"].astype(bool)].length.sum()) if len(errors) else 0.0
    section: dict[str, Any] = {"name": name, "counts": result.report["classes"][name], "maps": None, "error": None}
    section |= {"observations": None if observations is None else len(observations), "beyond_m": beyond}
    section |= {"histogram": None, "bins": []}
    # The reference may be far larger than the map; what is shown is where the map is.
    view = class_bounds(merged, observations) or class_bounds(reference)
    if view is not None:
        before = {} if observations is None else {f"Before: {len(observations):,} observations": observations}
        panels = {**before, f"After: {len(merged):,} elements": merged, "Reference": reference.iloc[:0]}
        section["maps"] = _embedded(map_picture(panels, reference, view))
        section["error"] = _embedded(error_picture(errors, reference, view)) if len(errors) else None
    if len(error):
        counts, _ = np.histogram(error, BINS)
        section["histogram"] = _embedded(histogram_picture(error))
        section["bins"] = [
            (f"{low:.2f} to {high:.2f}", int(count))
            for low, high, count in zip(BINS[:-1], BINS[1:], counts, strict=True)
            if count
        ]
        section["median"], section["p95"] = (float(np.percentile(error, share)) for share in (50, 95))
    return section


def _of(frame: gpd.GeoDataFrame, name: str) -> gpd.GeoDataFrame:
    return frame[frame["class"] == name]


def _worst(elements: gpd.GeoDataFrame) -> list[dict[str, Any]]:
    """Return the elements with the largest lateral errors; those without any reference first."""
    columns = ["element_id", "class", "reference_id", "length_m", "frechet_m", "lateral_p95_m", "beyond_share"]
    table = pd.DataFrame(elements[columns])
    table["lateral_p95_m"] = table["lateral_p95_m"].fillna(np.inf)
    table = table.sort_values(["lateral_p95_m", "length_m"], ascending=False, kind="stable").head(_WORST)
    return [{key: None if pd.isna(value) else value for key, value in row.items()} for row in table.to_dict("records")]


def _embedded(picture: bytes) -> str:
    return "data:image/png;base64," + b64encode(picture).decode("ascii")
