"""Tests of the plugin inside a Python that hosts QGIS: quick, and with a debugger's view of every part.

What the real programs of QGIS do with the plugin is tested beside this package.
"""
