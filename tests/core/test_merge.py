"""The layer contract, sentence by sentence, through `merge`."""

from __future__ import annotations

import json

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from geopandas.testing import assert_geodataframe_equal
from shapely import LineString, MultiLineString, Point, Polygon

from polymerge_core import InputError, LocalMaps, OptionError, SchemaError, merge
from polymerge_core.area import merge_areas
from polymerge_core.columns import NO_FOOTPRINTS
from polymerge_core.crs import LOCAL_CRS
from tests.core.methods import consensus, every_method, published

pytestmark = every_method

#: Straight lines of 10 m along x: those of one row, 0.5 m apart, are one element; rows are 50 m apart.
SQUARE = [(0, 0), (5, 0), (5, 5), (0, 5), (0, 0)]


def line(y=0.0, x=0.0, length=10.0):
    return LineString([(x, y), (x + length, y)])


def layer(*shapes, index=None, crs=None, **columns):
    return gpd.GeoDataFrame(columns, index=index, geometry=list(shapes), crs=crs)


def from_text(wkt):
    """Read WKT that holds what is not a number, without GEOS's warning."""
    with np.errstate(invalid="ignore"):
        return shapely.from_wkt(wkt)


def merged(local_maps, main_map=None, **options):
    return merge(local_maps, main_map, crs="local", **options)


def sets_of(result):
    """Return the source features of each element."""
    groups = result.lineage.groupby("element_id")["source_fid"]
    return sorted(tuple(sorted(group.tolist())) for _, group in groups)


def reasons(result):
    return result.left_out["reason"].tolist()


class TestClasses:
    def test_only_one_class_is_merged_with_itself(self):
        result = merged(layer(line(), line(0.5), line(0.7), **{"class": ["divider", "boundary", "divider"]}))
        assert sets_of(result) == [(0, 2), (1,)]
        assert sorted(result.elements["class"]) == ["boundary", "divider"]

    def test_without_a_column_all_are_of_one_class(self):
        assert merged(layer(line(), line(0.5))).elements["class"].tolist() == ["line"]

    def test_without_a_column_the_class_can_be_named(self):
        assert merged(layer(line()), class_name="track").elements["class"].tolist() == ["track"]

    def test_class_name_is_not_for_layers_that_have_the_column(self):
        result = merged(layer(line(), **{"class": ["divider"]}), class_name="track")
        assert result.elements["class"].tolist() == ["divider"]

    def test_another_column_can_hold_the_class(self):
        result = merged(layer(line(), line(0.5), kind=["a", "b"]), class_field="kind")
        assert result.elements["class"].tolist() == ["a", "b"]
        assert "kind" not in result.elements

    def test_column_that_was_named_and_is_not_there_is_an_error_that_lists_the_columns(self):
        with pytest.raises(SchemaError, match=r"no column 'kind'; the columns are name, width"):
            merged(layer(line(), name=["a"], width=[2]), class_field="kind")

    def test_feature_without_a_class_is_left_out(self):
        result = merged(layer(line(), line(0.5), **{"class": ["divider", None]}))
        assert sets_of(result) == [(0,)]
        assert reasons(result) == ["no class"]

    def test_classes_that_differ_in_case_are_not_merged_and_said_so(self):
        result = merged(layer(line(), line(0.5), **{"class": ["Divider", "divider"]}))
        assert len(result.elements) == 2
        assert result.report["warnings"] == ["the classes 'Divider', 'divider' are not merged with each other"]

    def test_numbers_are_classes_too(self):
        both = layer(line(), line(0.5), **{"class": [3.0, 3.0]}), layer(line(0.7), **{"class": [3]})
        result = merged(both, instance_from="feature")
        assert result.elements["class"].tolist() == ["3"]


