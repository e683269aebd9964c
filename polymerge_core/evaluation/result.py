"""What an evaluation gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import geopandas as gpd
import pandas as pd

#: Layers and table of a file of an evaluation.
ERRORS_LAYER = "errors"
EVALUATED_LAYER = "evaluated"
EVALUATED_AREAS_LAYER = "evaluated_areas"
MEASURES_TABLE = "measures"

#: Columns of the table of measures.
MEASURE_COLUMNS = ("class", "measure", "unit", "n", "value", "min", "max", "std")


@dataclass(frozen=True)
class Evaluation:
    """How close a map is to a reference.

    Parameters
    ----------
    table : DataFrame
        One row a class and measure, in the columns `MEASURE_COLUMNS`. `n` counts what was measured; `value` is the
        mean of it, or the figure itself, NaN where there is nothing to measure; `min`, `max` and `std` (of the
        population) belong to means, NaN elsewhere. The class ``all`` has what is defined over all classes.
    elements : GeoDataFrame
        The merged map in its own CRS, one row a part of a feature: `element_id`, `class`, `score`, `length_m`,
        `reference_id` (the best match, null where none is near), `frechet_m`, `iou` (areas), `lateral_median_m`,
        `lateral_p95_m`, `beyond_share`.
    errors : GeoDataFrame
        The merged map cut into pieces of two metres: `element_id`, `class`, `error_m` (mean distance to the nearest
        reference of the class within 1.5 m; null beyond), `beyond` (whether most of it has no reference so near).
    lateral : DataFrame
        The lateral error at points every half metre: `class`, `error_m` (at most 1.5 m). For histograms.
    reference, observations : GeoDataFrame
        What was compared with, and the local maps where they were given, for pictures: `class`, geometry; CRS of the
        merged map.
    report : dict
        Inputs, options, counts, warnings and the measures by class; ready for JSON.
    """

    table: pd.DataFrame
    elements: gpd.GeoDataFrame
    errors: gpd.GeoDataFrame
    lateral: pd.DataFrame
    reference: gpd.GeoDataFrame
    observations: gpd.GeoDataFrame | None
    report: dict[str, Any]

    def value(self, name: str, measure: str) -> float:
        """Return the figure of one class and measure.

        Parameters
        ----------
        name : str
            The class, or ``all``.
        measure : str
            Such as ``frechet_best``.

        Returns
        -------
        float
            NaN where nothing could be measured.

        Raises
        ------
        KeyError
            If there is no such class or measure.
        """
        chosen = self.table[(self.table["class"] == name) & (self.table["measure"] == measure)]
        if chosen.empty:
            raise KeyError(f"{name!r} has no measure {measure!r}")
        return float(chosen["value"].iloc[0])

    def summary(self) -> str:
        """Return the figures as a text: a row a measure, a column a class."""
        names = self.table["measure"].drop_duplicates()
        wide = self.table.set_index(["measure", "class"])["value"].unstack().loc[names]  # noqa: PD010 - nothing to aggregate
        wide = wide[[*(name for name in wide.columns if name != "all"), "all"]]
        units = self.table.drop_duplicates("measure").set_index("measure")["unit"]
        wide.insert(0, "unit", units.loc[names])
        return str(wide.rename_axis(index=None, columns=None).to_string(float_format="%.3f", na_rep="-"))

    def layers(self) -> dict[str, pd.DataFrame]:
        """Return what there is by layer name, ready for `polymerge_core.write_layers`; lines and polygons apart."""
        polygon = self.elements.geom_type == "Polygon"
        layers = {ERRORS_LAYER: self.errors, EVALUATED_LAYER: self.elements}
        if polygon.any() and not polygon.all():
            layers |= {EVALUATED_LAYER: self.elements[~polygon], EVALUATED_AREAS_LAYER: self.elements[polygon]}
        return layers | {MEASURES_TABLE: self.table}
