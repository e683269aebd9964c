"""Reading the columns of the layer contract: class, drive, instance, score, timestamp, sigma.

What the user did not name is looked for under its default name, and has a default of its own where it is
missing. What the user named must be there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from polymerge_core.errors import SchemaError
from polymerge_core.options import Options
from polymerge_core.schema import ELEMENT_COLUMNS, LocalMaps, find_column

#: Order of an observation without a timestamp: after all that have one.
NO_TIMESTAMP = np.iinfo(np.int64).max

#: In the report: a source that does not say where its local maps looked.
NO_FOOTPRINTS = "not known, so nothing is left out for want of them"

_POINT_TYPES = {"Point", "MultiPoint"}


@dataclass(frozen=True)
class Layer:
    """One input layer and its part in the merge."""

    maps: LocalMaps
    is_main: bool

    @property
    def data(self) -> gpd.GeoDataFrame:
        """The observations."""
        return self.maps.observations

    @property
    def saw_nothing(self) -> bool:
        """Whether there are local maps, none of which saw anything."""
        return self.data.empty and self.maps.instances is not None and len(self.maps.instances) > 0

    @property
    def where(self) -> str:
        """The layer in words, for messages."""
        return f"{'main map' if self.is_main else 'layer'} {self.maps.source!r}"


def read_columns(layers: Sequence[Layer], options: Options) -> tuple[pd.DataFrame, pd.DataFrame, dict[str, Any]]:
    """Read every layer into one table of features with the contract's columns.

    Parameters
    ----------
    layers : sequence of Layer
        The main map, if any, first.
    options : Options
        Which columns hold what.

    Returns
    -------
    features : DataFrame
        `layer`, `source`, `source_fid`, `is_main`, `class`, `drive`, `instance`, `instance_kind`, `score`, `sigma`,
        `has_class`, `timestamp_ns`, `main_id`, `weight`, `looks`, `shape`, `reason` (why it is left out, else None).
    attributes : DataFrame
        The user's own columns, row by row.
    notes : dict
        `instance_from` and `footprints` of each source, and `warnings`.

    Raises
    ------
    SchemaError
        If a named column is missing, or a column cannot be what it is named for.
    """
    count = sum(not layer.is_main and not layer.data.empty for layer in layers)
    notes: dict[str, Any] = {"instance_from": {}, "footprints": {}, "warnings": []}
    features, attributes = [], []
    for number, layer in enumerate(layers):
        _check_layer(layer)
        if layer.data.empty and not layer.saw_nothing:
            notes["warnings"].append(f"{layer.where} holds no features")
        table, used = _features(layer, options, several=count > 1, notes=notes)
        features.append(table.assign(layer=number))
        attributes.append(_user_columns(layer, used, notes))
    merged = pd.concat(features, ignore_index=True)
    _check_ids(merged.loc[merged["main_id"] >= 0, ["source", "main_id"]])
    _note_classes_alike(merged["class"], notes)
    _note_missing_class(merged, notes)
    return merged, _join_attributes(attributes, notes), notes


def _check_layer(layer: Layer) -> None:
    data = layer.data
    if not isinstance(data, gpd.GeoDataFrame):
        raise SchemaError(f"{layer.where}: not a GeoDataFrame but {type(data).__name__}")
    if data.active_geometry_name is None:
        raise SchemaError(f"{layer.where}: the GeoDataFrame has no geometry column")
    if not data.columns.is_unique:
        twice = data.columns[data.columns.duplicated()][0]
        raise SchemaError(f"{layer.where}: there are two columns {twice!r}; rename one")
    kinds = set(data.geometry.geom_type.dropna().unique())
    if kinds and kinds <= _POINT_TYPES:
        raise SchemaError(f"{layer.where}: the layer holds points; PolyMerge merges lines and polygons")


def _features(layer: Layer, options: Options, *, several: bool, notes: dict[str, Any]) -> tuple[pd.DataFrame, set[str]]:
    """Read one layer; return its features and the names of the columns that were understood."""
    data, source = layer.data, layer.maps.source
    find = _Finder(layer, options)
    table = pd.DataFrame(
        {
            "source": source,
            "source_fid": data.index.to_numpy(),
            "is_main": layer.is_main,
            "shape": data.geometry.to_numpy(),
            "reason": np.full(len(data), None, dtype=object),
        }
    )
    table["shape"] = table["shape"].astype(object)
    table["class"] = _read_class(find, options, table)
    table["has_class"] = "class" in find.understood
    table["drive"] = _read_text(find("drive", options.drive_field), default=source)
    _read_instance(find, layer, options, table, several=several, notes=notes)
    _read_score(find, options, table)
    table["timestamp_ns"] = _read_timestamp(find("timestamp", options.timestamp_field), layer.where)
    sigma = find("sigma_m" if layer.is_main else "sigma", None)
    table["sigma"] = np.nan if sigma is None else pd.to_numeric(sigma, errors="coerce").to_numpy(dtype=float)
    _read_main(find, layer, table)
    return table, find.used


class _Finder:
    """Looks columns up by name and remembers which were understood."""

    def __init__(self, layer: Layer, options: Options) -> None:
        self.layer, self.options = layer, options
        #: Columns of the layer that were understood, and what each was understood as.
        self.used: set[str] = set()
        self.understood: set[str] = set()

    def __call__(self, default: str, name: str | None) -> pd.Series | None:
        data = self.layer.data
        columns = [column for column in data.columns if column != data.active_geometry_name]
        # A main map may have the contract's own columns, whatever the local maps call theirs.
        named = name is not None and (not self.layer.is_main or name in columns)
        wanted = default if name is None or not named else name
        found = find_column(columns, wanted, named=named, where=self.layer.where)
        if found is None:
            return None
        self.used.add(found)
        self.understood.add(default)
        return pd.Series(data[found].to_numpy(), dtype=data[found].dtype, name=found)


def _read_class(find: _Finder, options: Options, table: pd.DataFrame) -> pd.Series:
    column = find("class", options.class_field)
    if column is None:
        return pd.Series(options.class_name, index=table.index, dtype=object)
    missing = column.isna().to_numpy()
    _leave_out(table, missing, "no class")
    return as_text(column).where(~missing, "")


def _read_instance(
    find: _Finder, layer: Layer, options: Options, table: pd.DataFrame, *, several: bool, notes: dict[str, Any]
) -> None:
    """Decide what a local map is: the column's value, the whole layer, or each feature."""
    wanted = options.instance_from
    column = None
    if not layer.is_main and wanted in (None, "column"):
        needed = "instance" if wanted == "column" else None
        column = find("instance", options.instance_field or needed)
    if layer.is_main:
        rule = "layer"
    elif column is not None:
        rule = "column"
    else:
        rule = wanted or ("layer" if several else "feature")
    if column is not None:
        missing = column.isna().to_numpy()
        _leave_out(table, missing, "no instance")
        table["instance"] = as_text(column).where(~missing, "")
    elif rule == "layer":
        table["instance"] = layer.maps.source
    else:
        # The index of a GeoDataFrame need not be unique; a look is one feature all the same.
        again = table.groupby("source_fid", dropna=False).cumcount()
        table["instance"] = pd.Series(
            [
                f"{fid} ({count + 1})" if count else str(fid)
                for fid, count in zip(table["source_fid"], again, strict=True)
            ],
            dtype=object,
        )
    table["instance_kind"] = rule
    if not layer.is_main:
        notes["instance_from"][layer.maps.source] = rule
        known = layer.maps.instances is not None
        notes["footprints"][layer.maps.source] = "instances" if known else NO_FOOTPRINTS


