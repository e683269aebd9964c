"""The plugin in the desktop of QGIS: from the toolbox to a saved project, in one session.

What is checked stands in `session.py`, where it happens; here the session is started and its record is read.
"""

from __future__ import annotations

import os

import pytest

from tests.qgis.desktop import desktop

LARGEST_PICTURE = 200_000


# One test, because a second one might run in another process of pytest-xdist, and start the desktop again.
def test_an_analyst_s_session_in_the_desktop(tmp_path):
    missing = desktop.missing()
    if missing:
        reason = f"{missing} not installed"
        pytest.fail(reason) if os.environ.get("POLYMERGE_QGIS") == "required" else pytest.skip(reason)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    folder = tmp_path / "session"
    folder.mkdir()
    ended = desktop.run_session(folder, pictures)
    faults = ended.faults()
    assert not faults, "\n".join(faults)
    sizes = {path.stem: path.stat().st_size for path in pictures.glob("*.png")}
    assert sorted(sizes) == sorted(ended.record["pictures"])
    assert "qgis_tracks" in sizes
    assert max(sizes.values()) < LARGEST_PICTURE
