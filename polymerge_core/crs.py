"""Coordinate reference systems: what the data has, where the work happens, what comes out.

Distances are metres, so the work happens in a CRS whose metre is a metre on the ground: the data's own
where it is projected, in metres and true to scale within 0.1 % over the data, else a transverse Mercator
centred on the data. Plain metric coordinates without a place on Earth are declared as `LOCAL_CRS`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from pyproj.crs import ProjectedCRS
from pyproj.crs.coordinate_operation import TransverseMercatorConversion
from pyproj.exceptions import CRSError as PyprojCrsError
from pyproj.exceptions import ProjError

from polymerge_core.errors import CrsError

#: A metric Cartesian system with no known place on Earth. GeoPackage stores it as srs_id -1.
LOCAL_CRS = pyproj.CRS.from_wkt(
    'ENGCRS["Undefined Cartesian SRS",EDATUM["Unknown engineering datum"],CS[Cartesian,2],'
    'AXIS["x",unspecified,ORDER[1],LENGTHUNIT["metre",1]],AXIS["y",unspecified,ORDER[2],LENGTHUNIT["metre",1]]]'
)

#: How far the scale of a map projection may be from 1 over the data before the work moves elsewhere.
SCALE_TOLERANCE = 1e-3

#: Data further than this outside the area for which a CRS is made was not measured in it.
AREA_OF_USE_MARGIN_DEG = 5.0

_LONLAT = pyproj.CRS.from_epsg(4326)

Bounds = tuple[float, float, float, float]


def parse_crs(crs: Any) -> pyproj.CRS:
    """Read a CRS in any form that pyproj takes, or the word ``local``.

    Parameters
    ----------
    crs : any
        ``"EPSG:32632"``, an integer EPSG code, WKT, a PROJ string, a `pyproj.CRS`, or ``"local"`` for plain
        metric coordinates.

    Returns
    -------
    pyproj.CRS
        `LOCAL_CRS` for ``"local"`` and for every engineering CRS.

    Raises
    ------
    CrsError
        If pyproj does not know it.
    """
    if isinstance(crs, str) and crs.strip().lower() == "local":
        return LOCAL_CRS
    try:
        parsed = pyproj.CRS.from_user_input(crs)
    except PyprojCrsError as error:
        raise CrsError(
            f"{crs!r} is not a coordinate reference system that PROJ knows; give one such as EPSG:32632, "
            "or local for plain metric coordinates"
        ) from error
    if is_local(parsed):
        return LOCAL_CRS
    # pyproj's own subclasses (ProjectedCRS and others) lack some methods of CRS.
    return parsed if type(parsed) is pyproj.CRS else pyproj.CRS.from_wkt(parsed.to_wkt())


def is_local(crs: pyproj.CRS | None) -> bool:
    """Whether a CRS has no place on Earth (an engineering CRS, such as `LOCAL_CRS`)."""
    return crs is not None and crs.is_engineering


def crs_name(crs: pyproj.CRS) -> str:
    """Return a short name for reports: ``local``, an authority code, or the CRS's own name."""
    if is_local(crs):
        return "local"
    authority = crs.to_authority()
    return crs.name if authority is None else ":".join(authority)


def is_metric(crs: pyproj.CRS) -> bool:
    """Whether both axes of a CRS are plane coordinates in metres."""
    if is_local(crs):
        return True
    axes = crs.to_2d().axis_info if crs.is_projected else []
    return len(axes) > 0 and all(np.isclose(axis.unit_conversion_factor, 1.0, rtol=1e-12) for axis in axes)