def _read_score(find: _Finder, options: Options, table: pd.DataFrame) -> None:
    column = find("score", options.score_field)
    if column is None:
        table["score"] = 1.0
        return
    score = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float, na_value=np.nan)
    table["score"] = score
    if find.layer.is_main:
        table["score"] = np.where(np.isfinite(score), score, 1.0)
        return
    if len(score) and not ((score >= 0) & (score <= 1)).any():
        raise SchemaError(
            f"{find.layer.where}: the column {column.name!r} holds no scores, which are between 0 and 1; rename it, or "
            "name another column with score_field"
        )
    _leave_out(table, ~np.isfinite(score), "the score is not a number")
    _leave_out(table, (score < 0) | (score > 1), "the score is not between 0 and 1")
    _leave_out(table, score < options.min_score, f"the score is under min_score ({options.min_score:g})")


def _read_timestamp(column: pd.Series | None, where: str) -> NDArray[np.int64] | int:
    """Return integer nanoseconds, `NO_TIMESTAMP` where there is none."""
    if column is None:
        return NO_TIMESTAMP
    there = column.notna().to_numpy()
    nanoseconds = np.full(len(column), NO_TIMESTAMP, dtype=np.int64)
    nanoseconds[there] = _nanoseconds(column[there], where)
    return nanoseconds