class TestInstances:
    def test_one_layer_without_a_column_each_feature_is_one(self):
        result = merged(layer(*[line(0.1 * k) for k in range(12)]))
        assert len(result.elements) == 1
        assert result.elements["n_instances"].tolist() == [12]
        assert result.report["instance_from"] == {"local_maps": "feature"}

    def test_two_layers_without_a_column_each_layer_is_one(self):
        result = merged([layer(line(), line(50)), layer(line(0.5), line(50.5))])
        assert result.report["instance_from"] == {"local_maps_1": "layer", "local_maps_2": "layer"}
        assert result.report["instances"] == 2
        assert result.elements["n_instances"].tolist() == [2, 2]
        assert result.elements["n_observations"].tolist() == [2, 2]

    @published
    def test_an_instance_counts_once_however_much_of_it_is_in_an_element(self):
        result = merged([layer(line(), line(0.2)), layer(line(0.5), line(0.6))])
        assert result.elements["n_instances"].tolist() == [2]
        assert result.elements["n_observations"].tolist() == [4]

    @consensus
    def test_a_line_that_an_instance_has_in_two_pieces_counts_once(self):
        result = merged(layer(line(length=20), line(length=9), line(x=11, length=9), instance=[1, 2, 2]))
        assert result.elements["n_instances"].tolist() == [2]
        assert result.elements["n_observations"].tolist() == [3]

    def test_column_tells(self):
        result = merged(layer(line(), line(0.3), line(50), line(50.3), instance=[1, 2, 1, 2]))
        assert result.elements["n_instances"].tolist() == [2, 2]
        assert result.report["instances"] == 2
        assert result.report["instance_from"] == {"local_maps": "column"}

    def test_two_observations_of_the_first_instance_are_no_pair(self):
        assert sets_of(merged(layer(line(), line(0.3), instance=["a", "a"]))) == [(0,), (1,)]

    @published
    def test_two_observations_of_a_later_instance_are_a_pair(self):
        looks = layer(line(50), line(0.0), line(0.3), instance=["a", "b", "b"])
        assert sets_of(merged(looks)) == [(0,), (1, 2)]

    @consensus
    def test_two_observations_of_any_instance_are_no_pair(self):
        looks = layer(line(50), line(0.0), line(0.3), instance=["a", "b", "b"])
        assert sets_of(merged(looks)) == [(0,), (1,), (2,)]

    @pytest.mark.parametrize(
        ("rule", "instances"), [("column", 2), ("layer", 1), ("feature", 3)], ids=["column", "layer", "feature"]
    )
    def test_rule_can_be_chosen(self, rule, instances):
        result = merged(layer(line(), line(0.3), line(0.6), instance=[1, 1, 2]), instance_from=rule)
        assert result.report["instances"] == instances
        assert result.report["instance_from"] == {"local_maps": rule}

    def test_rule_column_needs_the_column(self):
        with pytest.raises(SchemaError, match="no column 'instance'"):
            merged(layer(line(), name=["a"]), instance_from="column")

    def test_rule_can_differ_from_layer_to_layer(self):
        result = merged([layer(line(), line(0.3), instance=[1, 2]), layer(line(0.5), line(0.6))])
        assert result.report["instance_from"] == {"local_maps_1": "column", "local_maps_2": "layer"}
        assert result.report["instances"] == 3

    def test_other_columns_can_tell(self):
        looks = layer(line(), line(0.3), frame=[1, 1], vehicle=["a", "b"])
        result = merged(looks, instance_field="frame", drive_field="vehicle")
        assert result.report["instances"] == 2
        assert result.lineage["drive"].tolist() == ["a", "b"]
        assert result.lineage["instance"].tolist() == ["1", "1"]

    @pytest.mark.parametrize("option", ["drive_field", "instance_field", "score_field", "timestamp_field"])
    def test_column_that_was_named_must_be_there(self, option):
        with pytest.raises(SchemaError, match="no column 'absent'"):
            merged(layer(line()), **{option: "absent"})

    def test_same_number_in_another_drive_is_another_one(self):
        looks = layer(line(), line(0.3), drive=["a", "b"], instance=[7, 7])
        assert merged(looks).elements["n_instances"].tolist() == [2]

    def test_drive_is_the_source_by_default(self):
        result = merged(LocalMaps(layer(line(), instance=[1]), source="monday"))
        assert result.lineage["drive"].tolist() == ["monday"]

    def test_feature_without_an_instance_is_left_out(self):
        result = merged(layer(line(), line(0.5), instance=["a", None]))
        assert reasons(result) == ["no instance"]

    def test_features_that_share_an_index_are_looks_of_their_own(self):
        looks = pd.concat([layer(line()), layer(line(0.5))])
        result = merged(looks)
        assert result.report["instances"] == 2
        assert len(result.elements) == 1


class TestDuplicates:
    @pytest.mark.parametrize("copy", [line(), line().reverse()], ids=["same", "reversed"])
    def test_same_look_counts_once(self, copy):
        result = merged(layer(line(), copy, line(0.5), instance=[1, 1, 2]))
        assert result.elements["n_observations"].tolist() == [2]
        assert reasons(result) == ["duplicate"]
        assert result.left_out["to_m"].tolist() == [10.0]

    @pytest.mark.parametrize("column", ["drive", "instance", "class"])
    def test_of_another_drive_instance_or_class_count(self, column):
        columns = {"drive": ["a", "a"], "instance": [1, 1], "class": ["x", "x"]} | {column: ["a", "b"]}
        assert reasons(merged(layer(line(), line(), **columns))) == []

    def test_of_features_each_its_own_instance_count(self):
        result = merged(layer(line(), line()))
        assert result.elements["n_observations"].tolist() == [2]
        assert result.elements.geometry.iloc[0].equals_exact(line(), 1e-9)

    def test_of_a_main_map_stay(self):
        result = merged([], layer(line(), line(), element_id=[1, 2]))
        assert result.elements["element_id"].tolist() == [1, 2]


