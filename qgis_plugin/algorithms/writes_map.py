"""What algorithms that write the file of a stored map have in common."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputFile,
    QgsProcessingOutputVectorLayer,
)

from ..destinations import Place
from ..parameters import absolute_file
from ..stored_map import address, edited, kinds_of, layers_of, map_fault, refresh, show, style_of
from ..translation import mark, tr
from .base import Parameters, WorkerAlgorithm

#: What becomes of the elements.
ELEMENT_NUMBERS = (
    ("ADDED", mark("Number of elements added")),
    ("CHANGED", mark("Number of elements changed")),
    ("MOVED", mark("Number of elements moved")),
    ("RETIRED", mark("Number of elements retired")),
    ("MERGED", mark("Number of elements merged into others")),
    ("ELEMENTS", mark("Number of elements of the map")),
)


class WritesMap(WorkerAlgorithm):
    """An algorithm whose worker writes the map itself; layers of the project show the new state after it."""

    LAYERS_OPTION = ""

    def __init__(self) -> None:
        super().__init__()
        self._map = ""
        self._kinds: list[str] = []

    def initAlgorithm(self, configuration: dict[str, Any] | None = None) -> None:
        """Declare the parameters, the file and its layers."""
        super().initAlgorithm(configuration)
        self.addOutput(QgsProcessingOutputFile("MAP", tr("Map")))
        self.addOutput(QgsProcessingOutputVectorLayer("OUTPUT", tr("Lines of the map")))
        self.addOutput(QgsProcessingOutputVectorLayer("AREAS", tr("Areas of the map")))

    def makes(self, parameters: Parameters, context: QgsProcessingContext) -> bool:
        """Say whether the map is made where there is none."""
        del parameters, context
        return False

    def fault(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Return what is wrong with the map, as far as QGIS can know."""
        file = absolute_file(self, parameters, "MAP", context)
        return (
            map_fault(file, create=self.makes(parameters, context))
            or edited(layers_of(context.project(), file))
            or super().fault(parameters, context)
        )

    def places_read(self, parameters: Parameters, context: QgsProcessingContext) -> list[Place]:
        """Return the map too, which the report must not overwrite."""
        return [*super().places_read(parameters, context), Place(absolute_file(self, parameters, "MAP", context))]

    def processAlgorithm(
        self, parameters: Parameters, context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Run the worker on the map itself."""
        done = super().processAlgorithm(parameters, context, feedback)
        self._map = absolute_file(self, parameters, "MAP", context)
        self._kinds = kinds_of(self._map)
        names = {"line": "OUTPUT", "polygon": "AREAS"}
        return {**done, "MAP": self._map, **{names[kind]: address(self._map, kind) for kind in self._kinds}}

    def postProcessAlgorithm(self, context: QgsProcessingContext, feedback: QgsProcessingFeedback) -> dict[str, Any]:
        """Have the project show the new state; this runs in its thread."""
        if context.project() is None or not self._map:
            return {}
        shown = layers_of(context.project(), self._map)
        if edited(shown):  # since the run began
            feedback.pushWarning(
                tr("A layer of the map is being edited, and shows the map as it was: open it again after that.")
            )
        refresh([layer for layer in shown if not layer.isEditable()])
        provider = self.provider()
        show(
            self._map, self._kinds, shown, context, [provider.style(style_of(kind), grows=True) for kind in self._kinds]
        )
        return {}