def _nanoseconds(held: pd.Series, where: str) -> NDArray[np.int64]:
    """Read dates with times, or whole numbers (as text too: Shapefile has no numbers of 19 digits)."""
    if not pd.api.types.is_numeric_dtype(held):
        times = pd.to_datetime(held, utc=True, errors="coerce", format="ISO8601")
        # Beyond the years 1677 to 2262 nanoseconds would silently begin again.
        fits = times.between(pd.Timestamp.min.tz_localize("UTC"), pd.Timestamp.max.tz_localize("UTC"))
        if fits.all():
            return times.dt.tz_localize(None).to_numpy(dtype="datetime64[ns]").astype(np.int64)
        text = held.map(str)
        if not text.str.fullmatch(r"\d{1,19}").all():
            raise _not_a_timestamp(held[~fits], where)
        held = pd.to_numeric(text)
    numbers = held.to_numpy(dtype=float)
    whole = (np.abs(numbers) < NO_TIMESTAMP) & (np.floor(numbers) == numbers)
    if pd.api.types.is_bool_dtype(held) or not whole.all():
        raise _not_a_timestamp(held if whole.all() else held[~whole], where)
    return held.astype(np.int64).to_numpy()


def _not_a_timestamp(unfit: pd.Series, where: str) -> SchemaError:
    return SchemaError(
        f"{where}, column {unfit.name}: {unfit.iloc[0]!s} is not a timestamp; timestamps are dates with times, or "
        "integer nanoseconds (rename the column, or name another one with timestamp_field)"
    )


def _read_main(find: _Finder, layer: Layer, table: pd.DataFrame) -> None:
    """Read what a map says of its own elements: ids, and how many observations and instances they stand for."""
    # No looks: the local map, or the main map as a whole, counts as one.
    table["main_id"], table["weight"], table["looks"] = -1, 1, 0
    if not layer.is_main:
        return
    ids = find("element_id", None)
    if ids is None:
        ids = find("elem_id", None)
    if ids is not None:
        numbers = pd.to_numeric(ids, errors="coerce")
        if numbers.isna().any() or (numbers % 1 != 0).any() or (numbers < 0).any():
            raise SchemaError(f"{layer.where}: element_id holds something other than whole numbers")
        table["main_id"] = numbers.astype(np.int64).to_numpy()
    for name, short, column in (("n_observations", "n_obs", "weight"), ("n_instances", "n_inst", "looks")):
        values = find(name, None)
        values = find(short, None) if values is None else values
        if values is not None:
            count = pd.to_numeric(values, errors="coerce").fillna(1).to_numpy(dtype=float)
            table[column] = np.maximum(count, 1).astype(np.int64)


def _check_ids(known: pd.DataFrame) -> None:
    twice = known[known["main_id"].duplicated()]
    if len(twice):
        source, number = twice.iloc[0]
        raise SchemaError(f"main map {source!r}: element_id {number} occurs more than once; ids must be unique")


