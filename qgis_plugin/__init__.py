"""The QGIS plugin: a Processing provider whose work is done by the PolyMerge command line in a process of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from qgis.gui import QgisInterface

    from .plugin import PolyMergePlugin


def classFactory(iface: QgisInterface | None) -> PolyMergePlugin:
    """Return the plugin; QGIS calls this when it loads it, with the desktop, or with None in ``qgis_process``."""
    del iface  # there are no menus and toolbars
    from .plugin import PolyMergePlugin  # noqa: PLC0415 - the package is importable without QGIS, for packaging

    return PolyMergePlugin()
