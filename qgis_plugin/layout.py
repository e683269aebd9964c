"""Where the parts of the plugin lie; the same in a checkout and in an installed plugin."""

from __future__ import annotations

import configparser
from pathlib import Path

#: The folder that holds `metadata.txt`, `polymerge_core` and `resources`.
ROOT = Path(__file__).resolve().parent.parent

#: What the worker's Python needs, one requirement a line.
REQUIREMENTS = ROOT / "qgis_plugin" / "requirements.txt"


def icon_path(name: str) -> str:
    """Return the path of an icon."""
    return str(ROOT / "resources" / "icons" / f"{name}.svg")


def style_path(name: str) -> str:
    """Return the path of a layer style."""
    return str(ROOT / "resources" / "styles" / f"{name}.qml")


def metadata(field: str) -> str:
    """Return a field of the plugin's metadata."""
    parser = configparser.ConfigParser(interpolation=None)
    parser.read(ROOT / "metadata.txt", encoding="utf-8")
    return parser["general"][field]
