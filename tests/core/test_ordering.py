"""The order of observations: by time, name and content, never by the place in a file."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import LineString, Polygon

from polymerge_core.ordering import canonical_order, natural_key, natural_rank

NO_TIMESTAMP = np.iinfo(np.int64).max


def line(y, length=10.0):
    return LineString([(0, y), (length, y)])


def parts(*shapes, **columns):
    """Build observations as `observe` does, each named by the column `name`."""
    count = len(shapes)
    defaults = {
        "name": list("abcdefghij"[:count]),
        "class": "line",
        "drive": "d",
        "instance": "1",
        "instance_kind": "column",
        "is_main": False,
        "timestamp_ns": NO_TIMESTAMP,
        "as_polygon": False,
        "score": 1.0,
        "main_id": -1,
        "weight": 1,
        "looks": 1,
        "from_m": 0.0,
    }
    table = pd.DataFrame({"feature": np.arange(count), **(defaults | columns)})
    table["shape"] = np.array(shapes, dtype=object)
    return table


def ordered(table, **attributes):
    attributes = pd.DataFrame(attributes, index=range(len(table)))
    return canonical_order(table, attributes)


def names(table, **attributes):
    return "".join(ordered(table, **attributes)[0]["name"])


def groups(table):
    result, _ = ordered(table)
    return dict(zip(result["name"], result["group"].tolist(), strict=True))


class TestNaturalKey:
    @pytest.mark.parametrize(
        ("first", "second"),
        [
            ("frame 9", "frame 10"),
            ("9", "10"),
            ("2024-9-30", "2024-10-1"),
            ("a2b10", "a10b2"),
            ("a", "b"),
            ("9", "a"),
            ("", "0"),
            ("frame", "frame 1"),
            ("frame", "frame1"),
            ("01", "1"),
            ("0", "1"),
            ("a007", "a8"),
            ("9" * 5000, "1" + "0" * 5000),
            ("1700000000000000000", "1700000000000000001"),
        ],
    )
    def test_puts_the_one_before_the_other(self, first, second):
        assert natural_key(first) < natural_key(second)

    @given(st.lists(st.text(max_size=8), min_size=2, max_size=6, unique=True))
    def test_tells_all_texts_apart(self, texts):
        keys = [natural_key(text) for text in texts]
        assert len(set(keys)) == len(texts)
        sorted(keys)  # any two can be compared

    @given(st.lists(st.text("0123456789\N{ARABIC-INDIC DIGIT THREE}a", max_size=4)))
    def test_ranks_many_texts(self, texts):
        names = sorted(set(texts), key=natural_key)
        assert natural_rank(pd.Series(texts, dtype=object)).tolist() == [names.index(text) for text in texts]

    def test_ranks_many_numbers(self):
        assert natural_rank(pd.Series(["10", "007", "9", "7", "10"])).tolist() == [3, 0, 2, 1, 3]


class TestInstances:
    def test_of_the_main_map_come_first(self):
        table = parts(line(0), line(1), is_main=[False, True], instance_kind=["column", "layer"])
        assert names(table) == "ba"
        assert groups(table) == {"b": -1, "a": 0}

    def test_go_by_name_naturally(self):
        assert names(parts(line(0), line(0), line(0), instance=["10", "9", "1"])) == "cba"

    def test_go_by_the_time_of_their_drive_then_drive_then_time_then_name(self):
        table = parts(
            *[line(k) for k in range(6)],
            drive=["z", "y", "y", "z", "x", "x"],
            timestamp_ns=[1, 2, 3, 9, 2, 2],
            instance=["1", "2", "1", "2", "20", "3"],
        )
        # Drive z starts first; x and y start together, and x comes before y; in x frame 3 before frame 20.
        assert names(table) == "adfebc"
        assert groups(table) == {"a": 0, "d": 1, "f": 2, "e": 3, "b": 4, "c": 5}

    def test_have_the_time_of_their_first_observation(self):
        table = parts(line(0), line(1), line(2), instance=["1", "2", "2"], timestamp_ns=[5, 9, 4])
        assert groups(table) == {"b": 0, "c": 0, "a": 1}

    @pytest.mark.parametrize("kind", ["layer", "feature"])
    def test_without_a_name_go_by_content(self, kind):
        table = parts(line(3), line(1), line(2), instance=["1", "2", "3"], instance_kind=kind)
        back = table.iloc[::-1].assign(instance=["1", "2", "3"])
        assert names(table) == names(back)

    def test_without_a_name_go_by_all_of_their_content(self):
        # Both layers hold the line at 0; the rest decides, and decides it for both of their lines.
        table = parts(line(0), line(1), line(0), line(2), instance=list("ppqq"), instance_kind="layer")
        table["name"] = list("pxqy")
        swapped = table.assign(instance=list("qqpp"))
        assert groups(table) == groups(swapped)
        assert groups(table)["p"] == groups(table)["x"]

    @pytest.mark.parametrize(
        ("column", "values"),
        [("class", "uuuv"), ("score", [1, 1, 1, 0.5]), ("as_polygon", [True, True, True, False]), ("note", "uuuv")],
        ids=["class", "score", "type of geometry", "a column of the user"],
    )
    def test_of_the_same_geometry_go_by_their_columns(self, column, values):
        table = parts(line(0), line(1), line(0), line(1), instance=list("ppqq"), instance_kind="layer")
        table[column] = list(values)
        note = table.get("note", table["class"])
        swapped = table.iloc[[2, 3, 0, 1]].reset_index(drop=True).assign(instance=list("ppqq"), feature=range(4))
        first, _ = ordered(table, note=note)
        second, _ = ordered(swapped, note=note.iloc[[2, 3, 0, 1]].to_numpy())
        # The first line of both layers is the same in everything; the second one tells them apart.
        assert (
            first.set_index("name")["group"][["b", "d"]].tolist()
            == second.set_index("name")["group"][["b", "d"]].tolist()
        )


class TestObservationsOfOneInstance:
    @settings(max_examples=20)
    @given(st.permutations(range(5)))
    def test_go_by_content_not_by_position(self, order):
        table = parts(*[line(y, length) for y, length in [(0, 1), (0, 2), (1, 1), (-1, 3), (0.1, 1)]])
        shuffled = table.iloc[list(order)].reset_index(drop=True)
        assert names(shuffled, note="") == names(table, note="")

    def test_of_the_same_geometry_go_by_class(self):
        table = parts(line(0), line(0), **{"class": ["b", "a"]})
        assert names(table) == "ba"

    def test_of_the_same_form_go_by_direction(self):
        table = parts(line(0), line(0).reverse(), instance=["1", "2"], instance_kind="feature")
        back = table.iloc[::-1].reset_index(drop=True)
        assert names(table) == names(back)

    def test_parts_of_one_feature_keep_their_intervals_in_order(self):
        table = parts(line(0), line(0), instance=["1", "1"], is_main=True, instance_kind="layer", from_m=[10.0, 0.0])
        assert ordered(table)[0]["from_m"].tolist() == [0.0, 10.0]


class TestDuplicates:
    def test_keep_one_and_list_the_other(self):
        table, duplicates = ordered(parts(line(0), line(0), line(1)))
        assert len(table) == 2
        assert duplicates["reason"].tolist() == ["duplicate"]
        assert sorted([*table["name"], *duplicates["name"]]) == ["a", "b", "c"]

    def test_may_run_the_other_way(self):
        _, duplicates = ordered(parts(line(0), line(0).reverse(), line(0)))
        assert len(duplicates) == 2

    def test_may_start_elsewhere_on_the_ring(self):
        ring = [(0, 0), (5, 0), (5, 5), (0, 5)]
        _, duplicates = ordered(parts(Polygon(ring), Polygon(ring[2:] + ring[:2])))
        assert len(duplicates) == 1

    @pytest.mark.parametrize("column", ["drive", "instance", "class"])
    def test_share_drive_instance_and_class(self, column):
        assert len(ordered(parts(line(0), line(0), **{column: ["1", "2"]}))[1]) == 0

    def test_are_none_in_the_main_map(self):
        assert len(ordered(parts(line(0), line(0), is_main=True, instance_kind="layer"))[1]) == 0

    def test_that_remains_does_not_depend_on_the_position(self):
        table = parts(line(0), line(0), score=[0.5, 0.7])
        back = table.iloc[::-1].reset_index(drop=True)
        assert ordered(table)[0]["score"].tolist() == ordered(back)[0]["score"].tolist()


def test_of_nothing_is_nothing():
    table, duplicates = ordered(parts())
    assert (len(table), len(duplicates)) == (0, 0)
    assert "group" in table
