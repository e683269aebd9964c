"""Options are checked before any work: the name, the value, what would do."""

from __future__ import annotations

import math

import pytest

from polymerge_core.errors import OptionError
from polymerge_core.options import Options


class TestDefaults:
    def test_are_those_of_the_table(self):
        options = Options.of()
        assert (options.proximity, options.coverage, options.min_score) == (1.0, 0.5, 0.0)
        assert (options.method, options.class_name, options.aggregate) == ("consensus", "line", "first")
        assert options.area == {"ped_crossing"}
        fields = ("class_field", "drive_field", "instance_field", "instance_from", "score_field", "timestamp_field")
        assert [getattr(options, name) for name in (*fields, "crs", "out_crs")] == [None] * 8
        assert options.strict is False


class TestArea:
    @pytest.mark.parametrize(
        ("given", "classes"),
        [
            (None, {"ped_crossing"}),
            ((), {"ped_crossing"}),
            ("island", {"ped_crossing", "island"}),
            (["island", "bay"], {"ped_crossing", "island", "bay"}),
        ],
        ids=["none", "empty", "one", "several"],
    )
    def test_adds_to_crossings(self, given, classes):
        assert Options.of(area=given).area == classes


class TestRefused:
    @pytest.mark.parametrize(
        ("name", "value"),
        [
            *[("proximity", value) for value in (0, -1, math.nan, math.inf, 1000.1, "1", None, True)],
            *[("coverage", value) for value in (0, -0.1, 1.01, math.nan, "0.5", None)],
            *[("min_score", value) for value in (-0.01, 1.01, math.nan, "0.8", None)],
        ],
    )
    def test_numbers_out_of_range_are(self, name, value):
        with pytest.raises(OptionError, match=f"^{name} cannot be .*; it is a number "):
            Options.of(**{name: value})

    @pytest.mark.parametrize(
        ("name", "value"), [("method", "magic"), ("instance_from", "row"), ("aggregate", "median")]
    )
    def test_words_that_are_no_choice_are(self, name, value):
        with pytest.raises(OptionError, match=f"^{name} cannot be '{value}'; it is one of "):
            Options.of(**{name: value})

    def test_aggregate_of_one_column_is_checked_too(self):
        with pytest.raises(OptionError, match="aggregate cannot be 'median'"):
            Options.of(aggregate={"lanes": "median"})

    def test_names_that_are_no_option_are_with_a_suggestion(self):
        with pytest.raises(OptionError, match="no option 'proximty'; did you mean proximity"):
            Options.of(proximty=1)

    def test_names_like_no_option_are_with_the_list(self):
        with pytest.raises(OptionError, match="no option 'zzz'; the options are class_field, class_name"):
            Options.of(zzz=1)


@pytest.mark.parametrize(
    ("name", "value"),
    [("proximity", 1000), ("proximity", 1e-6), ("coverage", 1), ("coverage", 1e-6), ("min_score", 0), ("min_score", 1)],
)
def test_bounds_are_allowed(name, value):
    assert getattr(Options.of(**{name: value}), name) == value
