"""What `qgis --code` runs: it has the session begin when the desktop is ready."""

from __future__ import annotations

import session
from qgis.utils import iface

iface.initializationCompleted.connect(session.main)
