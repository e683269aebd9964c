"""What QGIS loads: it adds the provider to Processing, and takes it away again."""

from __future__ import annotations

from qgis.core import QgsApplication

from .provider import PolyMergeProvider


class PolyMergePlugin:
    """The plugin; everything it has to offer is in its Processing provider."""

    def __init__(self) -> None:
        self._provider: PolyMergeProvider | None = None

    def initProcessing(self) -> None:
        """Add the provider; all that ``qgis_process`` calls."""
        provider = PolyMergeProvider()
        if QgsApplication.processingRegistry().addProvider(provider):  # refused, and deleted, where it is there already
            self._provider = provider

    def initGui(self) -> None:
        """Add the provider when the desktop starts."""
        self.initProcessing()

    def unload(self) -> None:
        """Take the provider away when the plugin is switched off."""
        if self._provider is not None:
            QgsApplication.processingRegistry().removeProvider(self._provider)
            self._provider = None