class TestClassKinds:
    def test_crossing_is_an_area_even_as_a_line(self):
        looks = layer(LineString(SQUARE), LineString(SQUARE), **{"class": ["ped_crossing"] * 2})
        result = merged(looks)
        (element,) = result.elements.geometry
        assert element.geom_type == "LineString"
        assert element.is_closed
        # The corners of three identical squares do not change; four scenarios would not give a rectangle at 45.
        assert Polygon(element).symmetric_difference(Polygon(SQUARE)).area < 20 * 0.2

    def test_crossings_come_out_as_the_type_in_which_they_came(self):
        shapes = [Polygon(SQUARE), Polygon(SQUARE)]
        result = merged(layer(*shapes, **{"class": ["ped_crossing"] * 2}))
        assert result.elements.geom_type.tolist() == ["Polygon"]

    def test_polygons_and_closed_lines_of_an_area_class_are_merged(self):
        shapes = [Polygon(SQUARE), LineString(np.array(SQUARE) + 0.3)]
        result = merged(layer(*shapes, instance=[1, 2], **{"class": ["ped_crossing"] * 2}))
        assert result.elements.geom_type.tolist() == ["Polygon"]
        result = merged(layer(*shapes, instance=[2, 1], **{"class": ["ped_crossing"] * 2}))
        assert result.elements.geom_type.tolist() == ["LineString"]

    @pytest.mark.parametrize("name", ["divider", "boundary"])
    def test_polygons_of_line_classes_are_rings(self, name):
        result = merged(layer(Polygon(SQUARE), **{"class": [name]}))
        (element,) = result.elements.geometry
        assert element.equals_exact(LineString(SQUARE))

    def test_every_ring_of_such_a_polygon_is_a_line(self):
        hole = [(1, 1), (2, 1), (2, 2), (1, 2), (1, 1)]
        result = merged(layer(Polygon(SQUARE, [hole]), **{"class": ["boundary"]}))
        assert sorted(result.elements.length) == [4, 20]
        assert result.lineage[["from_m", "to_m"]].sort_values("from_m").to_numpy().tolist() == [[0, 20], [20, 24]]

    def test_polygons_of_other_classes_are_areas_and_lines_are_lines_even_closed_ones(self):
        shapes = [Polygon(SQUARE), LineString(SQUARE)]
        result = merged(layer(*shapes, **{"class": ["island", "island"]}))
        assert sorted(result.elements.geom_type) == ["LineString", "Polygon"]

    def test_area_names_more_classes(self):
        shapes = [LineString(SQUARE[:-1]), LineString(SQUARE[:-1])]
        (element,) = merged(layer(*shapes, **{"class": ["island"] * 2}), area="island").elements.geometry
        assert element.is_closed
        (element,) = merged(layer(*shapes, **{"class": ["island"] * 2})).elements.geometry
        assert not element.is_closed

    def test_area_can_name_a_line_class(self):
        result = merged(layer(Polygon(SQUARE), **{"class": ["divider"]}), area=["divider"])
        assert result.elements.geom_type.tolist() == ["Polygon"]

    def test_crossings_stay_areas_when_area_names_another_class(self):
        result = merged(layer(LineString(SQUARE[:-1]), **{"class": ["ped_crossing"]}), area=["island"])
        assert result.elements.geometry.iloc[0].is_closed

    def test_open_line_of_an_area_class_is_closed(self):
        result = merged(layer(LineString(SQUARE[:-1]), **{"class": ["ped_crossing"]}))
        assert result.elements.geometry.iloc[0].equals_exact(LineString(SQUARE))
        assert result.lineage["to_m"].tolist() == [20.0]

    def test_line_of_two_vertices_of_an_area_class_is_left_out(self):
        result = merged(layer(line(), LineString(SQUARE), **{"class": ["ped_crossing"] * 2}))
        assert reasons(result) == ["an open line of two vertices encloses no area"]
        assert result.left_out["to_m"].tolist() == [10.0]

    def test_ring_that_crosses_itself_is_left_out(self):
        bow = Polygon([(0, 0), (5, 5), (5, 0), (0, 5)])
        result = merged(layer(bow, **{"class": ["ped_crossing"]}))
        assert len(result.elements) == 0
        assert reasons(result) == ["the ring of an area touches or crosses itself"]

    def test_line_that_crosses_itself_is_kept(self, method):
        eight = LineString([(0, 0), (50, 50), (50, 0), (0, 50)])
        (found,) = merged(layer(eight, eight)).elements.geometry
        # The consensus rounds corners, hairpins most of all.
        assert found.hausdorff_distance(eight) <= {"polymerge": 0.0, "consensus": 3.0}[method]

    def test_closed_lines_stay_closed(self):
        island = LineString(SQUARE)
        result = merged(layer(island, LineString(np.array(SQUARE) + 0.3), **{"class": ["divider"] * 2}))
        assert len(result.elements) == 1
        assert result.elements.geometry.iloc[0].is_closed

    @published
    def test_coverage_that_no_place_has_is_lowered_and_said_so(self):
        shapes = [Polygon(np.add(SQUARE, (shift, 0))) for shift in (0, 5.5)]
        result = merged(layer(*shapes, **{"class": ["ped_crossing"] * 2}), coverage=0.9)
        assert result.report["areas_with_lowered_coverage"] == 1
        assert "1 areas have no place that 90% of their observations cover" in result.report["warnings"][0]


class TestGridOfAnArea:
    def test_lies_at_the_areas_wherever_they_are(self, rng):
        shapes = [Polygon(np.add(SQUARE, shift)) for shift in rng.normal(0, 0.4, (5, 2))]
        here = merge_areas(np.array(shapes)).polygon
        there = merge_areas(shapely.transform(np.array(shapes), lambda xy: np.add(xy, (0.05, 0.03)))).polygon
        assert there.equals_exact(shapely.transform(here, lambda xy: np.add(xy, (0.05, 0.03))), 1e-6)

    def test_joins_cells_by_their_sides_not_by_their_corners(self):
        # Without blur the two squares meet at a corner of two cells.
        squares = np.array([shapely.box(0, 0, 4.03, 4.03), shapely.box(4.03, 4.03, 10.07, 10.07)])
        result = merge_areas(squares, coverage=0.5, sigma=1e-3).polygon
        assert shapely.hausdorff_distance(result, squares[1]) < 0.2