def _user_columns(layer: Layer, used: set[str], notes: dict[str, Any]) -> pd.DataFrame:
    """Return the columns that are the user's own."""
    ours = {name.lower() for name in ELEMENT_COLUMNS}
    written_anew = [str(name) for name in layer.data.columns if str(name).lower() in ours and name not in used]
    if written_anew and not layer.is_main:
        notes["warnings"].append(
            f"{layer.where}: the result has its own columns of the names {', '.join(written_anew)}"
        )
    columns = [
        column
        for column in layer.data.columns
        if column not in used and column != layer.data.active_geometry_name and str(column).lower() not in ours
    ]
    table = pd.DataFrame(layer.data[columns]).reset_index(drop=True)
    if "geometry" not in table:
        return table
    notes["warnings"].append(f"{layer.where}: the column 'geometry' is called 'geometry_1' in the result")
    return table.rename(columns={"geometry": "geometry_1"})


def _join_attributes(tables: list[pd.DataFrame], notes: dict[str, Any]) -> pd.DataFrame:
    """Bring the user's columns of all layers together; where types clash, values become text."""
    kinds: dict[str, set[str]] = {}
    for table in tables:
        for name, dtype in table.dtypes.items():
            kinds.setdefault(str(name), set()).add(_kind(dtype))
    clashing = sorted(name for name, found in kinds.items() if len(found) > 1)
    if clashing:
        notes["warnings"].append(f"columns of different types became text: {', '.join(clashing)}")
    cast = [table.assign(**{name: as_text(table[name]) for name in clashing if name in table}) for table in tables]
    # Not every layer has every column; int64 would turn to float where one is missing.
    return pd.concat([_nullable(table) for table in cast], ignore_index=True)


def _kind(dtype: Any) -> str:
    if pd.api.types.is_bool_dtype(dtype):
        return "bool"
    if pd.api.types.is_numeric_dtype(dtype):
        return "number"
    return "time" if pd.api.types.is_datetime64_any_dtype(dtype) else "text"


def _nullable(table: pd.DataFrame) -> pd.DataFrame:
    integers = {name: "Int64" for name, dtype in table.dtypes.items() if pd.api.types.is_integer_dtype(dtype)}
    return table.astype(integers)


def _note_classes_alike(classes: pd.Series, notes: dict[str, Any]) -> None:
    names = sorted(set(classes.dropna()))
    folded: dict[str, list[str]] = {}
    for name in names:
        folded.setdefault(name.strip().lower(), []).append(name)
    for alike in folded.values():
        if len(alike) > 1:
            notes["warnings"].append(f"the classes {', '.join(map(repr, alike))} are not merged with each other")


def _note_missing_class(features: pd.DataFrame, notes: dict[str, Any]) -> None:
    has_class = features["has_class"].astype(bool)
    named, unnamed = features[has_class], features[~has_class]
    others = set(named.loc[named["reason"].isna(), "class"])
    if unnamed.empty or not others or unnamed["class"].iloc[0] in others:
        return
    without = ", ".join(repr(source) for source in sorted(unnamed["source"].unique()))
    notes["warnings"].append(
        f"{without} has no class column, so its features are of class {unnamed['class'].iloc[0]!r}, which no other "
        f"layer has (they have {', '.join(map(repr, sorted(others)))}); class_name names the class they are of"
    )


def _read_text(column: pd.Series | None, *, default: str) -> pd.Series | str:
    if column is None:
        return default
    return as_text(column).where(column.notna(), default)


def as_text(column: pd.Series) -> pd.Series:
    """Return values as text; whole numbers without a decimal point, whatever type a format gave them."""
    if pd.api.types.is_float_dtype(column) and (column.dropna() % 1 == 0).all():
        column = column.astype("Int64")
    text = column.to_numpy(dtype=object, copy=True)
    missing = pd.isna(column).to_numpy()
    text[missing] = None
    text[~missing] = [str(value) for value in text[~missing]]
    return pd.Series(text, index=column.index, name=column.name, dtype=object)


def _leave_out(table: pd.DataFrame, chosen: NDArray[np.bool_], reason: str) -> None:
    """Give a reason to the chosen features that have none yet, in place."""
    reasons = table["reason"].to_numpy(dtype=object, copy=True)
    reasons[np.asarray(chosen, dtype=bool) & pd.isna(reasons)] = reason
    table["reason"] = reasons
