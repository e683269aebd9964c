"""The parameters, each with its help; named as the options of the command line are, in capitals.

What a parameter is called says how it goes to the command line, so that nothing has to be translated by hand:
`MIN_SCORE` becomes ``--min-score``.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, TypeVar

from qgis.core import (
    NULL,
    QgsCoordinateReferenceSystem,
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterCrs,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterDistance,
    QgsProcessingParameterEnum,
    QgsProcessingParameterField,
    QgsProcessingParameterFile,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
    QgsProcessingParameterVectorLayer,
    QgsUnitTypes,
)

from .translation import tr

_Definition = TypeVar("_Definition", bound=QgsProcessingParameterDefinition)

#: The choice that leaves it to the command line.
AUTOMATIC = "auto"

_LINES = QgsProcessing.SourceType.TypeVectorLine
_AREAS = QgsProcessing.SourceType.TypeVectorPolygon
_ANY = QgsProcessing.SourceType.TypeVectorAnyGeometry
_TABLE = QgsProcessing.SourceType.TypeVector

#: The filter of the files that hold a stored map.
_MAPS = "GeoPackage (*.gpkg)"

_MOST_REVISIONS = 2**31 - 1


def explained(definition: _Definition, text: str, *, advanced: bool = False) -> _Definition:
    """Give a definition its help, and its place among the rare options."""
    definition.setHelp(text)
    if advanced:
        definition.setFlags(definition.flags() | QgsProcessingParameterDefinition.Flag.FlagAdvanced)
    return definition


def with_decimals(definition: _Definition) -> _Definition:
    """Have a number shown with two decimals instead of six."""
    definition.setMetadata({"widget_wrapper": {"decimals": 2}})
    return definition


def layers_parameter() -> list[QgsProcessingParameterDefinition]:
    """Return the layers of local maps, and whether their selection is meant."""
    layers = QgsProcessingParameterMultipleLayers("LOCAL_MAPS", tr("Layers to merge"), layerType=_ANY)
    layers.setMinimumNumberInputs(1)
    return [
        explained(
            layers,
            tr(
                "Line or polygon layers in any CRS. In one layer each feature is a look of its own (twelve GPS "
                "tracks), of several layers each layer is one look (three surveys)."
            ),
        ),
        switch_parameter(
            "SELECTED_ONLY",
            tr("Selected features of these layers only"),
            tr("Of layers with a selection, take the selected features; of the others all."),
            advanced=False,
        ),
    ]


def layer_parameters() -> list[QgsProcessingParameterDefinition]:
    """Return what merging and looking at the network read, and how near is near."""
    return [
        *layers_parameter(),
        explained(
            _proximity(tr("Proximity"), 1.0),
            tr(
                "Lines that run nearer to each other than this are taken for the same element; by the method "
                "polymerge, lines that come so near anywhere. In metres on the ground, whatever the CRS of the layers; "
                "at most 1000 m."
            ),
        ),
        explained(
            QgsProcessingParameterVectorLayer("MAIN_MAP", tr("Main map"), types=[_LINES, _AREAS], optional=True),
            tr("An earlier result to merge into; its elements keep their ids."),
        ),
    ]


def _proximity(title: str, default: float | None) -> QgsProcessingParameterDistance:
    """Return how near is near; without a default it may be left empty."""
    definition = QgsProcessingParameterDistance(
        "PROXIMITY", title, default, parentParameterName="", optional=default is None, minValue=0.0, maxValue=1000.0
    )
    definition.setDefaultUnit(QgsUnitTypes.DistanceUnit.DistanceMeters)
    return with_decimals(definition)


def stored_map_parameters() -> list[QgsProcessingParameterDefinition]:
    """Return the file of a stored map, and what holds for one that is made."""
    return [
        file_parameter(
            "MAP",
            tr("Map"),
            tr("The file of a stored map. To make one, write a name that is not taken yet and ends in .gpkg."),
            kinds=_MAPS,
        ),
        switch_parameter(
            "CREATE",
            tr("Make the map if there is none"),
            tr("Otherwise a name that is not there is an error, so that no map is made by mistake."),
            default=True,
            advanced=False,
        ),
        explained(
            _proximity(tr("Proximity of a new map"), None),
            tr(
                "How near is near in a map that is made, in metres on the ground; empty: 1 m. A map keeps the one that "
                "it was made with."
            ),
            advanced=True,
        ),
        explained(
            QgsProcessingParameterCrs("CRS", tr("CRS of a new map, and of layers without one"), optional=True),
            tr(
                "A projected CRS in metres. Empty: a new map is in that of the first layer where it is one, else in "
                "one centred on the data. Layers that have a CRS are not touched by it."
            ),
            advanced=True,
        ),
        local_crs_parameter(),
        _strict_parameter(),
    ]


def changes_parameters() -> list[QgsProcessingParameterDefinition]:
    """Return the file of a stored map, and since when its changes are asked for."""
    since = QgsProcessingParameterNumber(
        "SINCE",
        tr("Since revision"),
        type=QgsProcessingParameterNumber.Type.Integer,
        defaultValue=0,
        minValue=0,
        maxValue=_MOST_REVISIONS,
    )
    return [
        file_parameter("MAP", tr("Map"), tr("The file of a stored map, which “Update map” makes."), kinds=_MAPS),
        explained(
            since, tr("The map as it was at this revision is compared with the map as it is; 0 is the empty map.")
        ),
    ]


def undo_parameters() -> list[QgsProcessingParameterDefinition]:
    """Return the file of a stored map, and what of it is taken back."""
    revision, until = (
        QgsProcessingParameterNumber(
            name,
            title,
            type=QgsProcessingParameterNumber.Type.Integer,
            optional=name == "UNTIL",
            minValue=1,
            maxValue=_MOST_REVISIONS,
        )
        for name, title in (("REVISION", tr("Revision to take back")), ("UNTIL", tr("Until revision")))
    )
    return [
        file_parameter("MAP", tr("Map"), tr("The file of a stored map, which “Update map” makes."), kinds=_MAPS),
        explained(revision, tr("One that brought local maps; the table revisions of the map lists them.")),
        explained(
            until,
            tr("With it all revisions from that one to this one are taken back; empty: only that one."),
            advanced=True,
        ),
    ]


def footprint_parameter() -> QgsProcessingParameterDefinition:
    """Return what the local maps looked at."""
    return explained(
        QgsProcessingParameterVectorLayer("INSTANCES", tr("Footprints"), types=[_AREAS], optional=True),
        tr(
            "What the local maps looked at, as Project local maps gives it: polygons with the columns drive and "
            "instance. The method consensus leaves out what far fewer local maps saw than looked there; without "
            "footprints it leaves out nothing."
        ),
    )


def column_parameters() -> list[QgsProcessingParameterDefinition]:
    """Return which columns mean what; none is needed."""
    return [
        _field("CLASS_FIELD", tr("Class column"), tr("Only features of one class are merged. Empty: class, if any.")),
        _class_name_parameter(),
        _field("DRIVE_FIELD", tr("Drive or survey column"), tr("Empty: drive, if any; else the layer's name.")),
        _field(
            "INSTANCE_FIELD",
            tr("Local map (frame) column"),
            tr("Features of one frame were seen side by side. Empty: instance, if there is such a column."),
        ),
        choice_parameter(
            "INSTANCE_FROM",
            tr("What a local map is"),
            tr(
                "column: the features with one value in the column above; layer: all features of a layer; feature: "
                "each feature. auto: column where there is one, else layer for several layers, feature for one."
            ),
            (AUTOMATIC, "column", "layer", "feature"),
        ),
        _field("SCORE_FIELD", tr("Score column"), tr("Confidence from 0 to 1. Empty: score, if any; else 1.")),
        share_parameter(
            "MIN_SCORE",
            tr("Lowest score"),
            tr("Features with a lower score are left out, and listed there."),
            default=0.0,
        ),
        _field("TIMESTAMP_FIELD", tr("Time column"), tr("Orders the local maps. Empty: timestamp, if any.")),
        _area_parameter(),
    ]


def _class_name_parameter() -> QgsProcessingParameterString:
    return text_parameter(
        "CLASS_NAME",
        tr("Class of features without one"),
        tr("What the class of a feature is where no column names one."),
        default="line",
    )


def _area_parameter() -> QgsProcessingParameterString:
    return text_parameter(
        "AREA",
        tr("More area classes"),
        tr("Classes that are areas even where they come as lines, with commas between, beside ped_crossing."),
    )


def crs_parameters() -> list[QgsProcessingParameterDefinition]:
    """Return where layers without a CRS lie."""
    return [
        explained(
            QgsProcessingParameterCrs("CRS", tr("CRS of layers without one"), optional=True),
            tr("Says where layers without a CRS lie; layers that have one are not touched by it."),
            advanced=True,
        ),
        local_crs_parameter(),
    ]


def local_crs_parameter() -> QgsProcessingParameterBoolean:
    """Return that layers without a CRS lie nowhere."""
    return switch_parameter(
        "LOCAL_CRS",
        tr("Layers without a CRS are in plain metres"),
        tr("Their coordinates are metres that lie nowhere on Earth; nothing is reprojected."),
    )


def map_parameters() -> list[QgsProcessingParameterDefinition]:
    """Return the rest of a main map, the CRS, and what to do with bad features."""
    return [
        _map_part("MAIN_MAP_AREAS", tr("Areas of the main map"), _AREAS, tr("Where they are in a layer of their own.")),
        _map_part(
            "MAIN_MAP_ALIASES",
            tr("Retired ids of the main map"),
            _TABLE,
            tr("The table of retired ids that came with the main map, so that no id is ever given twice."),
        ),
        *crs_parameters(),
        explained(
            QgsProcessingParameterCrs("OUT_CRS", tr("CRS of the result"), optional=True),
            tr("Empty: that of the main map, else that of the first layer."),
            advanced=True,
        ),
        _strict_parameter(),
    ]


def _strict_parameter() -> QgsProcessingParameterBoolean:
    return switch_parameter(
        "STRICT",
        tr("Stop at a feature that cannot be used"),
        tr("Otherwise such features are left out, and listed there with the reason."),
    )


def share_parameter(name: str, title: str, text: str, *, default: float) -> QgsProcessingParameterNumber:
    """Return a number from 0 to 1."""
    definition = QgsProcessingParameterNumber(
        name,
        title,
        type=QgsProcessingParameterNumber.Type.Double,
        defaultValue=default,
        minValue=0.0,
        maxValue=1.0,
    )
    return explained(with_decimals(definition), text, advanced=True)


def _map_part(name: str, title: str, kind: Any, text: str) -> QgsProcessingParameterVectorLayer:
    return explained(QgsProcessingParameterVectorLayer(name, title, types=[kind], optional=True), text, advanced=True)


def choice_parameter(
    name: str, title: str, text: str, values: Sequence[str], *, advanced: bool = True
) -> QgsProcessingParameterEnum:
    """Return a choice between values, the first being the default."""
    # Values by name: a number in a script or a model would change its meaning when a value is added.
    choice = QgsProcessingParameterEnum(
        name, title, options=list(values), defaultValue=values[0], usesStaticStrings=True
    )
    return explained(choice, text, advanced=advanced)


def switch_parameter(
    name: str, title: str, text: str, *, default: bool = False, advanced: bool = True
) -> QgsProcessingParameterBoolean:
    """Return something that is off unless the user wants it."""
    return explained(QgsProcessingParameterBoolean(name, title, defaultValue=default), text, advanced=advanced)


def text_parameter(
    name: str, title: str, text: str, *, default: str | None = None, advanced: bool = True
) -> QgsProcessingParameterString:
    """Return a text that may be empty."""
    definition = QgsProcessingParameterString(name, title, defaultValue=default, optional=True)
    return explained(definition, text, advanced=advanced)


def file_parameter(
    name: str, title: str, text: str, *, kinds: str = "", default: str | None = None, optional: bool = False
) -> QgsProcessingParameterFile:
    """Return a file to read; `kinds` is a filter such as ``JSON (*.json)``."""
    # QGIS's own filter for all files, *.*, refuses names without an extension.
    wanted = ";;".join([*([kinds] if kinds else []), tr("All files (*)")])
    definition = QgsProcessingParameterFile(name, title, defaultValue=default, optional=optional, fileFilter=wanted)
    return explained(definition, text)


def folder_parameter(name: str, title: str, text: str) -> QgsProcessingParameterFile:
    """Return a folder that may be left empty."""
    folder = QgsProcessingParameterFile.Behavior.Folder
    return explained(QgsProcessingParameterFile(name, title, behavior=folder, optional=True), text)


def _field(name: str, title: str, text: str, *, layers: str = "LOCAL_MAPS") -> QgsProcessingParameterField:
    definition = QgsProcessingParameterField(name, title, parentLayerParameterName=layers, optional=True)
    return explained(definition, text, advanced=name != "CLASS_FIELD")


def compared_parameters() -> list[QgsProcessingParameterDefinition]:
    """Return what an evaluation reads."""

    def several(name: str, title: str, text: str, *, optional: bool = False) -> QgsProcessingParameterMultipleLayers:
        layers = QgsProcessingParameterMultipleLayers(name, title, layerType=_ANY, optional=optional)
        layers.setMinimumNumberInputs(0 if optional else 1)
        return explained(layers, text)

    region = QgsProcessingParameterVectorLayer("REGION", tr("Region that counts"), types=[_AREAS], optional=True)
    return [
        several("MERGED", tr("Map to evaluate"), tr("The lines and areas of the map, or single observations.")),
        several("REFERENCE", tr("Reference"), tr("The true map: lines and areas, in any CRS.")),
        several(
            "LOCAL_MAPS",
            tr("Observations"),
            tr("What the map was made from: for the comparison of map and observations, and for what counts."),
            optional=True,
        ),
        explained(region, tr("Polygons, such as the footprints of the local maps; nothing outside counts.")),
    ]


def comparing_parameters() -> list[QgsProcessingParameterDefinition]:
    """Return how an evaluation reads its layers, and what it works out."""
    text = tr(
        "region: what lies in the region above; observations: of the reference what lies within 2 m of an observation; "
        "footprints: what lies in the footprints that come with the observations; all: everything. auto: the region "
        "where there is one, else the observations, else all."
    )
    choices = (AUTOMATIC, "region", "observations", "footprints", "all")
    return [
        _field("CLASS_FIELD", tr("Class column"), tr("Only features of one class are compared."), layers="MERGED"),
        _class_name_parameter(),
        _field(
            "SCORE_FIELD", tr("Score column"), tr("Confidence from 0 to 1, for average precision."), layers="MERGED"
        ),
        _area_parameter(),
        choice_parameter("REGION_FROM", tr("What counts"), text, choices),
        switch_parameter(
            "PCM",
            tr("Partial curve mapping"),
            tr("Work out this measure of the paper too; it takes up to a minute."),
        ),
        *crs_parameters(),
    ]


def option_arguments(
    names: Sequence[str], algorithm: QgsProcessingAlgorithm, parameters: dict[str, Any], context: QgsProcessingContext
) -> list[str]:
    """Return what the user chose as the command line takes it.

    Parameters
    ----------
    names : sequence of str
        The parameters that are options of the command.
    algorithm : QgsProcessingAlgorithm
        Knows their types.
    parameters, context
        As Processing gives them to an algorithm.

    Returns
    -------
    list of str
        ``--min-score=0.3`` and so on; nothing for what the user left empty.
    """
    arguments = []
    for name in names:
        option = "--" + name.lower().replace("_", "-")
        kind = algorithm.parameterDefinition(name).type()
        if name == "CRS" and algorithm.parameterAsBoolean(parameters, "LOCAL_CRS", context):
            arguments.append("--crs=local")
            continue
        if kind == "boolean":
            arguments += [option] if algorithm.parameterAsBoolean(parameters, name, context) else []
            continue
        value = _as_text(kind, name, algorithm, parameters, context)
        several = [each.strip() for each in value.split(",")] if name in REPEATED else [value]
        arguments += [f"{option}={each}" for each in several if each]
    return arguments


#: Options of the command line that can be given several times: here one text, with commas between.
REPEATED = frozenset({"AREA", "AGGREGATE"})


def absolute_file(
    algorithm: QgsProcessingAlgorithm, parameters: dict[str, Any], name: str, context: QgsProcessingContext
) -> str:
    """Return the whole path of a file, which is to be found from any folder; empty where there is none."""
    file = algorithm.parameterAsFile(parameters, name, context)
    return os.path.abspath(file) if file else ""  # noqa: PTH100 - links stay as they are: they lead to environments


def is_known(crs: QgsCoordinateReferenceSystem) -> bool:
    """Whether a CRS says where something lies, or that it lies nowhere; GeoPackage has some that say nothing."""
    return bool(crs.isValid()) and crs.description() not in {"Undefined SRS", "Undefined geographic SRS"}


def crs_text(crs: QgsCoordinateReferenceSystem) -> str:
    """Return a CRS as PROJ reads it: its code where the whole world knows it, else its definition."""
    if crs.authid().startswith(("EPSG:", "ESRI:", "OGC:", "IGNF:")):
        return str(crs.authid())
    return str(crs.toWkt(QgsCoordinateReferenceSystem.WktVariant.WKT_PREFERRED)) if crs.isValid() else ""


def _as_text(
    kind: str, name: str, algorithm: QgsProcessingAlgorithm, parameters: dict[str, Any], context: QgsProcessingContext
) -> str:
    if kind in {"number", "distance"}:
        return _number_text(name, algorithm, parameters, context)
    if kind == "crs":
        return crs_text(algorithm.parameterAsCrs(parameters, name, context))
    if kind == "enum":
        value = algorithm.parameterAsEnumString(parameters, name, context)
        return "" if value == AUTOMATIC else str(value)
    if kind == "file":
        return absolute_file(algorithm, parameters, name, context)
    return str(algorithm.parameterAsString(parameters, name, context))


def _number_text(
    name: str, algorithm: QgsProcessingAlgorithm, parameters: dict[str, Any], context: QgsProcessingContext
) -> str:
    definition = algorithm.parameterDefinition(name)
    if all(each in (None, NULL) for each in (parameters.get(name), definition.defaultValue())):
        return ""
    if definition.dataType() == QgsProcessingParameterNumber.Type.Integer:
        return repr(algorithm.parameterAsInt(parameters, name, context))
    return repr(algorithm.parameterAsDouble(parameters, name, context))
