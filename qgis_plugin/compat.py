"""What is spelled differently in QGIS 3.22 with Qt 5 and in QGIS 4 with Qt 6; nothing else may know of it."""

from __future__ import annotations

from qgis.core import Qgis
from qgis.PyQt.QtCore import QMetaType, QVariant

if Qgis.QGIS_VERSION_INT >= 33800:  # since then QgsField takes a QMetaType.Type, before only a QVariant.Type
    _KINDS = QMetaType.Type
    TEXT, DATE, DATE_AND_TIME, BINARY = _KINDS.QString, _KINDS.QDate, _KINDS.QDateTime, _KINDS.QByteArray
else:
    _KINDS = QVariant
    TEXT, DATE, DATE_AND_TIME, BINARY = _KINDS.String, _KINDS.Date, _KINDS.DateTime, _KINDS.ByteArray

INTEGER = _KINDS.LongLong

#: Types of attributes that a GeoPackage holds as they are.
PLAIN_TYPES = frozenset((TEXT, DATE, DATE_AND_TIME, BINARY, INTEGER, _KINDS.Int, _KINDS.Double, _KINDS.Bool))