class TestMainMap:
    def test_elements_keep_their_ids(self):
        main = layer(line(), line(50), element_id=[7, 3])
        result = merged(layer(line(0.5)), main)
        assert result.elements["element_id"].tolist() == [3, 7]
        assert result.elements["n_observations"].tolist() == [1, 2]
        assert len(result.id_aliases) == 0

    @pytest.mark.parametrize("y", [0.3, -0.3])
    def test_where_several_that_a_look_joins_become_one_the_smallest_wins(self, y):
        main = layer(line(), line(x=15), line(50), element_id=[7, 3, 5])
        result = merged(layer(line(y, x=4, length=17)), main)
        assert result.elements["element_id"].tolist() == [3, 5]
        assert result.id_aliases.to_dict("list") == {"old_id": [7], "element_id": [3]}

    @published
    def test_where_several_become_one_the_smallest_wins(self):
        main = layer(line(), line(1.5), line(50), element_id=[7, 3, 5])
        result = merged(layer(line(0.75)), main)
        assert result.elements["element_id"].tolist() == [3, 5]
        assert result.id_aliases.to_dict("list") == {"old_id": [7], "element_id": [3]}

    @published
    def test_aliases_are_listed_for_each_id_that_is_no_more(self):
        main = layer(line(), line(1.5), line(3.0), element_id=[9, 4, 6])
        result = merged(layer(line(0.75), line(2.25), instance=[1, 1]), main)
        assert result.id_aliases.to_dict("list") == {"old_id": [6, 9], "element_id": [4, 4]}

    def test_new_ids_follow_in_canonical_order(self):
        main = layer(line(500), element_id=[41])
        looks = layer(line(50), line(0), line(100), **{"class": ["b", "b", "a"]})
        elements = merged(looks, main).elements
        assert elements["element_id"].tolist() == [41, 42, 43, 44]
        assert elements["class"].tolist() == ["line", "a", "b", "b"]
        keys = shapely.to_wkb(shapely.normalize(elements.geometry.to_numpy()[2:]))
        assert keys[0] < keys[1]

    def test_two_elements_of_the_map_are_no_pair(self):
        main = layer(line(), line(0.2), element_id=[1, 2])
        assert merged(layer(line(50)), main).elements["element_id"].tolist() == [1, 2, 3]

    def test_longest_element_of_the_map_is_the_base(self):
        main = layer(line(0, length=8), line(0, x=12), element_id=[1, 2], name=["short", "long"])
        assert merged(layer(line(0.3, length=20)), main).elements["name"].tolist() == ["long"]

    def test_map_element_is_the_base_even_when_a_look_is_longer(self):
        result = merged(layer(line(0.5, length=100), name=["look"]), layer(line(), element_id=[1], name=["map"]))
        assert result.elements["name"].tolist() == ["map"]

    def test_counts_and_scores_add_up_over_merges(self):
        first = merged(layer(line(), line(0.2), line(0.4), instance=[1, 2, 3], score=[0.2, 0.4, 0.6]))
        assert first.elements[["n_observations", "n_instances"]].to_numpy().tolist() == [[3, 3]]
        assert first.elements["score"].tolist() == pytest.approx([0.4])
        second = merged(layer(line(0.3), line(0.5), instance=[3, 4], score=[1.0, 1.0]), first.elements)
        assert second.elements[["n_observations", "n_instances"]].to_numpy().tolist() == [[5, 5]]
        assert second.elements["score"].tolist() == pytest.approx([(3 * 0.4 + 2) / 5])

    def test_names_of_a_shapefile_are_known(self):
        main = layer(line(), elem_id=[12], n_obs=[5], n_inst=[4])
        elements = merged(layer(line(0.5)), main).elements
        assert elements[["element_id", "n_observations", "n_instances"]].to_numpy().tolist() == [[12, 6, 5]]
        assert "n_obs" not in elements

    def test_without_ids_of_its_own_gets_new_ones(self):
        assert merged([], layer(line(50), line())).elements["element_id"].tolist() == [1, 2]

    def test_ids_must_be_unique(self):
        with pytest.raises(SchemaError, match="element_id 3 occurs more than once"):
            merged([], layer(line(), line(50), element_id=[3, 3]))

    @pytest.mark.parametrize("ids", [["a"], [1.5], [-2], [None]])
    def test_ids_must_be_whole_numbers(self, ids):
        with pytest.raises(SchemaError, match="element_id"):
            merged([], layer(line(), element_id=ids))

    def test_parts_of_a_map_element_get_ids_of_their_own(self):
        result = merged([], layer(MultiLineString([line(), line(50)]), line(100), element_id=[5, 6]))
        assert result.elements["element_id"].tolist() == [5, 6, 7]
        assert len(result.id_aliases) == 0

    def test_lines_and_areas_may_come_as_two_layers(self):
        lines = layer(line(), element_id=[1], **{"class": ["divider"]})
        areas = layer(Polygon(SQUARE), element_id=[2], **{"class": ["ped_crossing"]})
        looks = layer(line(0.5), Polygon(SQUARE), **{"class": ["divider", "ped_crossing"]})
        result = merged(looks, [lines, areas])
        assert result.elements["element_id"].tolist() == [1, 2]
        assert result.elements["n_observations"].tolist() == [2, 2]

    def test_columns_named_for_the_local_maps_need_not_be_in_the_map(self):
        result = merged(layer(line(0.5), kind=["a"]), layer(line(), **{"class": ["a"]}), class_field="kind")
        assert len(result.elements) == 1

    def test_scores_of_the_map_are_not_cut(self):
        result = merged(layer(line(0.5), score=[0.9]), layer(line(), score=[0.1]), min_score=0.8)
        assert result.elements["n_observations"].tolist() == [2]

    @pytest.mark.parametrize("nothing", [[], "layer"], ids=["no layers", "an empty layer"])
    def test_merged_with_nothing_is_itself(self, nothing):
        first = merged(layer(line(), line(0.3), line(50), name=["a", "b", "c"], lanes=[1, 2, 3], flag=[True] * 3))
        again = merged(layer() if isinstance(nothing, str) else nothing, first.elements)
        assert_geodataframe_equal(again.elements, first.elements)


