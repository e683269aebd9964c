"""`polymerge:mergenetwork`: who is merged with whom."""

from __future__ import annotations

from typing import Any

from qgis.core import QgsProcessingParameterDefinition

from ..parameters import column_parameters, layer_parameters, map_parameters
from ..results import Result
from ..translation import mark, tr
from .layers import READING_OPTIONS, LayerAlgorithm


class MergeNetwork(LayerAlgorithm):
    """Show which observations would be merged with each other."""

    NAME = "mergenetwork"
    TITLE = mark("Merge network")
    ICON = "network"
    TAGS = mark("network,graph,component,cluster,group,merge,line,polyline,GPS,track,HD map")
    SUMMARY = mark("Shows which lines the method polymerge would merge with each other: the network behind it.")
    HELP = mark(
        "Lines that are coloured alike become one element by the method polymerge. Look here when it joins what does "
        "not belong together, and choose a smaller proximity, a higher lowest score, or the method consensus, which "
        "has no such network."
    )
    COMMAND = "network"
    OPTIONS = READING_OPTIONS
    NUMBERS = (
        ("N_COMPONENTS", mark("Number of components")),
        ("N_OBSERVATIONS", mark("Number of observations")),
        ("LARGEST_COMPONENT", mark("Observations in the largest component")),
    )

    def inputs(self) -> list[QgsProcessingParameterDefinition]:
        """Return the layers and their columns."""
        return [*layer_parameters(), *column_parameters(), *map_parameters()]

    def results(self) -> list[Result]:
        """Return the observations and the links between them."""
        return [
            Result(
                "OUTPUT",
                tr("Network: observations"),
                ("observations",),
                "line",
                tr("The lines, and the outlines of areas, with the number of the component that becomes one element."),
                style="network_observations",
                optional=False,
                shown_empty=True,
            ),
            Result(
                "EDGES",
                tr("Network: edges"),
                ("edges",),
                "line",
                tr("A link between the middles of each two observations that are merged, with their distance."),
                style="network_edges",
                shown_empty=True,
            ),
        ]

    def numbers(self, report: dict[str, Any]) -> dict[str, float]:
        """Count components and observations."""
        return {
            "N_COMPONENTS": report["components"],
            "N_OBSERVATIONS": report["observations"],
            "LARGEST_COMPONENT": report["largest_component"],
        }
