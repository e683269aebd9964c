"""From merged shapes to the merged map: ids, columns, types of geometry, and who went into what."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from polymerge_core.errors import OptionError
from polymerge_core.observations import Observations, as_lines
from polymerge_core.options import Options
from polymerge_core.schema import ALIAS_COLUMNS, LINEAGE_COLUMNS, NO_ELEMENT
from polymerge_core.sets import ElementSets


def build_elements(
    observations: Observations,
    sets: ElementSets,
    shapes: NDArray[np.object_],
    options: Options,
    known: Mapping[str, NDArray[np.float64]] | None = None,
) -> tuple[gpd.GeoDataFrame, NDArray[np.int64], pd.DataFrame]:
    """Turn merged shapes into the layer `elements`.

    Parameters
    ----------
    observations : Observations
        What was merged.
    sets : ElementSets
        Which observations became one element.
    shapes : ndarray of shapely geometries, shape (m,)
        The merged shape of each component, in the working CRS; areas as polygons.
    options : Options
        How the user's columns are carried.
    known : mapping of str to ndarray, optional
        Columns of the elements that the method knows better, or more of.

    Returns
    -------
    elements : GeoDataFrame
        Ordered by `element_id`, in the output CRS.
    ids : ndarray of int, shape (m,)
        The `element_id` of each component.
    aliases : DataFrame
        `old_id`, `element_id` of the main map's ids that are no more; `NO_ELEMENT` where nothing is left.
    """
    table, component, base = observations.table, sets.component, sets.base
    ids, aliases = _assign_ids(observations, sets, shapes)
    weight = table["weight"].to_numpy(dtype=float)
    total = np.bincount(component, weight, len(base))
    columns = {
        "element_id": ids,
        "class": table["class"].to_numpy()[base],
        "score": np.bincount(component, weight * table["score"].to_numpy(), len(base)) / np.maximum(total, 1),
        "n_observations": total.astype(np.int64),
        "n_instances": _count_instances(table, component, len(base)),
        "length_m": shapely.length(shapes),
        **(known or {}),
    }
    attributes = _carry_columns(observations.attributes, component, base, options.aggregate)
    geometry = _output_geometry(observations, component, base, shapes)
    frame = pd.concat([pd.DataFrame(columns), attributes], axis=1)
    elements = gpd.GeoDataFrame(frame, geometry=geometry, crs=observations.out_crs)
    return elements.sort_values("element_id").reset_index(drop=True), ids, aliases


def build_lineage(observations: Observations, sets: ElementSets, ids: NDArray[np.int64]) -> pd.DataFrame:
    """List which interval of which observation went into which element.

    Parameters
    ----------
    observations : Observations
        What was merged.
    sets : ElementSets
        Which observations became one element.
    ids : ndarray of int, shape (m,)
        The `element_id` of each set.

    Returns
    -------
    DataFrame
        `LINEAGE_COLUMNS`; the weight is 1/n for each of the n observations of an element.
    """
    size = np.diff(sets.bounds)[sets.component]
    table = observations.table.assign(element_id=ids[sets.component], weight=1.0 / size)
    ordered = table.sort_values("element_id", kind="stable")
    return ordered[list(LINEAGE_COLUMNS)].reset_index(drop=True)


def _assign_ids(
    observations: Observations, sets: ElementSets, shapes: NDArray[np.object_]
) -> tuple[NDArray[np.int64], pd.DataFrame]:
    """Keep the smallest id of the main map in each component; number the rest in canonical order.

    An id that once meant another element is never given again, and what became of it stays on record.
    """
    table, component, base = observations.table, sets.component, sets.base
    known = pd.DataFrame({"old_id": table["main_id"], "component": component, "length_m": table["length_m"]})
    # What is left of one element may be in several: the parts of a multi-part one, or what it was cut into.
    share = known[known["old_id"] >= 0].groupby(["old_id", "component"], sort=False)["length_m"].sum().round(6)
    known = share.reset_index().sort_values("length_m", ascending=False, kind="stable").drop_duplicates("old_id")
    kept = known.groupby("component")["old_id"].min()
    ids = np.full(len(base), -1, dtype=np.int64)
    ids[kept.index] = kept.to_numpy()
    fresh = np.flatnonzero(ids < 0)
    _, key = np.unique(shapely.to_wkb(shapely.normalize(shapes[fresh])), return_inverse=True)
    _, name = np.unique(table["class"].to_numpy(dtype=str)[base[fresh]], return_inverse=True)
    order = fresh[np.lexsort((base[fresh], key, name))]
    ids[order] = observations.highest_id + 1 + np.arange(len(order))
    gone = pd.DataFrame({"old_id": np.setdiff1d(observations.main_ids, known["old_id"]), "element_id": NO_ELEMENT})
    aliases = pd.concat([known.assign(element_id=ids[known["component"]]), gone])
    aliases = aliases.loc[aliases["old_id"] != aliases["element_id"], list(ALIAS_COLUMNS)]
    now = dict(zip(aliases["old_id"], aliases["element_id"], strict=True))
    earlier = observations.id_aliases
    followed = earlier.assign(element_id=earlier["element_id"].map(lambda old: now.get(old, old)))
    aliases = pd.concat([aliases, followed]).astype(np.int64).drop_duplicates("old_id")
    return ids, aliases.sort_values("old_id").reset_index(drop=True)


def _count_instances(table: pd.DataFrame, component: NDArray[np.intp], count: int) -> NDArray[np.int64]:
    """Count the local maps in each component; a main map's element brings its own count, or the map counts once."""
    seen = pd.DataFrame({"component": component, "group": table["group"], "looks": table["looks"]})
    # Another piece of what is in the element already.
    seen = seen[table["weight"] > 0]
    counted = seen["looks"] > 0
    distinct = seen[~counted].drop_duplicates(["component", "group"])
    looks = seen[counted]
    local = np.bincount(distinct["component"], minlength=count)
    return (local + np.bincount(looks["component"], looks["looks"], count)).astype(np.int64)


