"""The Processing provider: its name, its algorithms, its setting, its layer styles."""

from __future__ import annotations

from processing.core.ProcessingConfig import ProcessingConfig, Setting
from qgis.core import QgsProcessingProvider
from qgis.PyQt import sip
from qgis.PyQt.QtGui import QIcon

from .algorithms.evaluate_map import EvaluateMap
from .algorithms.map_changes import MapChanges
from .algorithms.merge_local_maps import MergeLocalMaps
from .algorithms.merge_network import MergeNetwork
from .algorithms.project_local_maps import ProjectLocalMaps
from .algorithms.set_up import SetUp
from .algorithms.undo_update import UndoUpdate
from .algorithms.update_map import UpdateMap
from .environment import SETTING
from .layout import icon_path, metadata
from .styling import Style
from .translation import tr


class PolyMergeProvider(QgsProcessingProvider):
    """The provider ``polymerge``."""

    def __init__(self) -> None:
        super().__init__()
        self._styles: set[Style] = set()

    def id(self) -> str:
        """Return the id of the provider; it never changes."""
        return "polymerge"

    def name(self) -> str:
        """Return the name in the toolbox."""
        return "PolyMerge"

    def longName(self) -> str:
        """Return the name with the version."""
        return f"PolyMerge {metadata('version')}"

    def icon(self) -> QIcon:
        """Return the icon in the toolbox."""
        return QIcon(icon_path("polymerge"))

    def svgIconPath(self) -> str:
        """Return the icon for models."""
        return icon_path("polymerge")

    def load(self) -> bool:
        """Add the setting and the algorithms."""
        ProcessingConfig.settingIcons[self.name()] = self.icon()
        description = tr("Python that PolyMerge runs in (empty: the one that “Set up PolyMerge” makes)")
        ProcessingConfig.addSetting(Setting(self.name(), SETTING, description, "", valuetype=Setting.FILE))
        ProcessingConfig.readSettings()
        self.refreshAlgorithms()
        return True

    def unload(self) -> None:
        """Take the setting away."""
        ProcessingConfig.removeSetting(SETTING)

    def loadAlgorithms(self) -> None:
        """Add the algorithms."""
        algorithms = (
            SetUp,
            ProjectLocalMaps,
            MergeLocalMaps,
            MergeNetwork,
            EvaluateMap,
            UpdateMap,
            MapChanges,
            UndoUpdate,
        )
        for algorithm in algorithms:
            self.addAlgorithm(algorithm())

    def style(self, name: str, *, grows: bool = False) -> Style:
        """Return a layer style, as something that QGIS calls when it has loaded a layer."""
        # QGIS calls it when the algorithm is gone, and deletes it after the run; until then somebody has to keep it.
        # Runs in several threads ask at the same time, so that the set is changed in place.
        style = Style(name, grows=grows)
        self._styles.difference_update([each for each in tuple(self._styles) if sip.isdeleted(each)])
        self._styles.add(style)
        return style
