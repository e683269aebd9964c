"""Texts in the user's language."""

from __future__ import annotations

from qgis.PyQt.QtCore import QCoreApplication


def mark(text: str) -> str:
    """Mark a text that is written where nothing can be translated yet; `tr` translates it where it is shown."""
    return text


def tr(text: str) -> str:
    """Return a text in the user's language, or as it is where nobody translated it."""
    return QCoreApplication.translate("PolyMerge", text)
