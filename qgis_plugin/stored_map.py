"""The file of a stored map: what it holds, which layers of the project show it, and how it gets there."""

from __future__ import annotations

from pathlib import Path

from qgis.core import (
    QgsFeatureRequest,
    QgsMapLayer,
    QgsProcessingContext,
    QgsProcessingUtils,
    QgsProject,
    QgsProviderRegistry,
    QgsVectorLayer,
    QgsWkbTypes,
)

from .destinations import Place, same_file
from .staging import file_of, place_of_layer
from .styling import Style
from .translation import tr

#: The layer that is the map.
ELEMENTS = "elements"

#: A table that every stored map has, and nothing else.
_SETTINGS = "map_settings"

_GEOMETRY = {"line": "LineString", "polygon": "Polygon"}
_GEOMETRY_TYPES = {
    "line": QgsWkbTypes.GeometryType.LineGeometry,
    "polygon": QgsWkbTypes.GeometryType.PolygonGeometry,
}
_STYLES = {"line": "stored_map", "polygon": "stored_map_areas"}


def tables_of(file: str) -> list[str]:
    """Return the layers and tables of a file; none where it is no GeoPackage, or there is none."""
    if not Path(file).is_file():
        return []
    metadata = QgsProviderRegistry.instance().providerMetadata("ogr")
    return [each.name() for each in metadata.querySublayers(file)]


def map_fault(file: str, *, create: bool) -> str:
    """Say why a file cannot be the map of a run; empty where it can.

    Parameters
    ----------
    file : str
        The whole path.
    create : bool
        Whether the map is made where there is none.
    """
    path = Path(file)
    if path.is_dir() or (path.exists() and path.stat().st_size and _SETTINGS not in tables_of(file)):
        return tr("{} is no stored map: choose the file of one, which “Update map” makes.").format(file)
    if path.exists():
        return ""
    if not create:
        return tr("There is no map {}: choose another file (a new map is made by “Update map”, with CREATE).").format(
            file
        )
    if path.suffix.lower() != ".gpkg":
        return tr("A map is a GeoPackage: give the new one a name that ends in .gpkg, not {}.").format(path.name)
    fault = Place(file).folder_fault
    return tr("The map cannot be made as {}: {}. Choose another folder.").format(file, tr(fault)) if fault else ""


def layers_of(project: QgsProject | None, file: str) -> list[QgsVectorLayer]:
    """Return the layers of a project that lie in a file."""
    layers = [] if project is None else project.mapLayers().values()
    return [layer for layer in layers if isinstance(layer, QgsVectorLayer) and _lies_in(layer, file)]


def edited(layers: list[QgsVectorLayer]) -> str:
    """Say that a layer is being edited, which the worker must not write under; empty where none is."""
    names = [layer.name() for layer in layers if layer.isEditable()]
    if not names:
        return ""
    return tr("Layer “{}” of this map is being edited: save or discard the edits, and run it again.").format(names[0])


def kinds_of(file: str) -> list[str]:
    """Return of what the map is made, lines or polygons; an empty map is one of lines."""
    one = QgsFeatureRequest().setLimit(1).setNoAttributes()
    found = [kind for kind in _GEOMETRY if any(True for _ in _open(address(file, kind)).getFeatures(one))]
    return found or ["line"]


def address(file: str, kind: str) -> str:
    """Return how QGIS opens the lines or the polygons of a map."""
    return f"{file}|layername={ELEMENTS}|geometrytype={_GEOMETRY[kind]}"


def refresh(layers: list[QgsVectorLayer]) -> None:
    """Have layers show what is in their file now."""
    for layer in layers:
        layer.reload()
        layer.updateExtents()
        layer.triggerRepaint()


def show(
    file: str, kinds: list[str], shown: list[QgsVectorLayer], context: QgsProcessingContext, styles: list[Style]
) -> None:
    """Have QGIS load the lines and polygons of a map that no layer of the project shows yet.

    Parameters
    ----------
    file : str
        The map.
    kinds : list of str
        Of what it is made.
    shown : list of QgsVectorLayer
        The layers of the project that lie in the file.
    context : QgsProcessingContext
        Of the run.
    styles : list of Style
        That of each kind.
    """
    titles = {"line": tr("Map {}"), "polygon": tr("Map {}, areas")}
    for kind, style in zip(kinds, styles):
        if any(_shows(layer, kind) for layer in shown):
            continue
        details = QgsProcessingContext.LayerDetails(
            titles[kind].format(Path(file).stem),
            context.project(),
            "OUTPUT" if kind == "line" else "AREAS",
            QgsProcessingUtils.LayerHint.Vector,
        )
        context.addLayerToLoadOnCompletion(address(file, kind), details)
        context.layerToLoadOnCompletionDetails(address(file, kind)).setPostProcessor(style)


def style_of(kind: str) -> str:
    """Return the name of the style of lines or polygons."""
    return _STYLES[kind]


def _lies_in(layer: QgsMapLayer, file: str) -> bool:
    there = file_of(layer)
    return bool(there) and same_file(there, file)


def _shows(layer: QgsVectorLayer, kind: str) -> bool:
    return place_of_layer(layer).table == ELEMENTS and layer.geometryType() == _GEOMETRY_TYPES[kind]


def _open(source: str) -> QgsVectorLayer:
    options = QgsVectorLayer.LayerOptions()
    options.loadDefaultStyle = False
    return QgsVectorLayer(source, ELEMENTS, "ogr", options)
