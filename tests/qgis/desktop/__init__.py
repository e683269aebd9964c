"""The plugin in the desktop of QGIS, driven on a screen that nobody sees."""
