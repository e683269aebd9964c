"""Marks that say which merge method a test is about."""

from __future__ import annotations

import pytest

#: The contract, which every method keeps: the test runs once with each as the default.
every_method = pytest.mark.usefixtures("method")

#: How the one method does it: of a module or class that holds for every method, the exceptions.
published = pytest.mark.parametrize("method", ["polymerge"], indirect=True)
consensus = pytest.mark.parametrize("method", ["consensus"], indirect=True)