def working_crs(crs: pyproj.CRS, bounds: Bounds, *, centre_on: pyproj.CRS | None = None) -> pyproj.CRS:
    """Choose the CRS in which distances are measured.

    Parameters
    ----------
    crs : pyproj.CRS
        The main map's CRS, else the first input's.
    bounds : tuple of float
        ``(xmin, ymin, xmax, ymax)`` of all data, in `centre_on`.
    centre_on : pyproj.CRS, optional
        CRS of `bounds`, `crs` itself by default.

    Returns
    -------
    pyproj.CRS
        `crs` where it is in metres and true to scale within `SCALE_TOLERANCE` over the data, else a
        transverse Mercator on the same datum centred on the data.

    Raises
    ------
    CrsError
        If the coordinates cannot belong to the CRS.
    """
    if is_local(crs):
        return LOCAL_CRS
    lon, lat = _sample_lonlat(centre_on or crs, bounds)
    if is_metric(crs) and scale_error(crs, lon, lat) <= SCALE_TOLERANCE:
        return crs
    conversion = TransverseMercatorConversion(
        latitude_natural_origin=round((lat.min() + lat.max()) / 2, 4),
        longitude_natural_origin=round((lon.min() + lon.max()) / 2, 4),
    )
    geodetic = crs.geodetic_crs or _LONLAT
    return parse_crs(
        ProjectedCRS(conversion, name="Transverse Mercator centred on the data", geodetic_crs=geodetic.to_2d())
    )


def scale_error_over(crs: pyproj.CRS, bounds: Bounds, bounds_crs: pyproj.CRS) -> float:
    """Return the largest departure of a projection's scale from 1 over bounds that are given in another CRS."""
    return scale_error(crs, *_sample_lonlat(bounds_crs, bounds))


def scale_error(crs: pyproj.CRS, lon: NDArray[np.float64], lat: NDArray[np.float64]) -> float:
    """Return the largest departure of a projection's scale from 1 at points given in degrees.

    The scale is measured on the ellipsoid, along both axes: Web Mercator, which is computed on a sphere, is 0.7 % too
    long from south to north even on the equator.
    """
    step = 100.0
    try:
        forward = transformer(_LONLAT, crs)
        x, y = forward.transform(lon, lat)
        back = transformer(crs, crs.geodetic_crs or _LONLAT)
        here, east, north = (back.transform(x + dx, y + dy) for dx, dy in ((0, 0), (step, 0), (0, step)))
    except (ProjError, PyprojCrsError):
        return float("inf")
    geod = crs.get_geod() or pyproj.Geod(ellps="WGS84")
    ground = np.concatenate([geod.inv(*here, *there)[2] for there in (east, north)])
    with np.errstate(divide="ignore"):
        error = np.abs(step / ground - 1.0)
    return float(error.max()) if np.isfinite(error).all() else float("inf")


def check_coordinates(crs: pyproj.CRS, bounds: Bounds, where: str) -> None:
    """Refuse coordinates that cannot have been measured in the CRS they claim.

    Parameters
    ----------
    crs : pyproj.CRS
        The CRS that the layer claims.
    bounds : tuple of float
        ``(xmin, ymin, xmax, ymax)`` of the layer in that CRS.
    where : str
        The layer, for the message.

    Raises
    ------
    CrsError
        If the CRS has no plane coordinates, or they are outside its area of use by more than
        `AREA_OF_USE_MARGIN_DEG`, or in degrees and out of range, or on both sides of the antimeridian.
    """
    if is_local(crs):
        return
    hint = "check the CRS and the order of the axes (x is easting or longitude)"
    if not (crs.is_geographic or crs.is_projected):
        raise CrsError(
            f"{where}: {crs.name} ({crs.type_name}) has no longitude and latitude, or easting and northing, in which a "
            "map is drawn; reproject the layer"
        )
    if crs.is_geographic:
        xmin, ymin, xmax, ymax = bounds
        if ymin < -90 or ymax > 90 or xmin < -360 or xmax > 360:
            raise CrsError(
                f"{where}: coordinates from ({xmin:g}, {ymin:g}) to ({xmax:g}, {ymax:g}) are not degrees of "
                f"longitude and latitude, as {crs.name} needs; {hint}"
            )
        if xmax - xmin > 180:
            raise CrsError(
                f"{where}: the data spans {xmax - xmin:.0f} degrees of longitude; reproject data on both sides "
                "of the antimeridian to a projected CRS first"
            )
    lon, lat = _sample_lonlat(crs, bounds, where)
    area = crs.area_of_use
    if area is None or area.west > area.east:
        return
    xmin, ymin, xmax, ymax = bounds
    like_degrees = crs.is_projected and max(abs(xmin), abs(xmax)) <= 180 and max(abs(ymin), abs(ymax)) <= 90
    margin = 0.0 if like_degrees else AREA_OF_USE_MARGIN_DEG
    inside_lon = (lon.min() >= area.west - margin) & (lon.max() <= area.east + margin)
    inside_lat = (lat.min() >= area.south - margin) & (lat.max() <= area.north + margin)
    outside = not (inside_lon and inside_lat)
    if like_degrees and (outside or area.east - area.west > 180):
        raise CrsError(
            f"{where}: coordinates from ({xmin:g}, {ymin:g}) to ({xmax:g}, {ymax:g}) look like degrees, "
            f"and {crs.name} is not in degrees; {hint}"
        )
    if outside:
        raise CrsError(
            f"{where}: the coordinates lie near longitude {lon.mean():.2f}, latitude {lat.mean():.2f}, far from "
            f"where {crs.name} is used ({area.name.split('.')[0]}); {hint}"
        )


