"""How results look when they arrive in a project."""

from __future__ import annotations

from qgis.core import (
    NULL,
    QgsCategorizedSymbolRenderer,
    QgsMapLayer,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingLayerPostProcessorInterface,
    QgsRendererCategory,
    QgsVectorLayer,
)
from qgis.PyQt.QtGui import QColor

from .layout import style_path

#: A legend with more classes than these helps nobody.
_MOST_CLASSES = 24

# Steps of the golden angle keep any number of hues apart.
_FIRST_HUE, _GOLDEN_ANGLE = 280, 137


class Style(QgsProcessingLayerPostProcessorInterface):
    """Gives a result its layer style when QGIS has loaded it.

    Parameters
    ----------
    name : str
        Name of a file in `resources/styles`.
    grows : bool, default False
        Whether classes may come into the layer later, so that those of the style stay that are not in it yet.
    """

    def __init__(self, name: str, *, grows: bool = False) -> None:
        super().__init__()
        self._name, self._grows = name, grows

    def postProcessLayer(
        self, layer: QgsMapLayer, context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> None:
        """Load the style into the layer; QGIS calls this in the main thread."""
        del context
        if not isinstance(layer, QgsVectorLayer):
            return
        message, loaded = layer.loadNamedStyle(style_path(self._name))
        if not loaded:
            feedback.pushWarning(message)
        name_classes(layer, keep_all=self._grows)
        layer.triggerRepaint()


def name_classes(layer: QgsVectorLayer, *, keep_all: bool = False) -> None:
    """Give each class that the style does not know a category of its own, as far as a legend can hold them.

    Categories of classes that are not there go, unless all are to be kept.
    """
    renderer = layer.renderer()
    if not isinstance(renderer, QgsCategorizedSymbolRenderer):
        return
    column = layer.fields().lookupField(renderer.classAttribute())
    values = layer.uniqueValues(column, _MOST_CLASSES + 1) if column >= 0 else ()
    present = {"" if value in (None, NULL) else str(value) for value in values}
    categories = renderer.categories()
    others = next((each for each in categories if each.value() in (None, NULL, "")), None)
    if others is None or len(present) > _MOST_CLASSES:
        return
    named = renderer.clone()
    for number, name in enumerate(sorted(present - {str(each.value()) for each in categories})):
        symbol = others.symbol().clone()
        symbol.setColor(QColor.fromHsv((_FIRST_HUE + number * _GOLDEN_ANGLE) % 360, 200, 170))
        named.addCategory(QgsRendererCategory(name, symbol, name))
    for category in reversed(range(0 if keep_all else len(categories))):
        if str(categories[category].value()) not in present:
            named.deleteCategory(category)
    layer.setRenderer(named)
