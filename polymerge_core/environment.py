"""What PolyMerge runs on: versions of the libraries and of GEOS, PROJ and GDAL inside them."""

from __future__ import annotations

from importlib.metadata import version

import pyogrio
import pyproj
import shapely

_PACKAGES = (
    "shapely",
    "pyproj",
    "geopandas",
    "pandas",
    "numpy",
    "scipy",
    "networkx",
    "scikit-image",
    "pyogrio",
    "pyarrow",
    "matplotlib",
    "click",
    "jinja2",
    "similaritymeasures",
)


def library_versions() -> dict[str, str]:
    """Return the version of each library by its name.

    Returns
    -------
    dict of str to str
        Python packages first, then GEOS, PROJ and GDAL as the packages carry them.
    """
    found = {name: version(name) for name in _PACKAGES}
    return found | {
        "GEOS": shapely.geos_version_string,
        "PROJ": pyproj.proj_version_str,
        "GDAL": pyogrio.__gdal_version_string__,
    }
