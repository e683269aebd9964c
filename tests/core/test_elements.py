"""From merged shapes to the layer `elements`: the user's columns, and what `aggregate` does with them."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from shapely import LineString

from polymerge_core import OptionError, merge
from tests.core.methods import every_method

pytestmark = every_method

BIG = 2**53 + 1


def looks(count=3, **columns):
    """Draw looks at one line, the first instance first, and one line elsewhere behind them."""
    lines = [LineString([(0, 0.2 * k), (10, 0.2 * k)]) for k in range(count)]
    lines.append(LineString([(0, 50), (10, 50)]))
    return gpd.GeoDataFrame({"instance": range(count + 1), **columns}, geometry=lines)


def carried(layer, column, aggregate="first"):
    """Return the value of the three looks and the one of the line elsewhere."""
    elements = merge(layer, crs="local", aggregate=aggregate).elements
    assert elements["n_observations"].tolist() in ([3, 1], [1, 3])
    return elements.sort_values("n_observations", ascending=False)[column]


class TestAggregate:
    @pytest.mark.parametrize(
        ("function", "values"),
        [
            ("first", [5, 7]),
            ("mode", [2, 7]),
            ("mean", [3, 7]),
            ("min", [2, 7]),
            ("max", [5, 7]),
            ("sum", [9, 7]),
        ],
    )
    @pytest.mark.parametrize("dtype", ["int64", "float64", "int16", "Int64"])
    @pytest.mark.parametrize("by_name", [True, False], ids=["of the column", "of all columns"])
    def test_of_numbers(self, function, values, dtype, by_name):
        layer = looks(lanes=np.array([5, 2, 2, 7]).astype("int64"))
        layer["lanes"] = layer["lanes"].astype(dtype)
        result = carried(layer, "lanes", {"lanes": function} if by_name else function)
        assert result.tolist() == values
        assert result.dtype == ("float64" if "float" in dtype or function == "mean" else "int64")

    @pytest.mark.parametrize(
        ("function", "values"),
        [("first", ["c", "d"]), ("mode", ["b", "d"]), ("min", ["b", "d"]), ("max", ["c", "d"])],
    )
    def test_of_text(self, function, values):
        assert carried(looks(name=["c", "b", "b", "d"]), "name", {"name": function}).tolist() == values

    @pytest.mark.parametrize("function", ["mean", "sum", "min", "max"])
    def test_of_numbers_leaves_text_as_the_base_has_it(self, function):
        layer = looks(name=["c", "b", "b", "d"], lanes=[1, 2, 3, 4])
        assert carried(layer, "name", function).tolist() == ["c", "d"]

    @pytest.mark.parametrize("function", ["mean", "sum"])
    def test_of_text_named_is_an_error(self, function):
        with pytest.raises(OptionError, match=f"cannot take the {function} of 'name': the column holds no numbers"):
            carried(looks(name=list("abcd")), "name", {"name": function})

    def test_of_a_column_that_is_not_there_lists_the_columns(self):
        with pytest.raises(OptionError, match="'width', which is not there; the columns are name, lanes"):
            carried(looks(name=list("abcd"), lanes=[1, 2, 3, 4]), "name", {"width": "mean"})

    def test_of_each_column_its_own(self):
        layer = looks(width=[3.0, 4.0, 5.0, 9.0], lanes=[1, 2, 2, 4], name=list("abcd"))
        elements = merge(layer, crs="local", aggregate={"width": "mean", "lanes": "mode"}).elements
        assert elements.loc[elements["n_observations"] == 3, ["width", "lanes", "name"]].to_numpy().tolist() == [
            [4.0, 2, "a"]
        ]

    def test_as_frequent_values_give_the_smallest(self):
        assert carried(looks(lanes=[3, 10, 9, 7]), "lanes", "mode").tolist() == [3, 7]
        assert carried(looks(name=["c", "b", "a", "d"]), "name", "mode").tolist() == ["a", "d"]

    def test_passes_over_what_is_missing(self):
        layer = looks(width=[np.nan, 4.0, 6.0, np.nan], name=[None, "x", "x", None])
        assert carried(layer, "width", "mean").isna().tolist() == [False, True]
        assert carried(layer, "width", "mean").iloc[0] == 5.0
        assert carried(layer, "width", "sum").isna().tolist() == [False, True]
        assert carried(layer, "name", "mode").isna().tolist() == [False, True]

    def test_first_is_the_base_observations_even_where_it_is_missing(self):
        assert carried(looks(name=[None, "x", "x", "y"]), "name").isna().tolist() == [True, False]

    @pytest.mark.parametrize(("function", "value"), [("first", BIG), ("mode", BIG), ("min", BIG), ("max", BIG + 2)])
    def test_of_whole_numbers_beyond_floats_is_exact(self, function, value):
        layer = looks(id=pd.array([BIG, BIG, BIG + 2, None], dtype="Int64"))
        result = carried(layer, "id", function)
        assert result.iloc[0] == value
        assert result.isna().tolist() == [False, True]
        assert result.dtype == "Int64"

    def test_of_dates(self):
        days = pd.to_datetime(["2024-05-03", "2024-05-01", "2024-05-01", "2024-06-01"])
        for function, day in [("first", 3), ("mode", 1), ("min", 1), ("max", 3)]:
            assert carried(looks(seen=days), "seen", {"seen": function}).iloc[0] == pd.Timestamp(2024, 5, day)

    def test_of_true_and_false(self):
        layer = looks(flag=[True, False, False, True])
        assert carried(layer, "flag", "mode").tolist() == [False, True]
        assert carried(layer, "flag", "sum").tolist() == [1, 1]

    @pytest.mark.parametrize("function", ["first", "mode"])
    def test_of_lists_keeps_lists(self, function):
        layer = looks(tags=[[1], [1], [2], [3]])
        assert carried(layer, "tags", function).tolist() == [[1], [3]]

    def test_of_values_that_cannot_be_compared_is_an_error(self):
        layer = looks(tags=pd.Series([1, "a", [2], 3], dtype=object))
        with pytest.raises(OptionError, match="cannot take the max of 'tags': some of its values cannot be compared"):
            carried(layer, "tags", {"tags": "max"})

    def test_of_columns_with_numbers_as_names(self):
        layer = looks()
        layer[0] = [5, 2, 2, 7]
        assert carried(layer, 0, "mode").tolist() == [2, 7]


class TestColumnsOfSeveralLayers:
    def both(self, first, second, aggregate="first"):
        lines = [LineString([(0, 0.2 * k), (10, 0.2 * k)]) for k in range(2)]
        layers = [
            gpd.GeoDataFrame({"instance": [k], "drive": "d", **columns}, geometry=[line])
            for k, (line, columns) in enumerate(zip(lines, (first, second), strict=True))
        ]
        return merge(layers, crs="local", aggregate=aggregate)

    def test_are_the_union(self):
        (row,) = self.both({"a": ["x"]}, {"b": ["y"]}).elements[["a", "b"]].to_numpy()
        assert row[0] == "x"
        assert pd.isna(row[1])

    def test_of_different_types_become_text_and_it_is_said(self):
        result = self.both({"a": [7]}, {"a": ["x"]}, {"a": "max"})
        assert result.elements["a"].tolist() == ["x"]
        assert result.report["warnings"] == ["columns of different types became text: a"]

    @pytest.mark.parametrize("first", [7, 7.0], ids=["whole", "float"])
    def test_whole_numbers_become_text_without_a_decimal_point(self, first):
        assert self.both({"a": [first]}, {"a": ["x"]}).elements["a"].tolist() == ["7"]

    def test_whole_numbers_stay_exact_where_a_layer_lacks_the_column(self):
        result = self.both({"a": [BIG]}, {})
        assert result.elements["a"].tolist() == [BIG]
        assert result.elements["a"].dtype == "int64"

    def test_whole_numbers_and_floats_are_numbers(self):
        result = self.both({"a": [1]}, {"a": [2.5]}, "mean")
        assert result.elements["a"].tolist() == [1.75]
        assert result.report["warnings"] == []

    def test_that_the_merge_writes_are_not_carried(self):
        result = self.both({"length_m": [99.0], "Sigma_M": [1.0]}, {"n_observations": [5]})
        assert result.elements["length_m"].iloc[0] < 12
        assert result.elements["n_observations"].tolist() == [2]
        assert "Sigma_M" not in result.elements

    def test_that_were_understood_are_not_carried(self, method):
        elements = self.both({"score": [0.5], "timestamp": [1]}, {"score": [0.7], "timestamp": [2]}).elements
        assert list(elements) == [
            *("element_id", "class", "score", "n_observations", "n_instances", "length_m"),
            *(["sigma_m"] if method == "consensus" else []),
            "geometry",
        ]