def _carry_columns(
    attributes: pd.DataFrame, component: NDArray[np.intp], base: NDArray[np.intp], aggregate: str | Mapping[str, str]
) -> pd.DataFrame:
    """Carry the user's columns from observations to elements."""
    carried = attributes.iloc[base].reset_index(drop=True)
    for name, function in _chosen_functions(attributes, aggregate).items():
        if function != "first":
            values = _aggregate(attributes[name], component, function)
            carried[name] = values.reindex(range(len(base))).array
    # Integers were made nullable to bring layers together; where none is missing they are plain again.
    whole = [name for name, dtype in carried.dtypes.items() if dtype == "Int64" and not carried[name].hasnans]
    means = [name for name, dtype in carried.dtypes.items() if dtype == "Float64"]
    return carried.astype(dict.fromkeys(whole, np.int64) | dict.fromkeys(means, np.float64))


def _chosen_functions(attributes: pd.DataFrame, aggregate: str | Mapping[str, str]) -> dict[Any, str]:
    numeric = {name for name in attributes.columns if pd.api.types.is_numeric_dtype(attributes[name])}
    if isinstance(aggregate, str):
        # One function for all columns: means and sums are for the columns that have them.
        only_numbers = aggregate in ("mean", "sum", "min", "max")
        return {name: aggregate for name in attributes.columns if name in numeric or not only_numbers}
    for name, function in aggregate.items():
        if name not in attributes.columns:
            known = ", ".join(map(str, attributes.columns)) or "none"
            raise OptionError(f"aggregate names the column {name!r}, which is not there; the columns are {known}")
        if function in ("mean", "sum") and name not in numeric:
            raise OptionError(f"aggregate cannot take the {function} of {name!r}: the column holds no numbers")
    return dict(aggregate)


def _aggregate(values: pd.Series[Any], component: NDArray[np.intp], function: str) -> pd.Series[Any]:
    """Return one value for each component that has any."""
    if function == "mode":
        return _mode(values, component)
    groups = values.groupby(component)
    if function == "sum":
        whole = pd.api.types.is_integer_dtype(values) and values.notna().any()
        if whole and float(values.abs().max()) * len(values) >= 2.0**63:
            groups = values.astype("Float64").groupby(component)  # rather inexact than wrapped round
        return groups.sum(min_count=1)  # the sum of nothing is not 0
    try:
        return groups.agg(function)
    except (TypeError, ValueError) as error:
        raise OptionError(
            f"aggregate cannot take the {function} of {values.name!r}: some of its values cannot be compared"
        ) from error


def _mode(values: pd.Series[Any], component: NDArray[np.intp]) -> pd.Series[Any]:
    """Return the most frequent value of each component, the smallest where several are as frequent."""
    # Lists and dictionaries can be neither counted nor sorted; their text can.
    key = values if pd.api.types.is_numeric_dtype(values) else values.map(str)
    counted = pd.DataFrame({"component": component, "key": key, "value": values})[values.notna()]
    counted["count"] = counted.groupby(["component", "key"])["key"].transform("size")
    counted = counted.sort_values(["component", "count", "key"], ascending=[True, False, True], kind="stable")
    return counted.drop_duplicates("component").set_index("component")["value"]


def _output_geometry(
    observations: Observations, component: NDArray[np.intp], base: NDArray[np.intp], shapes: NDArray[np.object_]
) -> NDArray[np.object_]:
    """Carry shapes to the output CRS; what nothing was merged into comes out bit for bit as it came in."""
    table = observations.table
    geometry = observations.to_output(shapes)
    same_crs = np.array([crs == observations.out_crs for crs in observations.layer_crs], dtype=bool)
    alone = np.bincount(component, minlength=len(base)) == 1
    untouched = alone & same_crs[table["layer"].to_numpy()[base]] if len(base) else alone
    geometry[untouched] = table["original"].to_numpy()[base[untouched]]
    as_polygon = table["as_polygon"].to_numpy()[base]
    geometry[~as_polygon] = as_lines(geometry[~as_polygon])
    return geometry
