"""Where the work happens: metres that are metres on the ground, wherever the data lies and whatever its units."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pyproj
import pytest
import shapely
from shapely import LineString

from polymerge_core import CrsError, merge
from polymerge_core.crs import (
    LOCAL_CRS,
    check_coordinates,
    crs_name,
    is_local,
    is_metric,
    parse_crs,
    transform_coordinates,
    working_crs,
)

#: Longitude and latitude of places on Earth.
PLACES = {
    "Munich": (11.58, 48.14),
    "Paris": (2.35, 48.86),
    "Ajaccio": (8.74, 41.93),
    "Tromso": (18.96, 69.65),
    "New York": (-73.97, 40.78),
    "Quito": (-78.47, -0.18),
    "Ushuaia": (-68.30, -54.80),
    "Taveuni": (179.99, -16.85),
}


def two_looks(place, apart_m, crs, *, azimuth=50.0):
    """Draw two parallel lines of 30 m, truly that far apart, at a place on Earth."""
    geod = pyproj.Geod(ellps="WGS84")
    lon, lat = PLACES[place]
    lines = []
    for offset in (0.0, apart_m):
        start = geod.fwd(lon, lat, azimuth + 90, offset)[:2]
        end = geod.fwd(*start, azimuth, 30.0)[:2]
        lines.append(LineString([start, end]))
    return gpd.GeoDataFrame(geometry=lines, crs="EPSG:4326").to_crs(crs)


def ground_length(line, crs):
    (line,) = gpd.GeoSeries([line], crs=crs).to_crs(4326)
    return pyproj.Geod(ellps="WGS84").geometry_length(line)


EVERYWHERE = [
    pytest.param("Munich", "EPSG:32632", id="UTM in its zone"),
    pytest.param("Paris", "EPSG:32630", id="UTM in the next zone, 0.15 % off"),
    pytest.param("Munich", "EPSG:4326", id="degrees"),
    pytest.param("Paris", "EPSG:2154", id="Lambert 93 in Paris"),
    pytest.param("Ajaccio", "EPSG:2154", id="Lambert 93 in Corsica, 0.2 % off"),
    pytest.param("Tromso", "EPSG:3857", id="Web Mercator at 70 degrees, 190 % off"),
    pytest.param("New York", "EPSG:2263", id="US survey feet"),
    pytest.param("Ushuaia", "EPSG:4326", id="degrees in the south"),
    pytest.param("Taveuni", "EPSG:4326", id="degrees beside the antimeridian"),
]


class TestDistancesAreGroundDistances:
    @pytest.mark.parametrize(("place", "crs"), EVERYWHERE)
    def test_just_under_the_proximity_is_near(self, place, crs):
        assert len(merge(two_looks(place, 0.998, crs)).elements) == 1

    @pytest.mark.parametrize(("place", "crs"), EVERYWHERE)
    def test_just_over_the_proximity_is_not(self, place, crs):
        assert len(merge(two_looks(place, 1.002, crs)).elements) == 2

    @pytest.mark.parametrize(("place", "crs"), EVERYWHERE)
    def test_lengths_are_on_the_ground_and_the_result_in_the_crs_of_the_data(self, place, crs):
        result = merge(two_looks(place, 0.5, crs))
        assert result.elements.crs == crs
        (element,) = result.elements.geometry
        assert result.elements["length_m"].iloc[0] == pytest.approx(ground_length(element, crs), rel=1e-3)
        assert result.lineage["to_m"].tolist() == pytest.approx([30.0, 30.0], rel=1e-3)

    @pytest.mark.parametrize(("place", "crs"), EVERYWHERE)
    def test_result_lies_where_the_data_lies(self, place, crs):
        looks = two_looks(place, 0.5, crs)
        result = merge(looks).elements
        ours, theirs = (layer.to_crs(4326).geometry.union_all() for layer in (result, looks))
        assert shapely.hausdorff_distance(ours, theirs) < 2e-5

    def test_in_web_mercator_at_the_equator(self):
        # On the ellipsoid, Web Mercator is 0.7 % too long from south to north even there.
        result = merge(two_looks("Quito", 0.998, "EPSG:3857"))
        assert result.report["working_crs"] == "Transverse Mercator centred on the data"
        assert len(result.elements) == 1
        assert result.lineage["to_m"].tolist() == pytest.approx([30.0, 30.0], rel=1e-3)

    def test_layers_in_degrees_feet_and_metres_are_one(self):
        crss = ["EPSG:4326", "EPSG:2263", "EPSG:32618", "EPSG:3857"]
        layers = [two_looks("New York", 0.4, crs).iloc[[k % 2]] for k, crs in enumerate(crss)]
        result = merge(layers)
        assert len(result.elements) == 1
        assert result.elements.crs == "EPSG:4326"


class TestWorkingCrs:
    @pytest.mark.parametrize(
        ("place", "crs"),
        [
            pytest.param("Munich", "EPSG:32632", id="UTM"),
            pytest.param("Paris", "EPSG:2154", id="Lambert 93"),
        ],
    )
    def test_is_the_datas_own_where_it_is_true_to_scale(self, place, crs):
        bounds = tuple(two_looks(place, 5, crs).total_bounds)
        assert working_crs(pyproj.CRS(crs), bounds) == pyproj.CRS(crs)

    @pytest.mark.parametrize(
        ("place", "crs"),
        [
            ("Munich", "EPSG:4326"),
            ("Paris", "EPSG:32630"),
            ("Ajaccio", "EPSG:2154"),
            ("Tromso", "EPSG:3857"),
            ("New York", "EPSG:2263"),
            ("Taveuni", "EPSG:4326"),
        ],
    )
    def test_is_a_transverse_mercator_centred_on_the_data_elsewhere(self, place, crs):
        bounds = tuple(two_looks(place, 5, crs).total_bounds)
        chosen = pyproj.CRS(working_crs(pyproj.CRS(crs), bounds).to_wkt())
        assert chosen.name == "Transverse Mercator centred on the data"
        assert is_metric(chosen)
        centre = {p.name: p.value for p in chosen.coordinate_operation.params}
        lon, lat = PLACES[place]
        assert centre["Longitude of natural origin"] == pytest.approx(lon, abs=0.01)
        assert centre["Latitude of natural origin"] == pytest.approx(lat, abs=0.01)
        assert chosen.geodetic_crs.datum == pyproj.CRS(crs).geodetic_crs.datum

    def test_is_that_of_the_main_map_first(self):
        looks, main = two_looks("Munich", 0.5, "EPSG:4326"), two_looks("Munich", 0.5, "EPSG:25832")
        assert merge(looks, main).report["working_crs"] == "EPSG:25832"

    def test_is_that_of_the_first_layer_without_a_main_map(self):
        utm, degrees = two_looks("Munich", 0.5, "EPSG:32632"), two_looks("Munich", 0.5, "EPSG:4326")
        assert merge([utm, degrees]).report["working_crs"] == "EPSG:32632"
        assert merge([degrees, utm]).report["working_crs"] == "Transverse Mercator centred on the data"

    def test_goes_by_all_the_data(self):
        # Lambert 93 is true to 0.1 % in Paris, not in Corsica.
        paris, corsica = two_looks("Paris", 0.5, "EPSG:2154"), two_looks("Ajaccio", 0.5, "EPSG:2154")
        assert merge(paris).report["working_crs"] == "EPSG:2154"
        assert merge([paris, corsica]).report["working_crs"] != "EPSG:2154"

    def test_of_plain_coordinates_is_plain(self):
        assert working_crs(LOCAL_CRS, (0, 0, 1, 1)) == LOCAL_CRS


class TestParseCrs:
    @pytest.mark.parametrize("given", ["local", "LOCAL", " Local ", LOCAL_CRS, LOCAL_CRS.to_wkt()])
    def test_knows_plain_coordinates(self, given):
        assert parse_crs(given) == LOCAL_CRS
        assert is_local(parse_crs(given))

    @pytest.mark.parametrize("given", ["EPSG:32632", 32632, pyproj.CRS(32632), pyproj.CRS(32632).to_wkt()])
    def test_knows_what_pyproj_knows(self, given):
        assert parse_crs(given) == pyproj.CRS(32632)

    @pytest.mark.parametrize("given", ["EPSG:999999", "metres", "", {"a": 1}])
    def test_refuses_what_it_does_not_know_and_says_what_would_do(self, given):
        with pytest.raises(CrsError, match="give one such as EPSG:32632"):
            parse_crs(given)

    @pytest.mark.parametrize("option", ["crs", "out_crs"])
    def test_is_asked_for_both_options(self, option):
        layer = gpd.GeoDataFrame(geometry=[LineString([(5e5, 5.3e6), (5e5 + 9, 5.3e6)])])
        layer = layer if option == "crs" else layer.set_crs("EPSG:32632")
        with pytest.raises(CrsError, match="'EPSG:999999' is not a coordinate reference system"):
            merge(layer, **{option: "EPSG:999999"})


def test_names():
    assert crs_name(LOCAL_CRS) == "local"
    assert crs_name(pyproj.CRS(32632)) == "EPSG:32632"
    assert crs_name(pyproj.CRS("+proj=tmerc +lon_0=11 +ellps=GRS80")) == "unknown"


@pytest.mark.parametrize(
    ("crs", "metric"),
    [("local", True), ("EPSG:32632", True), ("EPSG:4326", False), ("EPSG:2263", False), ("EPSG:4978", False)],
)
def test_metres(crs, metric):
    assert is_metric(parse_crs(crs)) is metric


class TestMissingCrs:
    LAYER = gpd.GeoDataFrame(geometry=[LineString([(5e5, 5.3e6), (5e5 + 9, 5.3e6)])])

    def test_is_an_error_that_names_the_two_ways_out(self):
        with pytest.raises(CrsError, match=r"layer 'local_maps'.*such as EPSG:32632.*crs=local"):
            merge(self.LAYER)

    def test_can_be_declared(self):
        assert merge(self.LAYER, crs=32632).elements.crs == "EPSG:32632"

    def test_declared_does_not_touch_layers_that_have_one(self):
        other = self.LAYER.set_crs(25832)
        assert merge([other, self.LAYER], crs=32632).elements.crs == "EPSG:25832"

    def test_of_an_empty_layer_beside_others_is_no_error(self):
        assert len(merge([self.LAYER.set_crs(32632), self.LAYER.iloc[:0]]).elements) == 1

    def test_plain_coordinates_cannot_be_mixed_with_others(self):
        with pytest.raises(CrsError, match="cannot be brought together"):
            merge([self.LAYER, self.LAYER.set_crs(32632)], crs="local")

    @pytest.mark.parametrize(("crs", "out_crs"), [("local", "EPSG:32632"), ("EPSG:32632", "local")])
    def test_plain_coordinates_have_no_place_on_earth(self, crs, out_crs):
        with pytest.raises(CrsError, match="out_crs cannot be used"):
            merge(self.LAYER, crs=crs, out_crs=out_crs)


class TestCoordinatesThatDoNotFit:
    @pytest.mark.parametrize(
        ("crs", "points", "message"),
        [
            pytest.param("EPSG:4326", [(5e5, 5.3e6), (5e5 + 9, 5.3e6)], "not degrees", id="metres as degrees"),
            pytest.param("EPSG:4326", [(48.1, 111.5), (48.1, 111.6)], "not degrees", id="latitude 111"),
            pytest.param("EPSG:32632", [(11.58, 48.14), (11.59, 48.14)], "look like degrees", id="degrees as metres"),
            pytest.param("EPSG:3857", [(11.58, 48.14), (11.59, 48.14)], "look like degrees", id="degrees in 3857"),
            pytest.param("EPSG:2154", [(6.8e6, 6.5e5), (6.8e6, 6.6e5)], "axes|axis|far from", id="swapped axes"),
            pytest.param("EPSG:4326", [(-179.9, 0), (179.9, 0)], "antimeridian", id="both sides of the antimeridian"),
        ],
    )
    def test_are_refused_by_name(self, crs, points, message):
        layer = gpd.GeoDataFrame(geometry=[LineString(points)], crs=crs)
        with pytest.raises(CrsError, match=message) as caught:
            merge(layer)
        assert "layer 'local_maps'" in str(caught.value)

    @pytest.mark.parametrize(("place", "crs"), EVERYWHERE)
    def test_that_fit_are_not_refused(self, place, crs):
        check_coordinates(pyproj.CRS(crs), tuple(two_looks(place, 5, crs).total_bounds), "here")

    def test_near_the_origin_of_plain_coordinates_are_not_refused(self):
        check_coordinates(LOCAL_CRS, (-1e9, -1e9, 1e9, 1e9), "here")


class TestTransformCoordinates:
    def test_takes_x_first_whatever_the_axis_order(self):
        moved = transform_coordinates(np.array([[11.58, 48.14]]), pyproj.CRS(4326), pyproj.CRS(32632))
        assert moved.tolist()[0] == pytest.approx([691_900, 5_334_800], abs=1000)

    def test_to_the_same_crs_changes_nothing(self):
        given = np.array([[1.1, 2.2]])
        assert transform_coordinates(given, LOCAL_CRS, LOCAL_CRS) is given

    def test_refuses_points_without_a_place_there(self):
        with pytest.raises(CrsError, match="have no place in"):
            transform_coordinates(np.array([[0.0, 95.0]]), pyproj.CRS(4326), pyproj.CRS(3857))

    def test_refuses_plain_coordinates(self):
        with pytest.raises(CrsError, match="cannot be brought together"):
            transform_coordinates(np.array([[0.0, 0.0]]), LOCAL_CRS, pyproj.CRS(3857))

    def test_there_and_back_is_within_a_nanometre(self):
        given = np.array([[5e5 + k, 5.3e6 - k] for k in range(100)])
        there = transform_coordinates(given, pyproj.CRS(32632), pyproj.CRS(4326))
        back = transform_coordinates(there, pyproj.CRS(4326), pyproj.CRS(32632))
        assert shapely.hausdorff_distance(LineString(given), LineString(back)) < 1e-8


class TestLayersFarApart:
    def looks(self, longitude):
        here = LineString([(9.0, 50.0), (9.001, 50.0)])
        there = LineString([(longitude, 50.0), (longitude + 0.001, 50.0)])
        return [gpd.GeoDataFrame(geometry=[line], crs=4326) for line in (here, there)]

    def test_a_plane_that_cannot_hold_them_is_told(self):
        warnings = merge(self.looks(60.0)).report["warnings"]
        assert any("so far apart that lengths and the proximity are up to" in text for text in warnings)

    def test_those_within_a_plane_are_merged_without_a_word(self):
        assert merge(self.looks(9.5)).report["warnings"] == []
