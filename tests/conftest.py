"""What all tests share: how property tests run, seeded random numbers, and where the sample lies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

# The same examples on every machine: a failure in continuous integration can be repeated at a desk.
settings.register_profile(
    "repeatable",
    derandomize=True,
    deadline=None,
    max_examples=100,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("repeatable")


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers that are the same in every run."""
    return np.random.default_rng(20240611)


@pytest.fixture(scope="session")
def sample_folder() -> Path:
    """Folder of the sample that travels with the package."""
    return Path(__file__).parents[1] / "resources" / "sample"
