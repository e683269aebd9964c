"""The layer contract: what a layer of local maps holds, and what comes out of a merge.

This is the one place that knows column names, class kinds and what makes two observations belong to one
local map. `docs/architecture.md` states the contract in full.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import geopandas as gpd
import pandas as pd

from polymerge_core.crs import crs_name
from polymerge_core.errors import SchemaError

#: Names of the layers and tables in a file that holds more than one.
LOCAL_MAPS_LAYER = "local_maps"
INSTANCES_LAYER = "instances"
ELEMENTS_LAYER = "elements"
AREAS_LAYER = "elements_areas"
LINEAGE_TABLE = "lineage"
LEFT_OUT_TABLE = "left_out"
ALIASES_TABLE = "id_aliases"

#: Classes that are lines even where they come as polygons, and the class that is an area even as a line.
LINE_CLASSES = frozenset({"divider", "boundary"})
AREA_CLASSES = frozenset({"ped_crossing"})

#: Columns that a merge writes itself; the same columns of an input are not carried along.
ELEMENT_COLUMNS = ("element_id", "class", "score", "n_observations", "n_instances", "length_m", "sigma_m")

#: Columns of the tables beside the merged map.
INTERVAL_COLUMNS = ("source", "source_fid", "drive", "instance", "from_m", "to_m")
LINEAGE_COLUMNS = ("source", "source_fid", "drive", "instance", "element_id", "from_m", "to_m", "weight")
LEFT_OUT_COLUMNS = (*INTERVAL_COLUMNS, "reason")
ALIAS_COLUMNS = ("old_id", "element_id")

#: In the table of aliases: what became of an element of the main map that is in no element any more.
NO_ELEMENT = -1


@dataclass(frozen=True)
class LocalMaps:
    """Observations of one source, with what its predictor looked at.

    Parameters
    ----------
    observations : GeoDataFrame
        Line or polygon features, one observation a row, with a CRS. The index is the feature id.
    instances : GeoDataFrame, optional
        One row a local map (frame), the ones that saw nothing included: `drive`, `instance`, `timestamp_ns`,
        `x`, `y`, `heading`, `n_observations`; the geometry is the footprint, the area looked at.
    source : str, optional
        Name of the source: the drive where no column names one, and the `source` in lineage and left-out. Where it has
        none, a merge calls it ``local_maps``, or ``local_maps_1`` and so on in a list.
    left_out : DataFrame, optional
        What was left out before this point, in the columns `LEFT_OUT_COLUMNS`.
    id_aliases : DataFrame, optional
        Of a merged map: the ids that are no more, `old_id`, and what each is part of, `element_id` (-1: of nothing).
    """

    observations: gpd.GeoDataFrame
    instances: gpd.GeoDataFrame | None = None
    source: str = ""
    left_out: pd.DataFrame | None = None
    id_aliases: pd.DataFrame | None = None

    def layers(self) -> dict[str, pd.DataFrame]:
        """Return what there is by layer name, ready for `polymerge_core.write_layers`."""
        found = {LOCAL_MAPS_LAYER: self.observations, INSTANCES_LAYER: self.instances, LEFT_OUT_TABLE: self.left_out}
        return {name: table for name, table in found.items() if table is not None}

    def report(self) -> dict[str, Any]:
        """Return counts of instances, observations by class, and what was left out, ready for JSON."""
        data = self.observations
        reasons = {} if self.left_out is None else self.left_out["reason"].value_counts(sort=False).to_dict()
        return {
            "instances": 0 if self.instances is None else len(self.instances),
            "empty_instances": 0 if self.instances is None else int((self.instances["n_observations"] == 0).sum()),
            "observations": len(data),
            "classes": data["class"].value_counts().sort_index().to_dict() if "class" in data else {},
            "left_out": reasons,
            "crs": None if data.crs is None else crs_name(data.crs),
        }


def find_column(columns: Iterable[object], name: str, *, named: bool, where: str) -> str | None:
    """Find a column by its name, or by the one name that differs from it in case only.

    Parameters
    ----------
    columns : iterable of str
        The columns of the layer.
    name : str
        The column looked for.
    named : bool
        Whether the user named it, so that it must be there.
    where : str
        The layer, for the message.

    Returns
    -------
    str or None
        The column's name in the layer, None where it has none and the user named none.

    Raises
    ------
    SchemaError
        If a named column is missing, or several differ from it in case only.
    """
    present = [column for column in columns if isinstance(column, str)]
    if name in present:
        return name
    alike = [column for column in present if column.lower() == name.lower()]
    if len(alike) > 1:
        raise SchemaError(f"{where}: the columns {', '.join(alike)} differ in case only; name one of them exactly")
    if not alike and named:
        raise SchemaError(f"{where}: there is no column {name!r}; the columns are {', '.join(present) or 'none'}")
    return alike[0] if alike else None


def polygons_apart(name: str, areas_name: str, frame: gpd.GeoDataFrame) -> dict[str, gpd.GeoDataFrame]:
    """Return a layer by its name; where it holds polygons beside lines, these under a name of their own.

    The formats hold one type of geometry in a layer.
    """
    polygon = frame.geom_type == "Polygon"
    if polygon.any() and not polygon.all():
        return {name: frame[~polygon], areas_name: frame[polygon]}
    return {name: frame}


def empty_table(columns: Iterable[str]) -> pd.DataFrame:
    """Return a table without rows whose columns have the contract's types."""
    return _empty_table(tuple(columns)).copy()


@cache
def _empty_table(columns: tuple[str, ...]) -> pd.DataFrame:
    text = ("source", "drive", "instance", "reason")
    kinds = dict.fromkeys(text, "str") | {"element_id": "int64", "old_id": "int64", "source_fid": "int64"}
    return pd.DataFrame({name: pd.Series(dtype=kinds.get(name, "float64")) for name in columns})
