"""Reading the columns of the layer contract, whatever type a format gave them."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from shapely import LineString

from polymerge_core import SchemaError
from polymerge_core.columns import NO_TIMESTAMP, Layer, read_columns
from polymerge_core.options import Options
from polymerge_core.schema import LocalMaps

LINE = LineString([(0, 0), (9, 0)])


def layer(source="monday", *, is_main=False, **columns):
    count = len(next(iter(columns.values()))) if columns else 1
    data = gpd.GeoDataFrame(columns, geometry=[LINE] * count)
    return Layer(LocalMaps(data, source=source), is_main=is_main)


def read(*layers, **options):
    return read_columns(layers, Options.of(**options))


def column(name, *layers, **options):
    return read(*layers, **options)[0][name].tolist()


def reasons(*layers, **options):
    return [None if pd.isna(reason) else reason for reason in column("reason", *layers, **options)]


class TestNames:
    def test_that_differ_in_case_only_are_found(self):
        features, attributes, _ = read(layer(Class=["a"], SCORE=[0.5]))
        assert features[["class", "score"]].to_numpy().tolist() == [["a", 0.5]]
        assert list(attributes) == []

    def test_that_are_exact_win(self):
        features, attributes, _ = read(layer(Class=["a"], **{"class": ["b"]}))
        assert features["class"].tolist() == ["b"]
        # The other one would clash in a GeoPackage, whose names do not know case.
        assert list(attributes) == []

    def test_of_which_several_differ_in_case_only_are_an_error(self):
        with pytest.raises(SchemaError, match="the columns Class, CLASS differ in case only; name one of them exactly"):
            read(layer(Class=["a"], CLASS=["b"]))

    def test_of_which_one_is_named_exactly_are_no_error(self):
        assert column("class", layer(Class=["a"], CLASS=["b"]), class_field="CLASS") == ["b"]

    def test_that_the_user_named_must_be_there(self):
        with pytest.raises(SchemaError, match="layer 'monday': there is no column 'kind'; the columns are a, b"):
            read(layer(a=[1], b=[2]), class_field="kind")

    def test_of_a_layer_without_columns_are_said_to_be_none(self):
        with pytest.raises(SchemaError, match="the columns are none"):
            read(layer(), class_field="kind")

    def test_of_the_geometry_is_no_column_of_the_contract(self):
        data = gpd.GeoDataFrame(geometry=[LINE]).rename_geometry("class")
        assert read(Layer(LocalMaps(data), is_main=False))[0]["class"].tolist() == ["line"]


class TestText:
    @pytest.mark.parametrize(
        ("values", "text"),
        [
            pytest.param(["a", "b"], ["a", "b"], id="text"),
            pytest.param([1, 2], ["1", "2"], id="integers"),
            pytest.param([1.0, 2.0], ["1", "2"], id="integers as floats"),
            pytest.param([1.5, 2.0], ["1.5", "2.0"], id="floats"),
            pytest.param(pd.array([2**60 + 1, 1], dtype="Int64"), [str(2**60 + 1), "1"], id="large integers"),
            pytest.param(pd.Categorical(["a", "b"]), ["a", "b"], id="categories"),
        ],
    )
    @pytest.mark.parametrize("name", ["class", "drive", "instance"])
    def test_of_any_type(self, name, values, text):
        assert column(name, layer(**{name: values})) == text

    def test_that_is_missing_is_the_source_for_a_drive(self):
        assert column("drive", layer(drive=["a", None])) == ["a", "monday"]

    @pytest.mark.parametrize("name", ["class", "instance"])
    def test_that_is_missing_leaves_the_feature_out(self, name):
        assert reasons(layer(**{name: ["a", None]})) == [None, f"no {name}"]


class TestScore:
    @pytest.mark.parametrize(
        ("values", "scores"),
        [
            pytest.param([0.25, 1], [0.25, 1.0], id="numbers"),
            pytest.param(["0.25", "1"], [0.25, 1.0], id="numbers as text"),
            pytest.param([True, False], [1.0, 0.0], id="true and false"),
            pytest.param(pd.array([1, 0], dtype="Int64"), [1.0, 0.0], id="nullable integers"),
        ],
    )
    def test_is_a_number(self, values, scores):
        assert column("score", layer(score=values)) == scores
        assert reasons(layer(score=values)) == [None, None]

    def test_is_1_without_a_column(self):
        assert column("score", layer(a=[1, 2])) == [1.0, 1.0]

    def test_at_min_score_is_kept(self):
        given = reasons(layer(score=[0.8, 0.7999]), min_score=0.8)
        assert given == [None, "the score is under min_score (0.8)"]

    @pytest.mark.parametrize("value", [None, np.nan, "high"])
    def test_that_is_no_number_leaves_the_feature_out(self, value):
        given = reasons(layer(score=pd.Series([0.5, value], dtype=object)))
        assert given == [None, "the score is not a number"]

    def test_of_a_main_map_is_1_where_it_is_missing_and_never_cut(self):
        main = layer(is_main=True, score=[0.1, None])
        assert column("score", main, min_score=0.5) == [0.1, 1.0]
        assert reasons(main, min_score=0.5) == [None, None]


class TestTimestamp:
    NOON = 1_714_564_800_000_000_000  # 2024-05-01T12:00:00Z

    @pytest.mark.parametrize(
        "values",
        [
            pytest.param([NOON], id="nanoseconds"),
            pytest.param(pd.array([NOON], dtype="Int64"), id="nullable nanoseconds"),
            pytest.param([str(NOON)], id="nanoseconds as text"),
            pytest.param(["2024-05-01T12:00:00Z"], id="text in UTC"),
            pytest.param(["2024-05-01T12:00:00"], id="text without a zone is UTC"),
            pytest.param(["2024-05-01T14:00:00+02:00"], id="text in another zone"),
            pytest.param(["2024-05-01 12:00:00.000"], id="text with a blank"),
            pytest.param(pd.to_datetime(["2024-05-01T12:00:00"]), id="dates"),
            pytest.param(pd.to_datetime(["2024-05-01T12:00:00"]).astype("datetime64[ms]"), id="dates in milliseconds"),
            pytest.param(pd.to_datetime(["2024-05-01T14:00:00+02:00"]), id="dates in another zone"),
        ],
    )
    def test_is_nanoseconds(self, values):
        assert column("timestamp_ns", layer(timestamp=values)) == [self.NOON]

    def test_of_nanoseconds_is_exact(self):
        values = [self.NOON + 1, self.NOON + 2]
        assert column("timestamp_ns", layer(timestamp=values)) == values

    def test_that_is_missing_comes_after_all(self):
        assert column("timestamp_ns", layer(timestamp=[5, None])) == [5, NO_TIMESTAMP]
        assert column("timestamp_ns", layer(timestamp=["2024-05-01T12:00:00Z", None])) == [self.NOON, NO_TIMESTAMP]
        assert column("timestamp_ns", layer(a=[1])) == [NO_TIMESTAMP]

    @pytest.mark.parametrize("values", [["noon"], [True], [1.5], ["2024-13-01"], [np.inf]])
    def test_that_is_none_is_an_error_that_names_the_layer_and_the_column(self, values):
        with pytest.raises(SchemaError, match=r"layer 'monday'.*stamp.*is not a timestamp"):
            read(layer(stamp=values), timestamp_field="stamp")


class TestNotes:
    def test_classes_that_differ_in_case_or_blanks_are_noted(self):
        notes = read(layer(**{"class": ["Kerb", "kerb ", "kerb", "line"]}))[2]
        assert notes["warnings"] == ["the classes 'Kerb', 'kerb', 'kerb ' are not merged with each other"]

    def test_empty_layer_beside_others_is_noted(self):
        empty = Layer(LocalMaps(gpd.GeoDataFrame(geometry=[]), source="tuesday"), is_main=False)
        assert read(layer(), empty)[2]["warnings"] == ["layer 'tuesday' holds no features"]

    def test_instance_rule_of_each_layer_is_noted_but_not_the_main_maps(self):
        main, first, second = layer("map", is_main=True), layer("a", instance=[1]), layer("b")
        assert read(main, first, second)[2]["instance_from"] == {"a": "column", "b": "layer"}

    def test_one_layer_beside_a_main_map_is_one_layer(self):
        assert read(layer("map", is_main=True), layer("a"))[2]["instance_from"] == {"a": "feature"}


def test_sigma_is_read_where_there_is_one():
    assert column("sigma", layer(sigma=[0.2, 0.4])) == [0.2, 0.4]
    assert np.isnan(column("sigma", layer(a=[1]))).all()


def test_users_columns_keep_the_order_of_the_layers():
    attributes = read(layer("a", z=[1], a=[2]), layer("b", b=[3], z=[4]))[1]
    assert list(attributes) == ["z", "a", "b"]
    assert attributes["z"].tolist() == [1, 4]
