"""The merge method, for tests of what holds whatever the method."""

from __future__ import annotations

import pytest

from polymerge_core import merge
from polymerge_core.options import METHODS


@pytest.fixture(params=METHODS)
def method(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Make each method the default in turn; `tests.core.methods` has the marks."""
    monkeypatch.setitem(merge.__kwdefaults__, "method", request.param)
    return str(request.param)