class TestOrderOfMerging:
    def base_of(self, looks, **options):
        (name,) = merged(looks, **options).elements["name"]
        return name

    @pytest.mark.parametrize(
        ("length", "base"), [(10, {"polymerge": "b", "consensus": "b"}), (20, {"polymerge": "b", "consensus": "a"})]
    )
    def test_earliest_instance_holds_the_base(self, method, length, base):
        # Of the consensus the longest look is the base, of equally long ones the earliest.
        looks = layer(line(), line(0.5, length=length), name=["b", "a"], instance=[1, 2])
        assert self.base_of(looks) == base[method]

    def test_frame_9_comes_before_frame_10(self):
        looks = layer(line(), line(0.5), name=["ten", "nine"], instance=["frame 10", "frame 9"])
        assert self.base_of(looks) == "nine"

    def test_timestamps_come_before_names(self):
        looks = layer(line(), line(0.5), name=["later", "earlier"], instance=[1, 2], timestamp=[20, 10])
        assert self.base_of(looks) == "earlier"

    def test_dates_are_timestamps(self):
        times = pd.to_datetime(["2024-05-01T10:00:01", "2024-05-01T10:00:00.5"], format="ISO8601")
        looks = layer(line(), line(0.5), name=["later", "earlier"], instance=[1, 2], timestamp=times)
        assert self.base_of(looks) == "earlier"

    def test_drive_that_started_first_comes_first_with_all_of_it(self):
        looks = layer(
            *(line(), line(0.3), line(0.6), line(100)),
            name=["late frame of the first drive", "frame of the second drive", "next", "start"],
            drive=["z", "a", "a", "z"],
            instance=[1, 1, 2, 0],
            timestamp=[500, 20, 30, 10],
        )
        names = set(merged(looks).elements["name"])
        assert names == {"late frame of the first drive", "start"}

    def test_drives_that_start_together_go_by_name(self):
        looks = layer(line(), line(0.5), name=["second", "first"], drive=["drive 10", "drive 9"], instance=[1, 1])
        assert self.base_of(looks) == "first"

    def test_instances_without_a_timestamp_come_last(self):
        looks = layer(line(), line(0.5), name=["without", "with"], instance=[1, 2], timestamp=[None, 10])
        assert self.base_of(looks) == "with"

    def test_features_and_layers_go_by_content_not_by_position(self):
        a, b = layer(line(), name=["a"]), layer(line(0.5), name=["b"])
        assert self.base_of(pd.concat([a, b], ignore_index=True)) == self.base_of(pd.concat([b, a], ignore_index=True))
        assert self.base_of([a, b]) == self.base_of([b, a])

    @published
    def test_longest_observation_of_the_earliest_instance_is_the_base(self):
        looks = layer(*(line(0, length=8), line(0.9), line(0.5)), name=["short", "long", "later"], instance=[1, 1, 2])
        assert self.base_of(looks) == "long"

    @published
    def test_the_rest_follows_breadth_first(self):
        # The look of instance 2 touches the base by way of instance 3 only: 3 is merged first.
        looks = layer(line(), line(1.6), line(0.8), instance=[1, 2, 3])
        expected = merged(layer(line(), line(1.6), line(0.8), instance=[1, 3, 2])).elements
        assert_geodataframe_equal(merged(looks).elements, expected)
        assert len(expected) == 1


class TestLineage:
    def test_of_two_looks(self):
        looks = LocalMaps(layer(line(), line(0.5), index=[40, 41], instance=[1, 2]), source="monday")
        assert merged(looks).lineage.to_dict("records") == [
            {
                "source": "monday",
                "source_fid": fid,
                "drive": "monday",
                "instance": str(instance),
                "element_id": 1,
                "from_m": 0.0,
                "to_m": 10.0,
                "weight": 0.5,
            }
            for fid, instance in [(40, 1), (41, 2)]
        ]

    def test_parts_of_a_feature_follow_each_other(self):
        parts = MultiLineString([line(length=4), line(50, length=5), line(100, length=6)])
        lineage = merged(layer(parts)).lineage.sort_values("from_m")
        assert lineage[["from_m", "to_m"]].to_numpy().tolist() == [[0, 4], [4, 9], [9, 15]]
        assert lineage["element_id"].nunique() == 3

    def test_polygons_go_by_their_perimeter(self):
        lineage = merged(layer(Polygon(SQUARE), **{"class": ["ped_crossing"]})).lineage
        assert lineage[["from_m", "to_m"]].to_numpy().tolist() == [[0, 20]]

    def test_weights_of_an_element_add_up_to_1(self):
        lineage = merged(layer(*[line(0.1 * k) for k in range(7)], line(50))).lineage
        assert lineage.groupby("element_id")["weight"].sum().tolist() == pytest.approx([1, 1])

    def test_map_elements_are_listed_too(self):
        lineage = merged(layer(line(0.5)), LocalMaps(layer(line(), element_id=[4]), source="stored")).lineage
        assert lineage["source"].tolist() == ["stored", "local_maps"]
        assert lineage["weight"].tolist() == [0.5, 0.5]

    def test_columns_are_those_of_the_contract_even_without_rows(self):
        result = merged(layer())
        assert list(result.lineage) == [
            *("source", "source_fid", "drive", "instance", "element_id", "from_m", "to_m", "weight")
        ]
        assert list(result.left_out) == ["source", "source_fid", "drive", "instance", "from_m", "to_m", "reason"]
        assert list(result.id_aliases) == ["old_id", "element_id"]

    def test_length_is_measured_in_metres_whatever_the_crs(self):
        looks = layer(line(), line(0.5), crs="EPSG:32632").translate(5e5, 5.3e6).to_frame("geometry")
        degrees = merge(looks.to_crs(4326))
        assert degrees.lineage["to_m"].tolist() == pytest.approx([10.0, 10.0], rel=5e-4)
        in_utm = degrees.elements.to_crs("EPSG:32632").length
        assert degrees.elements["length_m"].tolist() == pytest.approx(in_utm.tolist(), rel=5e-4)