def transform_coordinates(
    coordinates: NDArray[np.float64], source: pyproj.CRS, target: pyproj.CRS, *, check: bool = True
) -> NDArray[np.float64]:
    """Carry plane coordinates from one CRS to another.

    Parameters
    ----------
    coordinates : ndarray of float, shape (n, 2)
        x and y (or longitude and latitude) in `source`.
    source, target : pyproj.CRS
        Both on Earth, or both local.
    check : bool, default True
        Whether a point that has no place in `target` is an error; otherwise it becomes infinite.

    Returns
    -------
    ndarray of float, shape (n, 2)
        x and y in `target`; the input itself where both are the same.

    Raises
    ------
    CrsError
        If one is local and the other is not, or a point has no place in `target`.
    """
    if source == target:
        return coordinates
    if is_local(source) or is_local(target):
        raise CrsError(
            "plain metric coordinates (crs=local) cannot be brought together with data that has a CRS; "
            "declare the CRS of every layer, or crs=local for all of them"
        )
    x, y = transformer(source, target).transform(coordinates[:, 0], coordinates[:, 1])
    moved = np.column_stack([x, y])
    if check and not np.isfinite(moved).all():
        raise CrsError(f"some coordinates in {source.name} have no place in {target.name}")
    return moved


@lru_cache(maxsize=32)
def transformer(source: pyproj.CRS, target: pyproj.CRS) -> pyproj.Transformer:
    """Return what brings x and y, easting or longitude first, from one CRS to another; kept, as a stream asks again."""
    return pyproj.Transformer.from_crs(source, target, always_xy=True)


def _sample_lonlat(
    crs: pyproj.CRS, bounds: Bounds, where: str = "the data"
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return longitude and latitude of a 5 x 5 grid over the bounds, in degrees."""
    xmin, ymin, xmax, ymax = bounds
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(xmin, xmax, 5), np.linspace(ymin, ymax, 5)))
    lon, lat = transformer(crs, _LONLAT).transform(x, y)
    if not (np.isfinite(lon).all() and np.isfinite(lat).all()):
        raise CrsError(
            f"{where}: coordinates from ({xmin:g}, {ymin:g}) to ({xmax:g}, {ymax:g}) have no place in {crs.name}; "
            "check the CRS and the order of the axes (x is easting or longitude)"
        )
    # Data that touches +-180 must not be averaged to longitude 0.
    lon = np.where(lon - lon[0] > 180, lon - 360, np.where(lon - lon[0] < -180, lon + 360, lon))
    return lon, lat
