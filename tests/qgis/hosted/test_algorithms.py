"""What every algorithm says of itself, and what it refuses before anything runs."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from qgis.core import (
    QgsApplication,
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransformContext,
    QgsFields,
    QgsProcessingAlgorithm,
    QgsProcessingException,
    QgsProcessingFeatureSourceDefinition,
    QgsProcessingOutputLayerDefinition,
    QgsProcessingOutputNumber,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterFeatureSink,
    QgsProperty,
    QgsVectorFileWriter,
    QgsVectorLayer,
    QgsWkbTypes,
)

from qgis_plugin import environment
from qgis_plugin.layout import ROOT, metadata, style_path

from .layers import EAST, NORTH, file_layer, memory_layer, track

IDS = (
    "setup",
    "projectlocalmaps",
    "mergelocalmaps",
    "mergenetwork",
    "evaluatemap",
    "updatemap",
    "mapchanges",
    "undoupdate",
)
WORKERS = IDS[1:]
MERGERS = IDS[2:4]

pytestmark = pytest.mark.usefixtures("provider")

every = pytest.mark.parametrize("name", IDS)
merging = pytest.mark.parametrize("name", MERGERS)


def algorithm(name: str) -> QgsProcessingAlgorithm:
    return QgsApplication.processingRegistry().algorithmById(f"polymerge:{name}")


class TestEvery:
    @every
    def test_is_created_afresh(self, name):
        fresh = algorithm(name).create()
        assert type(fresh) is type(algorithm(name))
        assert fresh is not algorithm(name)
        assert fresh.id() == f"polymerge:{name}"
        assert [each.name() for each in fresh.parameterDefinitions()] == [
            each.name() for each in algorithm(name).parameterDefinitions()
        ]

    @every
    def test_id_is_lower_case_letters(self, name):
        assert re.fullmatch("[a-z]+", algorithm(name).name())

    @every
    def test_runs_in_the_background_and_can_be_cancelled_and_is_no_secret(self, name):
        flags, kinds = algorithm(name).flags(), QgsProcessingAlgorithm.Flag
        assert flags & kinds.FlagCanCancel
        for unwanted in (
            kinds.FlagNoThreading,
            kinds.FlagHideFromToolbox,
            kinds.FlagHideFromModeler,
            kinds.FlagDeprecated,
        ):
            assert not flags & unwanted

    @every
    def test_has_a_title_a_group_and_a_tooltip(self, name):
        it = algorithm(name)
        assert it.displayName()[0].isupper()
        assert it.group()
        assert re.fullmatch("[a-z-]+", it.groupId())
        assert it.shortDescription().endswith(".")

    @every
    def test_is_found_by_its_tags(self, name):
        tags = algorithm(name).tags()
        assert len(tags) >= 5
        assert all(tag and tag == tag.strip() for tag in tags)
        assert len(set(tags)) == len(tags)

    @every
    def test_each_parameter_has_a_title_and_help_that_is_a_sentence(self, name):
        for each in algorithm(name).parameterDefinitions():
            assert each.description(), each.name()
            assert each.help().endswith("."), each.name()
            assert re.fullmatch("[A-Z_]+", each.name())

    @every
    def test_titles_of_parameters_differ(self, name):
        titles = [each.description() for each in algorithm(name).parameterDefinitions()]
        assert sorted(set(titles)) == sorted(titles)

    @every
    def test_help_tells_what_it_does_and_explains_every_parameter(self, name):
        text = algorithm(name).shortHelpString()
        assert algorithm(name).shortDescription() in text
        for each in algorithm(name).parameterDefinitions():
            assert f"<b>{each.description()}</b>: {each.help()}" in text

    @every
    def test_each_output_has_a_title(self, name):
        assert algorithm(name).outputDefinitions()
        for each in algorithm(name).outputDefinitions():
            assert each.description(), each.name()

    @every
    def test_help_page_is_a_page_of_the_project(self, name):
        url = algorithm(name).helpUrl()
        home = metadata("homepage")
        assert url.startswith(f"{home}/blob/main/")
        assert (ROOT / url.removeprefix(f"{home}/blob/main/")).is_file()

    @every
    def test_icon_is_a_drawing_that_can_be_drawn(self, name):
        path = Path(algorithm(name).svgIconPath())
        assert ET.parse(path).getroot().tag.endswith("svg")
        assert not algorithm(name).icon().pixmap(24, 24).isNull()

    def test_icons_differ(self):
        assert len({algorithm(name).svgIconPath() for name in IDS}) == len(IDS)

    @every
    def test_only_the_rare_parameters_are_advanced(self, name):
        advanced = QgsProcessingParameterDefinition.Flag.FlagAdvanced
        plain = {each.name() for each in algorithm(name).parameterDefinitions() if not each.flags() & advanced}
        layers = {"LOCAL_MAPS", "SELECTED_ONLY", "PROXIMITY", "MAIN_MAP", "CLASS_FIELD", "OUTPUT"}
        files = {"PREDICTIONS", "POSES", "LIDAR_TO_EGO"}
        compared = {"MERGED", "REFERENCE", "LOCAL_MAPS", "REGION", "CLASS_FIELD"}
        wanted = {
            "setup": {"PYTHON", "USE_AS_IS", "WHEELS", "CHECK_ONLY"},
            "projectlocalmaps": files | {"CRS", "POSE_KIND", "OUTPUT", "INSTANCES", "LEFT_OUT"},
            "mergelocalmaps": layers | {"INSTANCES", "AREAS", "LINEAGE", "LEFT_OUT", "ID_ALIASES"},
            "mergenetwork": layers | {"EDGES"},
            "evaluatemap": compared | {"OUTPUT", "EVALUATED", "EVALUATED_AREAS", "MEASURES", "PAGE"},
            "updatemap": {"MAP", "LOCAL_MAPS", "SELECTED_ONLY", "INSTANCES", "CREATE", "CLASS_FIELD"},
            "mapchanges": {"MAP", "SINCE", "CHANGES", "CHANGES_AREAS", "MOVES"},
            "undoupdate": {"MAP", "REVISION"},
        }
        assert plain == wanted[name]


class TestOutputs:
    @pytest.mark.parametrize(
        ("name", "numbers"),
        [
            ("projectlocalmaps", {"N_OBSERVATIONS", "N_INSTANCES", "N_LEFT_OUT"}),
            ("mergelocalmaps", {"N_ELEMENTS", "N_OBSERVATIONS", "N_LEFT_OUT"}),
            ("mergenetwork", {"N_COMPONENTS", "N_OBSERVATIONS", "LARGEST_COMPONENT"}),
            ("evaluatemap", {"AVERAGE_PRECISION", "N_ELEMENTS", "N_REFERENCE"}),
            ("updatemap", {"REVISION", "ELEMENTS", "SKIPPED", "ADDED", "CHANGED", "MOVED", "RETIRED", "MERGED"}),
            ("mapchanges", {"ADDED", "CHANGED", "MOVED", "RETIRED", "MERGED"}),
            ("undoupdate", {"NEW_REVISION", "ELEMENTS", "ADDED", "CHANGED", "MOVED", "RETIRED", "MERGED"}),
        ],
    )
    def test_numbers_are_there_for_models(self, name, numbers):
        outputs = algorithm(name).outputDefinitions()
        assert {each.name() for each in outputs if isinstance(each, QgsProcessingOutputNumber)} == numbers

    @pytest.mark.parametrize("name", WORKERS)
    def test_only_the_first_layer_is_a_must(self, name):
        optional = QgsProcessingParameterDefinition.Flag.FlagOptional
        sinks = [
            each
            for each in algorithm(name).parameterDefinitions()
            if isinstance(each, QgsProcessingParameterFeatureSink)
        ]
        first = {"updatemap": [], "undoupdate": [], "mapchanges": ["CHANGES"]}.get(name, ["OUTPUT"])
        assert [each.name() for each in sinks if not each.flags() & optional] == first
        assert all(each.createByDefault() for each in sinks)

    @pytest.mark.parametrize("name", WORKERS)
    def test_each_layer_has_a_style(self, name):
        for result in algorithm(name).results():
            assert Path(style_path(result.style)).is_file(), result.parameter


class TestWithoutAnEnvironment:
    @pytest.mark.parametrize("name", WORKERS)
    def test_the_toolbox_is_told_what_to_do(self, name):
        assert algorithm(name).canExecute() == (
            False,
            "PolyMerge has no Python environment yet: run “Set up PolyMerge” in the Processing toolbox.",
        )

    @merging
    def test_a_run_says_the_same(self, run, name):
        with pytest.raises(QgsProcessingException, match="run “Set up PolyMerge” in the Processing toolbox"):
            run(name, LOCAL_MAPS=[memory_layer([track()])], OUTPUT="memory:")

    @pytest.mark.parametrize("name", WORKERS)
    def test_with_one_they_can_run(self, name, script):
        environment.use_interpreter(script("exit 0"))
        assert algorithm(name).canExecute() == (True, "")


def check(name, context, **parameters):
    """Return what is wrong with parameters; empty where nothing is."""
    fine, message = algorithm(name).checkParameterValues({"OUTPUT": "memory:", **parameters}, context)
    assert fine == (not message)
    return message


class TestFaultsOfLayers:
    @merging
    def test_lines_areas_and_their_multiples_are_fine(self, name, context):
        square = f"POLYGON(({EAST} {NORTH}, {EAST + 5} {NORTH}, {EAST} {NORTH + 5}, {EAST} {NORTH}))"
        given = [
            memory_layer([track()]),
            memory_layer([square], kind="Polygon"),
            memory_layer([track()], kind="MultiLineStringZM"),
            memory_layer([track()], kind="CompoundCurve"),
        ]
        assert check(name, context, LOCAL_MAPS=given) == ""

    @merging
    @pytest.mark.parametrize("kind", ["Point", "MultiPointZ"])
    def test_points_are_told_with_the_layer_s_name(self, name, context, kind):
        points = memory_layer([], kind=kind, name="my points")
        message = check(name, context, LOCAL_MAPS=[memory_layer([track()]), points])
        assert message == "Layer “my points” holds points: choose layers of lines or polygons."

    @merging
    def test_a_table_is_told(self, name, context):
        given = memory_layer([None], kind="None", name="list")
        assert "“list” is a table without geometry" in check(name, context, LOCAL_MAPS=[given])

    @merging
    def test_a_layer_without_crs_is_told_with_the_ways_out_of_it(self, name, context):
        message = check(name, context, LOCAL_MAPS=[memory_layer([track()], name="lost", crs="")])
        assert message.startswith("Layer “lost” has no CRS: ")
        assert "CRS" in message
        assert "LOCAL_CRS" in message

    @merging
    def test_each_way_out_of_it_is_enough(self, name, context):
        given = [memory_layer([track()], crs="")]
        assert check(name, context, LOCAL_MAPS=given, CRS="EPSG:32632") == ""
        assert check(name, context, LOCAL_MAPS=given, LOCAL_CRS=True) == ""

    @merging
    def test_both_ways_at_once_are_too_many(self, name, context):
        message = check(name, context, LOCAL_MAPS=[memory_layer([track()])], CRS="EPSG:32632", LOCAL_CRS=True)
        assert "give CRS or LOCAL_CRS, not both" in message

    @merging
    @pytest.mark.parametrize("part", ["MAIN_MAP_AREAS", "MAIN_MAP_ALIASES"])
    def test_parts_of_a_main_map_need_the_main_map(self, name, context, part):
        given = memory_layer([], kind="Polygon" if part.endswith("AREAS") else "None")
        message = check(name, context, LOCAL_MAPS=[memory_layer([track()])], **{part: given})
        assert "no main map: choose it too" in message

    @merging
    def test_a_main_map_without_crs_is_told(self, name, context):
        main = memory_layer([track()], name="old map", crs="")
        assert "“old map” has no CRS" in check(name, context, LOCAL_MAPS=[memory_layer([track()])], MAIN_MAP=main)

    @merging
    def test_a_file_that_cannot_be_opened_is_told_by_the_run_itself_since_models_do_not_ask(self, run, name):
        with pytest.raises(QgsProcessingException, match="cannot be opened"):
            run(name, LOCAL_MAPS=[memory_layer([track()]), "/nowhere/at/all.gpkg"], OUTPUT="memory:")

    @merging
    def test_points_are_told_by_the_run_itself(self, run, name):
        with pytest.raises(QgsProcessingException, match="holds points"):
            run(name, LOCAL_MAPS=[memory_layer([], kind="Point")], OUTPUT="memory:")

    def test_a_main_map_of_which_only_the_selection_is_asked_for_is_not_left_away(self, run, ready, context):
        main = memory_layer([track()], name="main map")
        context.project().addMapLayer(main, False)
        with pytest.raises(QgsProcessingException):
            run(
                "mergelocalmaps",
                LOCAL_MAPS=[memory_layer([track()])],
                MAIN_MAP=QgsProcessingFeatureSourceDefinition(main.id(), True),
                OUTPUT="memory:",
            )

    @pytest.mark.parametrize("part", ["MAIN_MAP", "MAIN_MAP_AREAS", "MAIN_MAP_ALIASES"])
    def test_a_main_map_that_cannot_be_opened_is_not_merged_without(self, run, ready, part):
        given = {"MAIN_MAP": memory_layer([track()]), part: "/nowhere/at/all.gpkg"}
        with pytest.raises(QgsProcessingException, match=r"cannot be opened|Could not load"):
            run("mergelocalmaps", LOCAL_MAPS=[memory_layer([track()])], OUTPUT="memory:", **given)

    def test_footprints_that_name_no_local_maps_are_refused(self, context):
        given = memory_layer([], kind="Polygon", name="boxes")
        message = check("mergelocalmaps", context, LOCAL_MAPS=[memory_layer([track()])], INSTANCES=given)
        assert message == "Layer “boxes” is none of footprints, which has the columns drive and instance."

    def test_footprints_that_cannot_be_opened_are_not_merged_without(self, run, ready):
        with pytest.raises(QgsProcessingException, match=r"cannot be opened|Could not load"):
            run(
                "mergelocalmaps",
                LOCAL_MAPS=[memory_layer([track()])],
                INSTANCES="/nowhere/at/all.gpkg",
                OUTPUT="memory:",
            )

    @merging
    def test_no_layer_is_refused(self, name, context):
        assert check(name, context, LOCAL_MAPS=[]) != ""

    @merging
    @pytest.mark.parametrize("value", ["consensus", "0", "Column"])
    def test_a_choice_that_does_not_exist_is_refused(self, name, context, value):
        assert "INSTANCE_FROM" in check(name, context, LOCAL_MAPS=[memory_layer([track()])], INSTANCE_FROM=value)

    @merging
    @pytest.mark.parametrize(
        ("option", "value"), [("PROXIMITY", -1), ("PROXIMITY", 1000.5), ("MIN_SCORE", 1.1), ("MIN_SCORE", -0.1)]
    )
    def test_a_number_out_of_bounds_is_refused(self, name, context, option, value):
        assert option in check(name, context, LOCAL_MAPS=[memory_layer([track()])], **{option: value})


class TestOutputsThatWouldOverwrite:
    @pytest.fixture
    def file(self, tmp_path):
        return file_layer(memory_layer([track()]), tmp_path / "tracks.gpkg")

    @pytest.fixture
    def path(self, file):
        return file.source().split("|")[0]

    @merging
    def test_a_layer_that_is_read_are_refused(self, name, context, file, path):
        message = check(name, context, LOCAL_MAPS=[file], OUTPUT=path)
        assert message.endswith(" would overwrite a file that is read, tracks.gpkg: choose another file.")

    def test_it_by_another_spelling_are_refused(self, context, file, path):
        spelled = str(Path(path).parent / "." / ".." / Path(path).parent.name / "tracks.gpkg")
        assert "would overwrite" in check("mergelocalmaps", context, LOCAL_MAPS=[file], OUTPUT=spelled)

    def test_it_from_the_toolbox_are_refused(self, context, file, path):
        wanted = QgsProcessingOutputLayerDefinition(path, context.project())
        assert "would overwrite" in check("mergelocalmaps", context, LOCAL_MAPS=[file], LINEAGE=wanted)

    def test_the_main_map_are_refused(self, context, file, path):
        assert "would overwrite" in check(
            "mergelocalmaps", context, LOCAL_MAPS=[memory_layer([track()])], MAIN_MAP=file, OUTPUT=path
        )

    def test_a_table_of_text_that_is_read_are_refused(self, context, tmp_path):
        text = tmp_path / "tracks.csv"
        text.write_text(f'name;shape\none;"{track()}"\n')
        layer = QgsVectorLayer(f"file://{text}?delimiter=;&wktField=shape&crs=EPSG:32632", "text", "delimitedtext")
        assert layer.isValid()
        assert "would overwrite" in check("mergelocalmaps", context, LOCAL_MAPS=[layer], LINEAGE=str(text))

    def test_each_other_are_refused(self, context, tmp_path):
        message = check(
            "mergelocalmaps",
            context,
            LOCAL_MAPS=[memory_layer([track()])],
            OUTPUT=str(tmp_path / "map.gpkg"),
            LINEAGE=str(tmp_path / "map.gpkg"),
        )
        assert message == "Lineage would overwrite the output Merged map, map.gpkg: choose another file."

    def test_a_table_in_the_file_of_a_layer_is_refused_where_it_is_that_layer_only(self, context, file, path):
        table = "ogr:dbname='{}' table=\"{}\" (geom)"
        same = table.format(path, file.name())
        assert "Merged map would overwrite" in check("mergelocalmaps", context, LOCAL_MAPS=[file], OUTPUT=same)
        assert check("mergelocalmaps", context, LOCAL_MAPS=[file], OUTPUT=table.format(path, "merged")) == ""

    def test_an_expression_is_looked_through(self, context, file, path):
        same = QgsProperty.fromExpression(f"'{path}'")
        assert "Merged map would overwrite" in check("mergelocalmaps", context, LOCAL_MAPS=[file], OUTPUT=same)

    def test_a_folder_that_is_not_there_is_told_before_the_work(self, context, tmp_path):
        missing = str(tmp_path / "no" / "map.gpkg")
        told = check("mergelocalmaps", context, LOCAL_MAPS=[memory_layer([track()])], OUTPUT=missing)
        assert told == (f"Merged map cannot be written to {missing}: there is no such folder. Choose another folder.")

    def test_the_predictions_are_refused(self, context):
        given = {"PREDICTIONS": "/data/p.json", "POSES": "/data/p.csv", "CRS": "EPSG:32632"}
        assert "Report would overwrite" in check("projectlocalmaps", context, **given, REPORT="/data/p.json")
        assert check("projectlocalmaps", context, **given, REPORT="/r.json") == ""

    def test_are_told_by_the_run_itself_and_nothing_is_lost(self, run, file, path):
        before = Path(path).read_bytes()
        with pytest.raises(QgsProcessingException, match="would overwrite"):
            run("mergelocalmaps", LOCAL_MAPS=[file], OUTPUT=path)
        assert Path(path).read_bytes() == before

    def test_nothing_are_fine(self, context, file, path):
        other = f"ogr:dbname='{path}' table=\"merged\" (geom)"
        for name, sinks in (("new tables", {"OUTPUT": other}), ("memory", {"OUTPUT": "memory:", "LINEAGE": "memory:"})):
            assert check("mergelocalmaps", context, LOCAL_MAPS=[file], **sinks) == "", name


class TestLayersWithoutFeatures:
    def test_of_a_file_that_allows_any_geometry_is_no_table_and_has_its_crs(self, context, tmp_path):
        options = QgsVectorFileWriter.SaveVectorOptions()
        options.driverName = "GPKG"
        crs = QgsCoordinateReferenceSystem("EPSG:32632")
        file = str(tmp_path / "any.gpkg")
        writer = QgsVectorFileWriter.create(
            file, QgsFields(), QgsWkbTypes.Type.Unknown, crs, QgsCoordinateTransformContext(), options
        )
        del writer  # closes the file
        layer = QgsVectorLayer(file, "any", "ogr")
        assert layer.isValid()
        assert check("mergelocalmaps", context, LOCAL_MAPS=[layer]) == ""


FILES = {"PREDICTIONS": "/p.json", "POSES": "/p.csv"}


class TestFaultsOfProjecting:
    def test_needs_a_crs_or_the_word_that_there_is_none(self, context):
        message = check("projectlocalmaps", context, **FILES)
        assert message.startswith("Choose a CRS of the result, or tick “Plain metres without a CRS”")
        assert check("projectlocalmaps", context, **FILES, CRS="EPSG:32617") == ""
        assert check("projectlocalmaps", context, **FILES, LOCAL_CRS=True) == ""

    def test_refuses_both(self, context):
        message = check("projectlocalmaps", context, **FILES, CRS="EPSG:32617", LOCAL_CRS=True)
        assert "one of the two, not both" in message

    def test_needs_the_files(self, context):
        assert "PREDICTIONS" in check("projectlocalmaps", context, POSES="/p.csv", CRS="EPSG:32617")
        assert "POSES" in check("projectlocalmaps", context, PREDICTIONS="/p.json", CRS="EPSG:32617")


class TestWhatProcessingPassesOver:
    """Values that QGIS itself would ignore without a word."""

    def test_an_unknown_crs(self, context):
        told = check("mergelocalmaps", context, LOCAL_MAPS=[memory_layer([track()])], OUT_CRS="garbage")
        assert told == "CRS of the result (OUT_CRS) cannot be garbage: QGIS knows no such CRS."

    def test_but_a_crs_that_is_not_chosen_is_none(self, context):
        none = QgsCoordinateReferenceSystem()
        assert check("mergelocalmaps", context, LOCAL_MAPS=[memory_layer([track()])], OUT_CRS=none) == ""

    def test_a_misspelled_parameter(self, ready, run, feedback):
        run("mergelocalmaps", LOCAL_MAPS=[memory_layer([track()])], OUTPUT="memory:", PROXIMTY=15)
        assert "There is no parameter PROXIMTY, so it is not used." in feedback.warnings

    def test_a_table_of_something_else_as_retired_ids(self, context):
        layer = memory_layer([track()])
        told = check("mergelocalmaps", context, LOCAL_MAPS=[layer], MAIN_MAP=layer, MAIN_MAP_ALIASES=layer)
        assert "is no table of retired ids" in told

    def test_numbers_out_of_range_are_told_the_range(self, context):
        told = check("mergelocalmaps", context, LOCAL_MAPS=[memory_layer([track()])], PROXIMITY=-5)
        assert told == "Proximity (PROXIMITY) cannot be -5. It is a number from 0 to 1000."