class TestLeftOut:
    @pytest.mark.parametrize(
        ("shape", "reason"),
        [
            pytest.param(None, "no geometry", id="null"),
            pytest.param(LineString(), "empty geometry", id="empty line"),
            pytest.param(shapely.GeometryCollection(), "empty geometry", id="empty collection"),
            pytest.param(from_text("LINESTRING (0 0, nan 1)"), "a coordinate is not a number", id="nan"),
            pytest.param(from_text("LINESTRING (0 0, inf 1)"), "a coordinate is not a number", id="inf"),
            pytest.param(LineString([(0, 0), (1e13, 1)]), "a coordinate is too large", id="huge"),
            pytest.param(LineString([(3, 3), (3, 3)]), "zero length", id="zero length"),
            pytest.param(LineString([(3, 3), (3, 3 + 1e-10)]), "zero length", id="shorter than any map"),
            pytest.param(Point(1, 1), "neither a line nor a polygon", id="point"),
        ],
    )
    def test_with_its_reason(self, shape, reason):
        result = merged(LocalMaps(layer(line(), shape, index=[8, 9], instance=["a", "b"]), source="monday"))
        assert sets_of(result) == [(8,)]
        assert result.left_out.to_dict("records") == [
            {
                "source": "monday",
                "source_fid": 9,
                "drive": "monday",
                "instance": "b",
                "from_m": 0.0,
                "to_m": result.left_out["to_m"].iloc[0],
                "reason": reason,
            }
        ]
        assert result.left_out["to_m"].iloc[0] == pytest.approx(0.0, abs=1e-9)
        assert result.report["left_out"] == {reason: 1}

    def test_parts_of_a_collection_that_are_no_lines(self):
        mixed = shapely.GeometryCollection([Point(0, 0), line(), MultiLineString([line(50), line(100)])])
        result = merged(layer(mixed))
        assert len(result.elements) == 3
        assert reasons(result) == ["neither a line nor a polygon"]

    @pytest.mark.parametrize(
        ("score", "reason"),
        [
            (0.79, "the score is under min_score (0.8)"),
            (-0.1, "the score is not between 0 and 1"),
            (1.1, "the score is not between 0 and 1"),
            (float("nan"), "the score is not a number"),
        ],
    )
    def test_for_its_score_with_its_whole_length(self, score, reason):
        result = merged(layer(line(), line(0.5, length=7), score=[0.8, score]), min_score=0.8)
        assert reasons(result) == [reason]
        assert result.left_out[["from_m", "to_m"]].to_numpy().tolist() == [[0, 7]]
        assert result.elements["score"].tolist() == [0.8]

    def test_lengths_are_metres_whatever_the_crs(self):
        looks = layer(line(), line(5), crs="EPSG:32632", **{"class": ["ped_crossing", "divider"]})
        looks = looks.set_geometry(looks.translate(5e5, 5.3e6)).to_crs(4326)
        left_out = merge(looks).left_out
        assert left_out["to_m"].tolist() == pytest.approx([10.0], rel=1e-3)

    def test_what_was_left_out_before_is_listed_with_the_rest(self):
        before = pd.DataFrame(
            {"source": "p", "source_fid": 5, "drive": "d", "instance": "3", "from_m": 0.0, "to_m": 2.5, "reason": "r"},
            index=[0],
        )
        result = merged(LocalMaps(layer(line(), None), source="z", left_out=before))
        assert reasons(result) == ["r", "no geometry"]

    def test_features_that_all_are_left_out_give_an_empty_map(self):
        result = merged(layer(None, LineString()))
        assert len(result.elements) == 0
        assert len(result.left_out) == 2

    @pytest.mark.parametrize(
        "looks",
        [layer(line(), None, index=[8, 9]), layer(line(), line(), instance=[1, 1])],
        ids=["no geometry", "duplicate"],
    )
    def test_strict_makes_it_an_error(self, looks):
        with pytest.raises(InputError, match="cannot be used"):
            merged(looks, strict=True)

    def test_strict_names_layer_feature_and_reason(self):
        with pytest.raises(InputError, match=r"monday.*: feature 9 cannot be used: no geometry"):
            merged(LocalMaps(layer(line(), None, index=[8, 9]), source="monday"), strict=True)

    def test_strict_is_content_with_clean_data(self):
        assert len(merged(layer(line()), strict=True).elements) == 1


