"""`polymerge:mapchanges`: what became of the elements of a stored map since a revision."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import QgsProcessingContext, QgsProcessingParameterDefinition

from ..destinations import Place
from ..parameters import absolute_file, changes_parameters
from ..progress import Part
from ..results import Result
from ..stored_map import map_fault, tables_of
from ..translation import mark, tr
from .base import Parameters, Staged, WorkerAlgorithm

_KINDS = ("added", "moved", "changed", "retired", "merged")


class MapChanges(WorkerAlgorithm):
    """Show what changed in a stored map."""

    NAME = "mapchanges"
    TITLE = mark("Changes of a map")
    GROUP = mark("Stored map")
    ICON = "changes"
    TAGS = mark("changes,difference,diff,history,revision,map,update,added,removed,moved,HD map")
    SUMMARY = mark("Shows what became of each element of a stored map since a revision.")
    HELP = mark(
        "Every run of “Update map” that brings something new is a revision; the table revisions in the file of the map "
        "lists them. One feature for each element that is another now: added, moved, changed, retired (looked for and "
        "not seen any more) or merged into another one. It is drawn as it is now, or as it last was."
    )
    COMMAND = "changes"
    OPTIONS = ("SINCE",)
    NUMBERS = (
        ("ADDED", mark("Number of elements added")),
        ("MOVED", mark("Number of elements moved")),
        ("CHANGED", mark("Number of elements changed")),
        ("RETIRED", mark("Number of elements retired")),
        ("MERGED", mark("Number of elements merged into others")),
    )

    def inputs(self) -> list[QgsProcessingParameterDefinition]:
        """Return the map and the revision."""
        return changes_parameters()

    def results(self) -> list[Result]:
        """Return the elements that changed, and where those that moved came from."""
        return [
            Result(
                "CHANGES",
                tr("Changes"),
                ("changes",),
                "line",
                tr("Each line of the map that is another now, with the kind of its change and how far it moved."),
                style="changes",
                optional=False,
                shown_empty=True,
            ),
            Result(
                "CHANGES_AREAS",
                tr("Changes of areas"),
                ("changes_areas", "changes"),
                "polygon",
                tr("The same of elements that are areas."),
                style="changes_areas",
                precious=True,
            ),
            Result(
                "MOVES",
                tr("Moves"),
                ("moves",),
                "line",
                tr("An arrow from where an element was to where it is, for each one that moved."),
                style="moves",
            ),
        ]

    def places_read(self, parameters: Parameters, context: QgsProcessingContext) -> list[Place]:
        """Return the tables of the map."""
        file = absolute_file(self, parameters, "MAP", context)
        return [Place(file, table) for table in tables_of(file)]

    def fault(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Return what is wrong with the map."""
        file = absolute_file(self, parameters, "MAP", context)
        return map_fault(file, create=False) or super().fault(parameters, context)

    def stage(self, parameters: Parameters, context: QgsProcessingContext, folder: Path, part: Part) -> Staged:
        """Name the map, which the worker reads itself."""
        del folder, part
        return Staged([], [absolute_file(self, parameters, "MAP", context)], {})

    def numbers(self, report: dict[str, Any]) -> dict[str, float]:
        """Count the changes of each kind."""
        return {kind.upper(): report["changes"].get(kind, 0) for kind in _KINDS}
