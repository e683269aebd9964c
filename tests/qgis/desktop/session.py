"""The session in the desktop: what an analyst does, from the toolbox to a saved project, with pictures on the way."""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from driving import Record, describe, in_dialog, running, save_picture, settle, wait_until
from layers import write_many, write_tracks
from processing.core.ProcessingConfig import ProcessingConfig
from processing.gui.BatchAlgorithmDialog import BatchAlgorithmDialog
from qgis.core import (
    Qgis,
    QgsApplication,
    QgsCategorizedSymbolRenderer,
    QgsProcessingUtils,
    QgsProject,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QModelIndex, Qt, QTimer
from qgis.PyQt.QtGui import QColor
from qgis.PyQt.QtWidgets import (
    QDialog,
    QDockWidget,
    QProgressBar,
    QTableView,
    QTextBrowser,
    QTextEdit,
    QToolBar,
    QWidget,
)
from qgis.utils import iface, plugins

ORDERS = json.loads(os.environ["POLYMERGE_SESSION"])
DATA, PICTURES = Path(ORDERS["data"]), Path(ORDERS["pictures"])
RECORD = Record(Path(ORDERS["record"]))

ALGORITHMS = {
    "polymerge:evaluatemap": "Evaluate map",
    "polymerge:mapchanges": "Changes of a map",
    "polymerge:undoupdate": "Undo update of a map",
    "polymerge:mergelocalmaps": "Merge local maps",
    "polymerge:mergenetwork": "Merge network",
    "polymerge:projectlocalmaps": "Project local maps",
    "polymerge:setup": "Set up PolyMerge",
    "polymerge:updatemap": "Update map",
}
MERGE, NETWORK, PROJECT = "polymerge:mergelocalmaps", "polymerge:mergenetwork", "polymerge:projectlocalmaps"
EVALUATE = "polymerge:evaluatemap"

PYTHON_SETTING = "POLYMERGE_PYTHON"

#: Words in the command line of the worker.
WORKER = "polymerge_core"

CANCELLED = "Cancelled; nothing was written."

#: The colour of errors in the log of an algorithm's dialog.
RED = "#ff0000"

WINDOW = (1000, 680)
DIALOG = (860, 620)


def main() -> None:
    """Run the session and close QGIS."""
    sys.excepthook = lambda kind, failure, trace: RECORD.error(
        "".join(traceback.format_exception(kind, failure, trace))
    )
    QgsApplication.messageLog().messageReceived.connect(_note)
    for step in STEPS:
        begun = time.monotonic()
        try:
            step()
        except Exception as failure:  # noqa: BLE001 - the steps after it may well go, and say more
            RECORD.error(describe(failure))
        RECORD.step(step.__name__, time.monotonic() - begun)
    iface.newProject(False)
    QTimer.singleShot(0, iface.actionExit().trigger)


def _note(text: str, tag: str, level: Qgis.MessageLevel) -> None:
    if level == Qgis.MessageLevel.Critical and text != CANCELLED:
        RECORD.error(f"{tag}: {text}")


def show_toolbox() -> None:
    """The plugin is loaded, and the toolbox offers what it has."""
    lay_out_window("Layers", "ProcessingToolbox")
    RECORD.check("the plugin is loaded", "polymerge" in plugins, sorted(plugins))
    tree = toolbox().algorithmTree
    names = {index: tree.algorithmForIndex(index) for index in _indexes()}
    own = {index: each for index, each in names.items() if each is not None and each.provider().id() == "polymerge"}
    found = {each.id(): each.displayName() for each in own.values()}
    RECORD.check("the toolbox has all algorithms", found == ALGORITHMS, found)
    tree.collapseAll()
    for index in own:
        tree.expand(index.parent())
        tree.expand(index.parent().parent())
    tree.scrollToBottom()
    picture("qgis_toolbox", toolbox())
    for words, wanted in (("conflation", MERGE), ("gps track", MERGE), ("pip", "polymerge:setup")):
        toolbox().searchBox.setText(words)
        found = [each.id() for index in _indexes() if (each := tree.algorithmForIndex(index)) is not None]
        RECORD.check(f"a search for {words} finds {wanted}", wanted in found, found)
    toolbox().searchBox.setText("")
    lay_out_window("Layers")


def lay_out_window(*shown: str) -> None:
    """Show these docks, what is needed beside them, and no more."""
    window = iface.mainWindow()
    window.statusBar().hide()
    for dock in window.findChildren(QDockWidget):
        dock.setVisible(dock.objectName() in shown)
    for bar in window.findChildren(QToolBar, options=Qt.FindChildOption.FindDirectChildrenOnly):
        bar.setVisible(bar.objectName() in {"mFileToolBar", "mMapNavToolBar"})
    docks = [window.findChild(QDockWidget, name) for name in shown]
    window.setGeometry(0, 0, *WINDOW)
    window.resizeDocks(docks, [260, 320][: len(docks)], Qt.Orientation.Horizontal)
    settle()


def say_without_environment() -> None:
    """Without a Python for the worker the toolbox says what to do, and opens no dialog."""
    python = ProcessingConfig.getSetting(PYTHON_SETTING)
    RECORD.check("the setting names the worker's Python", python == ORDERS["python"], python)
    ProcessingConfig.setSettingValue(PYTHON_SETTING, "")

    def look(dialog: QDialog) -> None:
        text = dialog.findChild(QTextBrowser).toPlainText()
        right = "run “Set up PolyMerge” in the Processing toolbox" in text and not hasattr(dialog, "runAlgorithm")
        RECORD.check("without an environment a dialog says what to do", right, text)

    in_dialog(lambda: open_algorithm(MERGE), look)
    ProcessingConfig.setSettingValue(PYTHON_SETTING, python)


def sample(file: str) -> Path:
    """Return a file of the sample that the plugin brings."""
    return Path(sys.modules["polymerge"].__file__).parent / "resources" / "sample" / file


def project_sample() -> None:
    """Predictions and poses become a styled layer."""
    values = {
        "PREDICTIONS": str(sample("predictions.json")),
        "POSES": str(sample("poses.csv")),
        "CRS": "EPSG:32632",
    }
    in_dialog(lambda: open_algorithm(PROJECT), lambda dialog: run(dialog, values))
    check_classes("Local maps", layer("Local maps"))
    RECORD.check("footprints are loaded beside the local maps", bool(layer("Footprints").featureCount()))
    show_only("Local maps", "Footprints")
    zoom(layer("Local maps"))
    picture("qgis_local_maps", iface.mainWindow())


def merge_sample() -> None:
    """The local maps become one map, from the dialog."""
    values = {"LOCAL_MAPS": [layer("Local maps").id()], "INSTANCES": layer("Footprints").id()}

    def use(dialog: QDialog) -> None:
        dialog.resize(*DIALOG)
        dialog.setParameters(values)
        picture("qgis_dialog", dialog)
        results = run(dialog, values)
        counts = [results.get(name) for name in ("N_ELEMENTS", "N_OBSERVATIONS", "N_LEFT_OUT")]
        RECORD.check("the numbers of a merge are results", None not in counts and counts[0] > 0, counts)
        RECORD.check("the log has no error", RED not in log(dialog).toHtml(), log(dialog).toPlainText())

    in_dialog(lambda: open_algorithm(MERGE), use)
    names = sorted(each.name() for each in QgsProject.instance().mapLayers().values())
    RECORD.check(
        "results bear their names, and empty ones are not loaded",
        names == ["Footprints", "Left out", "Lineage", "Local maps", "Merged map"],
        names,
    )
    merged = layer("Merged map")
    check_classes("Merged map", merged)
    check_table("Merged map", merged)
    layer("Local maps").setOpacity(0.5)
    show_only("Merged map", "Local maps")
    zoom(merged)
    picture("qgis_merged", iface.mainWindow())


def look_at_table() -> None:
    """The attribute table of the merged map can be read."""
    dialog = iface.showAttributeTable(layer("Merged map"))
    window = dialog.window()
    window.resize(680, 420)
    wait_until(lambda: dialog.findChild(QTableView).model().rowCount(), "rows in the attribute table")
    headings = dialog.findChild(QTableView).model()
    shown = [headings.headerData(n, Qt.Orientation.Horizontal) for n in range(headings.columnCount())]
    RECORD.check("the attribute table begins with the element", shown[0] == "Element", shown)
    picture("qgis_attribute_table", window)
    window.close()


def evaluate_map() -> None:
    """The error along the merged map, in colour."""
    reference = iface.addVectorLayer(f"{sample('reference.gpkg')}|layername=ground_truth", "Reference", "ogr")
    reference.renderer().symbol().setColor(QColor("#8a8a8a"))
    values = {
        "MERGED": [layer("Merged map").id()],
        "REFERENCE": [reference.id()],
        "LOCAL_MAPS": [layer("Local maps").id()],
    }
    in_dialog(lambda: open_algorithm(EVALUATE), lambda dialog: run(dialog, values))
    errors = layer("Errors along the map")
    check_columns("Errors along the map", errors)
    show_only("Errors along the map", "Reference")
    zoom(errors)
    picture("qgis_errors", iface.mainWindow())
    known = {"Footprints", "Left out", "Lineage", "Local maps", "Merged map"}
    project = QgsProject.instance()
    project.removeMapLayers([each.id() for each in project.mapLayers().values() if each.name() not in known])


def merge_network() -> None:
    """The network behind the merge."""
    in_dialog(lambda: open_algorithm(NETWORK), lambda dialog: run(dialog, {"LOCAL_MAPS": [layer("Local maps").id()]}))
    for name in ("Network: observations", "Network: edges"):
        check_columns(name, layer(name))
    symbol = layer("Network: observations").renderer().symbol().symbolLayer(0)
    RECORD.check("each component has a colour", symbol.dataDefinedProperties().hasActiveProperties())
    show_only("Network: observations", "Network: edges")
    zoom(layer("Network: observations"))
    picture("qgis_network", iface.mainWindow())


def merge_in_batch() -> None:
    """Two rows of the batch dialog, both to the end, into files."""
    files = {DATA / "near.gpkg": 0.5, DATA / "far.gpkg": 2.0}
    dialog = BatchAlgorithmDialog(QgsApplication.processingRegistry().createAlgorithmById(MERGE), iface.mainWindow())
    panel = dialog.mainWidget()
    panel.addRow()
    for row, (file, proximity) in enumerate(files.items()):
        for name, value in (("LOCAL_MAPS", [layer("Local maps").id()]), ("PROXIMITY", proximity)):
            panel.wrappers[row][panel.parameter_to_column[name]].setParameterValue(value, panel.processing_context)
        panel.tblParameters.cellWidget(row + 1, panel.parameter_to_column["OUTPUT"]).setValue(str(file))
    panel.checkLoadLayersOnCompletion.setChecked(True)
    dialog.show()
    dialog.runButton().click()  # comes back when all is done
    text = log(dialog).toPlainText()
    RECORD.check("a batch runs to its end", "Batch execution completed" in text and "failed" not in text, text)
    dialog.close()
    counts = {file.name: QgsVectorLayer(str(file), "").featureCount() for file in files}
    RECORD.check("a batch of two makes both maps", counts["near.gpkg"] > counts["far.gpkg"] > 0, counts)
    RECORD.check("the layers of a batch are loaded", all(loaded_from(file) for file in files))


def cancel() -> None:
    """Cancel ends the worker within a second, leaves nothing, and the dialog can be used again."""
    write_many(DATA / "many.gpkg")
    many = QgsVectorLayer(str(DATA / "many.gpkg"), "many", "ogr")
    QgsProject.instance().addMapLayer(many)
    output = DATA / "cancelled.gpkg"

    def use(dialog: QDialog) -> None:
        dialog.setParameters({"LOCAL_MAPS": [many.id()], "OUTPUT": str(output)})
        dialog.runButton().click()
        bar = dialog.findChild(QProgressBar)
        wait_until(lambda: bar.value() > 12 and running(WORKER), "a worker that merges", 90)
        begun = time.monotonic()
        dialog.cancelButton().click()
        wait_until(lambda: not running(WORKER), "the worker's end")
        took = time.monotonic() - begun
        RECORD.check("cancel ends the worker within a second", took < 1, took)
        wait_until(dialog.runButton().isEnabled, "a dialog that can be used again")
        text = log(dialog).toPlainText()
        told = CANCELLED in text and RED in log(dialog).toHtml()
        RECORD.check("the log says that nothing was written", told, text)
        left = [path.name for path in Path(QgsProcessingUtils.tempFolder()).glob("polymerge_*")]
        RECORD.check("a cancelled run leaves no file", not output.exists() and not left, left)
        run(dialog, {"LOCAL_MAPS": [layer("Local maps").id()], "OUTPUT": "TEMPORARY_OUTPUT"})

    in_dialog(lambda: open_algorithm(MERGE), use)
    QgsProject.instance().removeMapLayer(many)


def open_again() -> None:
    """A saved project comes back with its layers as they were."""
    project = QgsProject.instance()
    in_files = [each.id() for each in project.mapLayers().values() if each.dataProvider().name() == "ogr"]
    project.removeMapLayers([each for each in project.mapLayers() if each not in in_files])
    RECORD.check("the project is saved", project.write(str(DATA / "town.qgz")), project.error())
    iface.newProject(False)
    RECORD.check("a new project is empty", not project.mapLayers())
    RECORD.check("the project is opened", bool(iface.addProject(str(DATA / "town.qgz"))))
    for name in ("near.gpkg", "far.gpkg"):
        again = loaded_from(DATA / name)
        RECORD.check(f"{name} is there again", again is not None and again.isValid())
        if again is not None:
            check_classes(name, again)
            check_table(name, again)
    iface.newProject(False)


def merge_tracks() -> None:
    """Ten GPS tracks with an id and nothing else become one line."""
    write_tracks(DATA / "tracks.shp")
    tracks = iface.addVectorLayer(str(DATA / "tracks.shp"), "tracks", "ogr")
    RECORD.check("there are ten tracks", tracks.featureCount() == 10, tracks.featureCount())
    tracks.renderer().symbol().setColor(QColor("#e07b39"))
    values = {"LOCAL_MAPS": [tracks.id()], "PROXIMITY": 15}
    in_dialog(lambda: open_algorithm(MERGE), lambda dialog: run(dialog, values))
    merged = layer("Merged map")
    RECORD.check("ten tracks become one line", merged.featureCount() == 1, merged.featureCount())
    crs = merged.crs().authid()
    RECORD.check("the line is in the CRS of the tracks", crs == "EPSG:4326", crs)
    lay_out_window("Layers")
    show_only("Merged map", "tracks")
    zoom(tracks)
    picture("qgis_tracks", iface.mainWindow())


def toolbox() -> Any:
    """Return the toolbox."""
    return plugins["processing"].toolbox


def _indexes(parent: QModelIndex | None = None) -> Iterator[QModelIndex]:
    """Give every place of the toolbox's tree that has nothing below it."""
    model, parent = toolbox().algorithmTree.model(), parent or QModelIndex()
    for row in range(model.rowCount(parent)):
        index = model.index(row, 0, parent)
        if model.rowCount(index):
            yield from _indexes(index)
        else:
            yield index


def open_algorithm(wanted: str) -> None:
    """Open an algorithm as a double click in the toolbox does."""
    tree = toolbox().algorithmTree
    for index in _indexes():
        algorithm = tree.algorithmForIndex(index)
        if algorithm is not None and algorithm.id() == wanted:
            tree.setCurrentIndex(index)
            toolbox().executeAlgorithm()
            return
    raise LookupError(f"{wanted} is not in the toolbox")


def run(dialog: QDialog, values: dict[str, Any]) -> dict[str, Any]:
    """Press Run in an algorithm's dialog and wait for the end; return what came out."""
    ended: list[tuple[bool, dict[str, Any]]] = []
    dialog.algorithmFinished.connect(lambda well, results: ended.append((well, results)))
    dialog.setParameters(values)
    dialog.runButton().click()
    wait_until(lambda: ended, f"the end of {dialog.windowTitle()}")
    settle()
    well, results = ended[-1]
    RECORD.check(f"{dialog.windowTitle()} ran to the end", well, "" if well else log(dialog).toPlainText())
    return results


def log(dialog: QDialog) -> QTextEdit:
    """Return the log of an algorithm's dialog."""
    return dialog.findChild(QTextEdit, "txtLog")


def layer(name: str) -> QgsVectorLayer:
    """Return the layer of a name that was loaded last."""
    found = [each for each in QgsProject.instance().layerTreeRoot().layerOrder() if each.name() == name]
    if not found:
        raise LookupError(f"no layer {name} is loaded")
    return found[0]


def loaded_from(file: Path) -> QgsVectorLayer | None:
    """Return the layer of a file."""
    layers = QgsProject.instance().mapLayers().values()
    return next((each for each in layers if each.source().split("|")[0] == str(file)), None)


def check_classes(name: str, found: QgsVectorLayer) -> None:
    """Check that a layer is drawn by class."""
    renderer = found.renderer()
    by_class = isinstance(renderer, QgsCategorizedSymbolRenderer) and renderer.classAttribute() == "class"
    RECORD.check(f"{name} is drawn by class", by_class, renderer.type())
    shown = sorted(each.label() for each in renderer.categories()) if by_class else []
    RECORD.check(f"the legend of {name} has its classes", set(shown) >= {"Boundary", "Divider"}, shown)


def check_table(name: str, found: QgsVectorLayer) -> None:
    """Check that the columns of a merged map have readable names and a sensible order."""
    check_columns(name, found)
    columns = [each.name for each in found.attributeTableConfig().columns() if not each.hidden]
    RECORD.check(f"element_id comes first in the table of {name}", columns[0] == "element_id", columns)


def check_columns(name: str, found: QgsVectorLayer) -> None:
    """Check that a layer's columns have readable names."""
    titles = [found.attributeDisplayName(n) for n in range(found.fields().count())]
    own = [each for each in titles if each != "fid"]  # a GeoPackage's own key
    readable = not any("_" in each or each[0].islower() for each in own)
    RECORD.check(f"the columns of {name} have readable names", readable, titles)


def show_only(*names: str) -> None:
    """Hide all layers but some."""
    for node in QgsProject.instance().layerTreeRoot().findLayers():
        node.setItemVisibilityChecked(node.name() in names)
        node.setExpanded(False)  # a node that is expanded in the tree and not in the panel would stay as it is
        node.setExpanded(node.name() in names)


def zoom(to: QgsVectorLayer) -> None:
    """Show a layer on the map, and wait until it is drawn."""
    canvas, drawn = iface.mapCanvas(), []
    canvas.mapCanvasRefreshed.connect(lambda: drawn.append(True))
    iface.setActiveLayer(to)
    iface.zoomToActiveLayer()
    canvas.refresh()
    wait_until(lambda: drawn and not canvas.isDrawing(), "the map")


def picture(name: str, widget: QWidget) -> None:
    """Take a picture for the documentation."""
    settle()
    iface.messageBar().clearWidgets()  # where the desktop is slow it says that a run is over
    save_picture(widget, PICTURES / f"{name}.png")
    RECORD.picture(name)


STEPS: tuple[Callable[[], None], ...] = (
    show_toolbox,
    say_without_environment,
    project_sample,
    merge_sample,
    look_at_table,
    evaluate_map,
    merge_network,
    merge_in_batch,
    cancel,
    open_again,
    merge_tracks,
)