class TestGeometry:
    def test_of_what_nothing_was_merged_into_is_the_same_bit_for_bit(self):
        shape = LineString([(0.1 + 0.2, 1 / 3), (4.7, 2 / 3), (9, 1e-17)])
        assert merged(layer(shape)).elements.geometry.to_wkb().tolist() == [shape.wkb]

    def test_untouched_elements_come_back_bit_for_bit_in_their_own_crs(self):
        degrees = LineString([(11.575123456789, 48.137123456789), (11.5752, 48.1373), (11.57531, 48.13729)])
        result = merge(layer(degrees, crs="EPSG:4326"))
        assert result.report["working_crs"] != "EPSG:4326"
        assert result.elements.geometry.to_wkb().tolist() == [degrees.wkb]

    def test_heights_are_dropped(self):
        result = merged(layer(LineString([(0, 0, 5), (9, 0, 7)]), line(0.5)))
        assert not result.elements.has_z.any()

    def test_heights_that_are_not_numbers_do_no_harm(self):
        result = merged(layer(from_text("LINESTRING Z (0 0 nan, 9 0 7)")))
        assert result.elements.geometry.to_wkt().tolist() == ["LINESTRING (0 0, 9 0)"]

    def test_repeated_vertices_are_cleaned_and_counted(self):
        result = merged(layer(LineString([(0, 0), (0, 0), (5, 0), (5, 1e-12), (9, 0)])))
        assert result.report["cleaned_vertices"] == 2

    def test_has_no_repeated_vertices_where_copies_differ_by_rounding(self, rng, method):
        # The same lines in three CRSs: brought together they differ in the last digit.
        vertices = np.cumsum(rng.uniform(0.5, 4, (100, 6, 2)), axis=1) + rng.uniform(0, 5000, (100, 1, 2))
        lines = gpd.GeoDataFrame(geometry=[LineString(np.add(v, (5e5, 5.3e6))) for v in vertices * 4], crs="EPSG:32632")
        result = merge([lines, lines.to_crs(4326), lines.to_crs(3857)])
        coordinates, owner = shapely.get_coordinates(result.elements.geometry.to_numpy(), return_index=True)
        assert np.isfinite(coordinates).all()
        assert (np.diff(coordinates, axis=0)[np.diff(owner) == 0] != 0).any(axis=1).all()
        distance = shapely.hausdorff_distance(lines.geometry.union_all(), result.elements.geometry.union_all())
        # The consensus rounds the corners of these scribbles.
        assert distance < (1e-6 if method == "polymerge" else 1.0)

    def test_length_is_that_of_the_geometry(self):
        elements = merged(layer(line(), line(0.5), Polygon(SQUARE))).elements
        assert elements["length_m"].tolist() == pytest.approx(elements.length.tolist())


class TestInputs:
    @pytest.mark.parametrize(
        "given",
        [
            pytest.param(layer(line(), line(0.5)), id="GeoDataFrame"),
            pytest.param(gpd.GeoSeries([line(), line(0.5)]), id="GeoSeries"),
            pytest.param(LocalMaps(layer(line(), line(0.5))), id="LocalMaps"),
            pytest.param([layer(line()), layer(line(0.5))], id="list"),
            pytest.param((layer(line()), gpd.GeoSeries([line(0.5)])), id="tuple of both"),
            pytest.param(lambda: iter([layer(line()), layer(line(0.5))]), id="iterator"),
            pytest.param([LocalMaps(layer(line()), source="a"), layer(line(0.5))], id="list with LocalMaps"),
            pytest.param(layer(line(), line(0.5)).rename_geometry("shape"), id="another geometry column"),
        ],
    )
    def test_of_any_kind_give_the_same_elements(self, given, method):
        elements = merged(given() if callable(given) else given).elements
        text = {"polymerge": "LINESTRING (0 0.5, 0 0, 10 0, 10 0.5)", "consensus": "LINESTRING (0 0.25, 10 0.25)"}
        (found,) = elements.geometry
        assert found.equals_exact(shapely.from_wkt(text[method]), 1e-9)
        assert elements.geometry.name == "geometry"

    @pytest.mark.parametrize("given", [[line()], [pd.DataFrame({"a": [1]})], [None]])
    def test_of_other_kinds_are_refused(self, given):
        with pytest.raises(SchemaError, match="give a GeoDataFrame"):
            merged(given)

    def test_without_layers_are_refused(self):
        with pytest.raises(InputError, match="no layers"):
            merged([])

    def test_with_points_only_are_refused_by_name(self):
        with pytest.raises(SchemaError, match="layer 'signs': the layer holds points"):
            merged([layer(line()), LocalMaps(layer(Point(0, 0)), source="signs")])

    def test_without_a_geometry_column_are_refused(self):
        with pytest.raises(SchemaError, match="no geometry column"):
            merged(gpd.GeoDataFrame({"a": [1]}))

    def test_empty_layer_beside_others_changes_nothing(self):
        full = layer(line(), line(0.5), instance=[1, 2])
        assert_geodataframe_equal(merged([full, layer()]).elements, merged(full).elements)

    def test_empty_layers_give_an_empty_map_with_schema_and_crs(self, method):
        result = merge([layer(crs="EPSG:32632"), layer(crs="EPSG:32632")])
        assert list(result.elements) == [
            *("element_id", "class", "score", "n_observations", "n_instances", "length_m"),
            *(["sigma_m"] if method == "consensus" else []),
            "geometry",
        ]
        assert result.elements.crs == "EPSG:32632"
        assert result.report["elements"] == 0

    def test_are_not_changed(self):
        columns = {"class": ["ped_crossing", None, "divider"], "score": [0.1, 0.9, np.nan], "note": [None, "a", "b"]}
        looks = layer(Polygon(SQUARE), line(), MultiLineString([line(), line(50)]), index=[5, 6, 7], **columns)
        main = layer(line(), element_id=[1], note=[3])
        before = looks.copy(), main.copy()
        merged(looks, main, min_score=0.5, area="divider", aggregate="mode")
        assert_geodataframe_equal(looks, before[0])
        assert_geodataframe_equal(main, before[1])


