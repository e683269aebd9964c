"""`polymerge:mergelocalmaps`: overlapping digitisations of the same lines become one map."""

from __future__ import annotations

from typing import Any

from qgis.core import QgsProcessingParameterDefinition

from ..parameters import (
    choice_parameter,
    column_parameters,
    footprint_parameter,
    layer_parameters,
    map_parameters,
    share_parameter,
    text_parameter,
)
from ..results import Result
from ..translation import mark, tr
from .layers import READING_OPTIONS, LayerAlgorithm


class MergeLocalMaps(LayerAlgorithm):
    """Merge local maps into one map."""

    NAME = "mergelocalmaps"
    TITLE = mark("Merge local maps")
    ICON = "merge"
    TAGS = mark("merge,conflate,conflation,average,mean,line,polyline,GPS,track,trace,survey,HD map,lane")
    SUMMARY = mark("Merges many overlapping, imperfect digitisations of the same lines or areas into one clean map.")
    HELP = mark(
        "Give it local maps of a perception model, GPS tracks of one path, or several surveys of one street. No column "
        "is needed. Every input feature ends in an element of the map (see Lineage) or in the list of those left out."
    )
    COMMAND = "merge"
    OPTIONS = (*READING_OPTIONS, "METHOD", "COVERAGE", "AGGREGATE")
    NUMBERS = (
        ("N_ELEMENTS", mark("Number of elements")),
        ("N_OBSERVATIONS", mark("Number of observations")),
        ("N_LEFT_OUT", mark("Number of features left out")),
    )

    def inputs(self) -> list[QgsProcessingParameterDefinition]:
        """Return the layers, their columns, and how to merge."""
        return [
            *layer_parameters(),
            footprint_parameter(),
            *column_parameters(),
            choice_parameter(
                "METHOD",
                tr("Method"),
                tr(
                    "consensus: one smooth line from all looks at it, more exact than each; what too few local maps "
                    "saw is left out where footprints are known. polymerge: the method as it was published."
                ),
                ("consensus", "polymerge"),
            ),
            share_parameter(
                "COVERAGE",
                tr("Coverage of areas"),
                tr(
                    "Of the method polymerge: the share of the observations of an area that must cover a place for it "
                    "to belong to the area. consensus does not use it."
                ),
                default=0.5,
            ),
            text_parameter(
                "AGGREGATE",
                tr("How columns are carried"),
                tr(
                    "first, mode, mean, min, max or sum for all columns, or COLUMN=FUNCTION for single ones, with "
                    "commas between. first: from the element of the main map, else from the longest observation "
                    "(polymerge: the longest of the earliest local map)."
                ),
                default="first",
            ),
            *map_parameters(),
        ]

    def results(self) -> list[Result]:
        """Return the merged map and the tables beside it."""
        return [
            Result(
                "OUTPUT",
                tr("Merged map"),
                ("elements",),
                "line",
                tr("One line for each element, with its id, class, score and number of observations."),
                style="merged_map",
                optional=False,
                shown_empty=True,
            ),
            Result(
                "AREAS",
                tr("Merged areas"),
                ("elements_areas", "elements"),
                "polygon",
                tr("The elements that are areas, such as pedestrian crossings that came as polygons."),
                style="merged_areas",
                precious=True,
            ),
            Result(
                "LINEAGE",
                tr("Lineage"),
                ("lineage",),
                "table",
                tr("Which stretch of which input feature went into which element."),
                style="lineage",
                shown_empty=True,
            ),
            Result(
                "LEFT_OUT",
                tr("Left out"),
                ("left_out",),
                "table",
                tr("What is in no element, with the reason."),
                style="left_out",
            ),
            Result(
                "ID_ALIASES",
                tr("Retired ids"),
                ("id_aliases",),
                "table",
                tr("The ids of elements of a main map that became part of another one, or were left out (-1)."),
                style="id_aliases",
                precious=True,
            ),
        ]

    def numbers(self, report: dict[str, Any]) -> dict[str, float]:
        """Count what came out."""
        return {
            "N_ELEMENTS": report["elements"],
            "N_OBSERVATIONS": report["observations"],
            "N_LEFT_OUT": sum(report["left_out"].values()),
        }
