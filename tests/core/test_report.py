"""What the report warns of: results that are right by the rules and may not be what was meant."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import pandas as pd
import pytest
from shapely import LineString, box

from polymerge_core import (
    LocalMaps,
    SchemaError,
    merge,
    merge_network,
    network_layers,
    read_local_maps,
    write_layers,
)
from polymerge_core.columns import NO_FOOTPRINTS
from tests.core.methods import every_method, published

pytestmark = every_method

UTM = "EPSG:32632"


def layer(*geometry, crs=UTM, x=5e5, y=5.4e6, **columns):
    """A layer of geometries given near the origin and moved to where the CRS is used."""
    return gpd.GeoDataFrame(columns, geometry=gpd.GeoSeries(geometry, crs=crs).translate(x, y))


def line(y, x=(0, 50)):
    return LineString([(x[0], y), (x[1], y)])


def warnings_of(*arguments, **options):
    return merge(*arguments, **options).report["warnings"]


class TestLayersThatCountAsOneLocalMap:
    def test_features_kept_apart_by_it_are_told(self):
        tracks, elsewhere = layer(line(0), line(0.5)), layer(line(500))
        (warning,) = warnings_of([tracks, elsewhere])
        assert "1 pairs of features within layer 'local_maps_1'" in warning
        assert "instance_from=feature" in warning

    def test_the_rule_named_by_the_user_is_not_questioned(self):
        tracks, elsewhere = layer(line(0), line(0.5)), layer(line(500))
        assert warnings_of([tracks, elsewhere], instance_from="layer") == []
        assert len(merge([tracks, elsewhere], instance_from="feature").elements) == 2

    def test_layers_whose_own_features_are_far_apart_are_fine(self):
        assert warnings_of([layer(line(0), line(20)), layer(line(0.5), line(20.5))]) == []


def test_a_layer_without_the_class_column_that_others_have_is_told():
    (warning,) = warnings_of(layer(line(0)), layer(line(0.5), element_id=[3], **{"class": ["divider"]}))
    assert "'local_maps' has no class column" in warning
    assert "'divider'" in warning
    assert "class_name" in warning


def test_a_layer_without_a_class_column_whose_class_others_have_is_fine():
    main = layer(line(0.5), line(90), element_id=[3, 4], **{"class": ["line", "divider"]})
    result = merge(layer(line(0)), main)
    assert result.report["warnings"] == []
    assert sorted(result.elements["n_observations"]) == [1, 2]


class TestWhatIsNoLayer:
    @pytest.mark.parametrize(
        ("given", "words"),
        [
            pytest.param(merge(layer(line(0))), r"is a MergeResult; .*\.as_main_map\(\).*\.elements", id="a result"),
            pytest.param({"tracks": layer(line(0))}, "is a dict; give one of its layers", id="a dictionary"),
            pytest.param(pd.DataFrame({"score": [1.0]}), "is a DataFrame; it has no geometry", id="a table"),
            pytest.param("tracks.gpkg", "is a str; read it with read_local_maps", id="a name"),
            pytest.param(Path("tracks.gpkg"), "; read it with read_local_maps", id="a path"),
            pytest.param(None, "give a GeoDataFrame", id="nothing"),
        ],
    )
    def test_is_refused_with_what_to_give(self, given, words):
        for arguments in ((given,), ([given],), (layer(line(0)), [given])):
            with pytest.raises(SchemaError, match=words) as found:
                merge(*arguments)
            assert len(str(found.value)) < 120


@published
def test_polygons_that_became_rectangles_are_told():
    parks = layer(box(0, 0, 90, 50), box(0.4, 0.4, 90, 50))
    (warning,) = warnings_of(parks)
    assert "1 merged areas of class 'line' became rectangles" in warning
    assert warnings_of(parks.assign(**{"class": "ped_crossing"})) == []


def test_columns_that_the_result_writes_anew_are_told():
    (warning,) = warnings_of(layer(line(0), length_m=[3.0]))
    assert "names length_m" in warning


def test_degrees_declared_as_plain_coordinates_are_told():
    track = layer(LineString([(14.4, 50.0), (14.401, 50.0005), (14.402, 50.0)]), crs=None, x=0, y=0)
    (warning,) = warnings_of(track, crs="local")
    assert "look like degrees" in warning
    assert warnings_of(layer(line(0), crs=None, x=0, y=0), crs="local") == []


def test_a_column_without_a_single_score_is_refused():
    with pytest.raises(SchemaError, match="the column 'speed' holds no scores"):
        merge(layer(line(0), line(9), speed=[30.0, 50.0]), score_field="speed")


class TestIdsAreNeverGivenTwice:
    @pytest.fixture
    def joined(self):
        """A map whose elements 3 and 7 became 3 when a new look touched both."""
        main = layer(line(0, (0, 40)), line(0, (60, 90)), element_id=[3, 7])
        result = merge(layer(line(0.2, (30, 70))), main)
        assert result.id_aliases.to_numpy().tolist() == [[7, 3]]
        return result

    def test_over_an_id_that_is_no_more(self, joined):
        again = merge(layer(line(300)), joined.as_main_map())
        assert again.elements["element_id"].tolist() == [3, 8]
        assert again.id_aliases.to_numpy().tolist() == [[7, 3]]

    def test_and_aliases_follow_where_their_element_went(self, joined):
        main = LocalMaps(layer(line(0, (0, 90)), line(0, (120, 150)), element_id=[3, 2]), id_aliases=joined.id_aliases)
        again = merge(layer(line(0.2, (80, 130))), main)
        assert again.elements["element_id"].tolist() == [2]
        assert again.id_aliases.to_numpy().tolist() == [[3, 2], [7, 2]]

    @pytest.mark.parametrize("extension", ["gpkg", "shp"])
    def test_through_a_file(self, joined, tmp_path, extension):

        write_layers(tmp_path / f"map.{extension}", joined.layers())
        again = merge(layer(line(300)), read_local_maps([tmp_path / f"map.{extension}"]))
        assert again.elements["element_id"].tolist() == [3, 8]
        assert again.id_aliases.to_numpy().tolist() == [[7, 3]]


def test_a_main_map_without_counts_is_one_look():
    main = layer(line(0, (0, 40)), line(0, (60, 90)), element_id=[3, 7])
    assert merge(layer(line(0.2, (30, 70))), main).elements["n_instances"].tolist() == [2]


def test_the_id_of_an_element_that_is_left_out_is_not_given_again():
    main = layer(line(0), None, element_id=[1, 2])
    assert merge(layer(line(300)), main).elements["element_id"].tolist() == [1, 3]


def test_a_main_map_is_read_by_the_named_class_column_where_it_has_it():
    result = merge(layer(line(0), kind=["divider"]), layer(line(0.5), kind=["divider"]), class_field="kind")
    assert result.elements["class"].tolist() == ["divider"]


def test_two_local_maps_without_names_are_two_looks():
    result = merge([LocalMaps(layer(line(0))), LocalMaps(layer(line(0.5)))])
    assert result.elements["n_instances"].tolist() == [2]


def test_a_second_column_of_one_name_is_refused():
    twice = layer(line(0), a=[1], b=[2]).rename(columns={"b": "a"})
    with pytest.raises(SchemaError, match="two columns 'a'"):
        merge(twice)


def test_a_text_column_called_geometry_is_kept_under_another_name():
    named = layer(line(0)).rename_geometry("shape").assign(geometry=["kerb"])
    result = merge(named)
    assert result.elements["geometry_1"].tolist() == ["kerb"]
    assert "'geometry_1'" in result.report["warnings"][0]


def test_sums_of_large_numbers_do_not_wrap_round():
    result = merge(layer(*(line(y / 10) for y in range(4)), n=[2**62] * 4), aggregate="sum")
    assert result.elements["n"].tolist() == [2.0**64]


def test_layers_of_a_part_of_a_network_name_the_same_observations():
    graph = merge_network(layer(line(0), line(50), line(50.5)))
    (pair,) = graph.edges
    edges = network_layers(graph.subgraph(pair))["edges"]
    assert edges[["from_observation", "to_observation"]].to_numpy().tolist() == [sorted(pair)]
    assert edges.length.tolist() == pytest.approx([0.5])


def test_every_class_is_counted():
    many = layer(*(line(2.0 * y) for y in range(300)), **{"class": [f"c{y}" for y in range(300)]})
    classes = merge(many).report["classes"]
    assert len(classes) == 300
    assert classes["c7"] == {"observations": 1, "observed_m": 50.0, "elements": 1, "elements_m": 50.0}


def test_where_footprints_come_from_is_said():
    looks = layer(line(0), instance=[1])
    footprints = layer(box(0, 0, 9, 9), drive=["a"], instance=[1])
    sources = [LocalMaps(looks, footprints, source="a"), LocalMaps(looks, source="b")]
    expected = {"a": "instances", "b": NO_FOOTPRINTS}
    assert merge(sources).report["footprints"] == expected