class TestProgress:
    def test_grows_from_0_to_1(self, rng):
        shapes = [line(y, x) for x, y in rng.uniform(0, 100, (300, 2))] + [Polygon(SQUARE), Polygon(SQUARE)]
        seen = []
        merged(layer(*shapes), progress=lambda fraction, message: seen.append((fraction, message)))
        fractions = [fraction for fraction, _ in seen]
        assert fractions == sorted(fractions)
        assert (fractions[0], fractions[-1]) == (0.0, 1.0)
        assert all(message for _, message in seen)

    @pytest.mark.parametrize("number", range(4))
    def test_that_raises_stops_the_work(self, method, number):
        work = {"polymerge": ["looking for neighbours", "merging"], "consensus": ["finding the consensus"]}
        messages = ["reading the layers", *work[method], "writing the tables", "merged"]

        def stop(_fraction, text):
            if text == messages[number]:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            merged(layer(line(), line(0.5)), progress=stop)


class TestReport:
    def test_counts(self, method):
        main = layer(line(), element_id=[1], **{"class": ["divider"]})
        looks = layer(line(0.5), line(50), None, instance=[1, 2, 2], **{"class": ["divider", "boundary", "divider"]})
        report = merged(looks, main, proximity=0.9, coverage=0.6, min_score=0.1).report
        of_method = {"polymerge": "areas_with_lowered_coverage", "consensus": "corrections"}[method]
        assert report.pop(of_method) is not None
        joined = report["classes"]["divider"].pop("elements_m")
        assert joined == pytest.approx(11.0 if method == "polymerge" else 10.0, abs=0.05)
        assert report == {
            "method": method,
            "proximity_m": 0.9,
            "coverage": 0.6,
            "min_score": 0.1,
            "working_crs": "local",
            "out_crs": "local",
            "instance_from": {"local_maps": "column"},
            "footprints": {"local_maps": NO_FOOTPRINTS},
            "observations": 2,
            "main_map_elements": 1,
            "instances": 2,
            "elements": 2,
            "largest_set": 2,
            "left_out": {"no geometry": 1},
            "cleaned_vertices": 0,
            "classes": {
                "boundary": {"observations": 1, "observed_m": 10.0, "elements": 1, "elements_m": 10.0},
                "divider": {"observations": 1, "observed_m": 10.0, "elements": 1},
            },
            "warnings": [],
        }

    def test_is_ready_for_json(self):
        report = merged([layer(line(), line(0.5)), layer(Polygon(SQUARE))], aggregate="mean").report
        assert json.loads(json.dumps(report)) == report


class TestLayersOfTheResult:
    def test_of_one_type_of_geometry(self):
        layers = merged(layer(line())).layers()
        assert list(layers) == ["elements", "lineage", "left_out", "id_aliases"]

    def test_of_two_types_of_geometry(self):
        layers = merged(layer(line(50), Polygon(SQUARE))).layers()
        assert layers["elements"].geom_type.tolist() == ["LineString"]
        assert layers["elements_areas"].geom_type.tolist() == ["Polygon"]

    def test_of_areas_alone_are_the_elements(self):
        layers = merged(layer(Polygon(SQUARE))).layers()
        assert "elements_areas" not in layers
        assert len(layers["elements"]) == 1


class TestCrsOfTheResult:
    """The output CRS: out_crs, else the main map's, else the first input's."""

    @pytest.fixture
    def looks(self):
        return layer(line(5.3e6, 5e5), line(5.3e6 + 0.5, 5e5), crs="EPSG:32632")

    def test_is_the_first_layers(self, looks):
        assert merge([looks, looks.to_crs(4326)]).elements.crs == "EPSG:32632"
        assert merge([looks.to_crs(4326), looks]).elements.crs == "EPSG:4326"

    def test_is_the_main_maps(self, looks):
        assert merge(looks, looks.to_crs(3857)).elements.crs == "EPSG:3857"

    def test_can_be_chosen(self, looks):
        result = merge(looks, looks.to_crs(3857), out_crs="EPSG:25832")
        assert result.elements.crs == "EPSG:25832"
        assert result.report["out_crs"] == "EPSG:25832"

    def test_of_layers_without_one_is_the_declared(self, looks):
        assert merge(looks.set_crs(None, allow_override=True), crs="EPSG:32632").elements.crs == "EPSG:32632"

    def test_of_plain_coordinates_is_undefined(self):
        assert merged(layer(line())).elements.crs == LOCAL_CRS

    def test_layers_in_several_crss_are_brought_together(self, looks):
        result = merge([looks.iloc[:1], looks.iloc[1:].to_crs(4326)])
        expected = merge([looks.iloc[:1], looks.iloc[1:]])
        assert len(result.elements) == 1
        assert result.elements.geometry.iloc[0].equals_exact(expected.elements.geometry.iloc[0], 1e-6)


def test_options_are_checked_before_the_data():
    with pytest.raises(OptionError, match="proximity cannot be -1"):
        merge([], proximity=-1)
