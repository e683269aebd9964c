"""The parameters and the command line are one: the same options, defaults and choices; and how values get there."""

from __future__ import annotations

import json
import subprocess

import pytest
from qgis.core import (
    QgsApplication,
    QgsCoordinateReferenceSystem,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFeatureSink,
    QgsProcessingParameterNumber,
    QgsProperty,
)

from qgis_plugin.layout import ROOT
from qgis_plugin.parameters import AUTOMATIC, REPEATED, crs_text, is_known, option_arguments

COMMANDS = {
    "mergelocalmaps": "merge",
    "mergenetwork": "network",
    "projectlocalmaps": "project",
    "evaluatemap": "evaluate",
    "updatemap": "update",
    "mapchanges": "changes",
    "undoupdate": "undo",
}

#: Options that name files, which are checked or made before the command line is asked.
FILES = frozenset({"MAIN_MAP", "POSES", "REFERENCE", "REGION"})

#: What is of one side only, and why.
ONLY_IN_QGIS = {
    "LOCAL_MAPS": "the inputs; of an evaluation --local",
    "MAP": "the input, and the output of an update",
    "MERGED": "the input",
    "PAGE": "--output",
    "PREDICTIONS": "the input",
    "SELECTED_ONLY": "files have no selection",
    "INSTANCES": "a layer beside the local maps, in their file",
    "MAIN_MAP_AREAS": "a part of --main-map",
    "MAIN_MAP_ALIASES": "a part of --main-map",
    "LOCAL_CRS": "--crs=local",
    "REPORT": "--json",
}
ONLY_IN_THE_COMMAND_LINE = {
    "OUTPUT": "a file; a sink in QGIS",
    "LAYERS": "a file; sinks in QGIS",
    "LOCAL": "LOCAL_MAPS",
    "STREAM": "a program that sends local maps",
    "DRAW_EVERY": "of a stream",
    "PATIENCE": "of programs; the default is right for a person",
    "OVERWRITE": "the file is always new",
    "JSON": "REPORT",
    "PROGRESS": "always json",
    "WATCH_STDIN": "always",
    "HELP": "",
}

#: A CRS that has no number.
OWN_CRS = "+proj=tmerc +lat_0=51.3 +lon_0=9.7 +k=1 +x_0=1000 +y_0=2000 +ellps=GRS80 +units=m +no_defs"

ASK = """
import json, sys
import pyproj
from polymerge_core.__main__ import cli
from polymerge_core.crs import parse_crs
from polymerge_core.options import AGGREGATES, MAX_PROXIMITY_M
def of(p):
    plain = isinstance(p.default, (str, int, float, bool))
    return {"default": p.default if plain else None, "choices": list(getattr(p.type, "choices", [])),
            "flag": p.is_flag, "repeated": p.multiple, "required": p.required}
commands = {n: {p.opts[0].lstrip("-") if len(p.opts) == 1 else p.opts[-1].lstrip("-"): of(p)
                for p in c.params if p.param_type_name == "option"} for n, c in cli.commands.items()}
print(json.dumps({"commands": commands, "aggregates": AGGREGATES, "max_proximity": MAX_PROXIMITY_M,
                  "crs": [pyproj.CRS(parse_crs(each)).to_dict() for each in sys.argv[1:]]}))
"""

every = pytest.mark.parametrize("name", COMMANDS)

pytestmark = pytest.mark.usefixtures("provider")


@pytest.fixture(scope="module")
def core(interpreter):
    """What the command line knows, asked in the worker's Python; a CRS as it reads it."""
    own_crs = crs_text(QgsCoordinateReferenceSystem.fromProj(OWN_CRS))
    asked = subprocess.run(
        [interpreter, "-W", "ignore", "-c", ASK, own_crs], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return json.loads(asked.stdout)


@pytest.fixture
def options(core):
    """Return a function that gives the options of the command of an algorithm by the names of parameters."""

    def of(name):
        return {option.upper().replace("-", "_"): it for option, it in core["commands"][COMMANDS[name]].items()}

    return of


def algorithm(name):
    return QgsApplication.processingRegistry().algorithmById(f"polymerge:{name}")


def parameters_of(name):
    """Return what goes in: all but the sinks."""
    definitions = algorithm(name).parameterDefinitions()
    return {each.name(): each for each in definitions if not isinstance(each, QgsProcessingParameterFeatureSink)}


class TestTheSame:
    @every
    def test_options(self, options, name):
        assert set(parameters_of(name)) - set(ONLY_IN_QGIS) == set(options(name)) - set(ONLY_IN_THE_COMMAND_LINE)

    @every
    def test_each_reaches_the_command_line(self, name):
        assert set(algorithm(name).OPTIONS) == set(parameters_of(name)) - set(ONLY_IN_QGIS) - FILES

    def test_the_lists_of_what_differs_name_nothing_that_is_gone(self, options):
        in_qgis = {each for name in COMMANDS for each in parameters_of(name)}
        in_the_command_line = {each for name in COMMANDS for each in options(name)}
        assert set(ONLY_IN_QGIS) <= in_qgis
        assert set(ONLY_IN_THE_COMMAND_LINE) - {"HELP"} <= in_the_command_line

    @every
    def test_defaults(self, options, name):
        differ = {}
        for option, it in options(name).items():
            if option in ONLY_IN_THE_COMMAND_LINE or option in {"CRS", "OUT_CRS"}:
                continue
            ours, theirs = parameters_of(name)[option].defaultValue(), it["default"]
            automatic = ours == AUTOMATIC and theirs is None
            # The command line says in the text of its help that it carries the first where nothing is given.
            first = (option, ours, theirs) == ("AGGREGATE", "first", None)
            # Who runs it in QGIS has typed the name of a new map in a dialog that says so.
            made = option == "CREATE" and ours is True
            if (ours or None) != (theirs or None) and not automatic and not first and not made:
                differ[option] = (ours, theirs)
        assert not differ

    @every
    def test_choices(self, options, name):
        for option, it in options(name).items():
            if option in ONLY_IN_THE_COMMAND_LINE:
                continue
            definition = parameters_of(name)[option]
            ours = definition.options() if isinstance(definition, QgsProcessingParameterEnum) else []
            assert [each for each in ours if each != AUTOMATIC] == it["choices"], option

    @every
    def test_switches(self, options, name):
        theirs = {each for each, it in options(name).items() if it["flag"]} - set(ONLY_IN_THE_COMMAND_LINE)
        ours = {each for each, it in parameters_of(name).items() if it.type() == "boolean"} - set(ONLY_IN_QGIS)
        assert ours == theirs

    @every
    def test_repeated_options(self, options, name):
        theirs = {each for each, it in options(name).items() if it["repeated"]}
        theirs -= {*FILES, *ONLY_IN_THE_COMMAND_LINE}
        assert theirs == REPEATED & set(parameters_of(name))

    @every
    def test_numbers_have_the_bounds_of_the_core(self, core, name):
        bounds = {
            "PROXIMITY": (0, core["max_proximity"]),
            "MIN_SCORE": (0, 1),
            "COVERAGE": (0, 1),
            "SINCE": (0, 2**31 - 1),
            "REVISION": (1, 2**31 - 1),
            "UNTIL": (1, 2**31 - 1),
        }
        found = {
            each: (it.minimum(), it.maximum())
            for each, it in parameters_of(name).items()
            if isinstance(it, QgsProcessingParameterNumber)
        }
        assert found == {each: limits for each, limits in bounds.items() if each in found}

    def test_each_function_of_aggregate_is_explained(self, core):
        text = parameters_of("mergelocalmaps")["AGGREGATE"].help()
        assert all(function in text for function in core["aggregates"])

    def test_what_qgis_makes_of_its_defaults_is_taken_by_the_command_line(self, context, interpreter):
        code = (
            "import json, sys; from polymerge_core.__main__ import main; "
            "print(json.dumps([main(each) for each in json.loads(sys.argv[1])]))"
        )
        calls = []
        for name, command in COMMANDS.items():
            options = option_arguments(algorithm(name).OPTIONS, algorithm(name), {"CRS": "EPSG:32632"}, context)
            needed = {
                "project": ["--poses=/nowhere.csv"],
                "evaluate": ["--reference=/truth.gpkg"],
                "undo": ["--revision=1"],
            }
            target = [f"{each}=/nowhere.gpkg" for each in [algorithm(name).LAYERS_OPTION] if each]
            inputs = ["/nowhere.gpkg", "/nowhere.json"] if command == "update" else ["/nowhere.json"]
            calls.append([command, *options, *needed.get(command, []), *target, "--", *inputs])
        asked = [interpreter, "-c", code, json.dumps(calls)]
        done = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=True)
        assert json.loads(done.stdout) == [1] * len(COMMANDS), (
            done.stderr
        )  # 1: the file is not there; 2: an option is wrong
        assert done.stderr.count("/nowhere.json") == len(COMMANDS)


def arguments(context, names, name="mergelocalmaps", **given):
    """Return the arguments that some of the options become."""
    return option_arguments(names.split(), algorithm(name), given, context)


class TestArguments:
    @pytest.mark.parametrize(
        ("option", "value", "expected"),
        [
            ("PROXIMITY", 2.5, "--proximity=2.5"),
            ("PROXIMITY", 2, "--proximity=2.0"),
            ("MIN_SCORE", 1e-07, "--min-score=1e-07"),
            ("MIN_SCORE", 0.1, "--min-score=0.1"),
            ("COVERAGE", 1 / 3, "--coverage=0.3333333333333333"),
            ("CLASS_FIELD", "kind", "--class-field=kind"),
            ("CLASS_FIELD", "-- a=b", "--class-field=-- a=b"),
            ("CLASS_NAME", "-x", "--class-name=-x"),
            ("CLASS_NAME", "a, b", "--class-name=a, b"),
            ("CLASS_NAME", "Gehweg ü 線", "--class-name=Gehweg ü 線"),
            ("INSTANCE_FROM", "feature", "--instance-from=feature"),
            ("METHOD", "polymerge", "--method=polymerge"),
            ("STRICT", True, "--strict"),
            ("CRS", "EPSG:4326", "--crs=EPSG:4326"),
            ("OUT_CRS", QgsCoordinateReferenceSystem("EPSG:25832"), "--out-crs=EPSG:25832"),
            ("AREA", "island", "--area=island"),
            ("AGGREGATE", "mean", "--aggregate=mean"),
            ("PROXIMITY", QgsProperty.fromExpression("1 + 2"), "--proximity=3.0"),
        ],
        ids=str,
    )
    def test_become_one_word_each(self, context, option, value, expected):
        assert arguments(context, option, **{option: value}) == [expected]

    @pytest.mark.parametrize(
        ("option", "value"),
        [
            ("CLASS_FIELD", None),
            ("CLASS_FIELD", ""),
            ("SCORE_FIELD", ""),
            ("AREA", ""),
            ("AREA", " , ,"),
            ("CRS", None),
            ("OUT_CRS", QgsCoordinateReferenceSystem()),
            ("STRICT", False),
            ("INSTANCE_FROM", "auto"),
        ],
        ids=str,
    )
    def test_of_what_is_empty_there_are_none(self, context, option, value):
        assert arguments(context, option, **{option: value}) == []

    @pytest.mark.parametrize("option", ["LIDAR_TO_EGO", "ORIGIN", "POSE_OFFSET", "DRIVE"])
    def test_of_what_is_empty_there_are_none_in_projecting(self, context, option):
        assert arguments(context, option, name="projectlocalmaps", **{option: ""}) == []

    def test_of_projecting(self, context):
        given = {"LIDAR_TO_EGO": "/a b/m.json", "ORIGIN": "-42.3,71.2", "FOOTPRINT": "-1,-2,3,4", "POSE_KIND": "origin"}
        assert arguments(context, "ORIGIN LIDAR_TO_EGO POSE_KIND FOOTPRINT", name="projectlocalmaps", **given) == [
            "--origin=-42.3,71.2",
            "--lidar-to-ego=/a b/m.json",
            "--pose-kind=origin",
            "--footprint=-1,-2,3,4",
        ]

    def test_of_several_areas_and_functions_come_one_by_one(self, context):
        given = {"AREA": "island, bus stop ,-x", "AGGREGATE": "speed=mean,a=b=max"}
        assert arguments(context, "AREA AGGREGATE", **given) == [
            "--area=island",
            "--area=bus stop",
            "--area=-x",
            "--aggregate=speed=mean",
            "--aggregate=a=b=max",
        ]

    @pytest.mark.parametrize(("value", "expected"), [(None, []), (0.0, ["--proximity=0.0"]), (2, ["--proximity=2.0"])])
    def test_of_a_number_that_may_be_empty(self, context, value, expected):
        assert arguments(context, "PROXIMITY", name="updatemap", PROXIMITY=value) == expected

    def test_of_whole_numbers_are_whole(self, context):
        assert arguments(context, "SINCE", name="mapchanges", SINCE=3) == ["--since=3"]

    def test_keep_the_order_asked_for(self, context):
        assert arguments(context, "STRICT PROXIMITY", STRICT=True, PROXIMITY=1) == ["--strict", "--proximity=1.0"]

    @pytest.mark.parametrize("name", [each for each in COMMANDS if each not in ("mapchanges", "undoupdate")])
    def test_plain_metres_are_the_crs_local(self, context, name):
        assert arguments(context, "CRS", name=name, LOCAL_CRS=True) == ["--crs=local"]
        assert arguments(context, "CRS", name=name, LOCAL_CRS=False) == []

    def test_plain_metres_say_nothing_of_the_crs_of_the_result(self, context):
        assert arguments(context, "OUT_CRS", LOCAL_CRS=True, OUT_CRS="EPSG:25832") == ["--out-crs=EPSG:25832"]


class TestCrs:
    def test_of_the_user_s_own_making_goes_as_its_definition(self, context):
        crs = QgsCoordinateReferenceSystem.fromProj(OWN_CRS)
        (argument,) = arguments(context, "CRS", CRS=crs)
        assert argument.startswith(("--crs=BOUNDCRS[", "--crs=PROJCRS["))
        assert "51.3" in argument
        assert "\n" not in argument

    def test_saved_in_the_profile_goes_as_its_definition_since_nobody_else_knows_its_number(self):
        class Saved(QgsCoordinateReferenceSystem):
            def authid(self):
                return "USER:100001"

        assert crs_text(Saved(QgsCoordinateReferenceSystem.fromProj(OWN_CRS))).startswith(("PROJCRS[", "BOUNDCRS["))

    def test_definition_is_read_by_the_core_as_the_same_crs(self, core):
        assert (core["crs"][0]["lat_0"], core["crs"][0]["y_0"]) == (51.3, 2000)

    @pytest.mark.parametrize("code", ["EPSG:25832", "ESRI:54009", "OGC:CRS84", "IGNF:LAMB93"])
    def test_of_an_authority_goes_as_its_code(self, code):
        crs = QgsCoordinateReferenceSystem(code)
        assert crs.isValid()
        assert crs_text(crs) == code

    def test_that_is_none_is_empty(self):
        assert crs_text(QgsCoordinateReferenceSystem()) == ""

    def test_that_says_nothing_is_not_known(self):
        undefined = QgsCoordinateReferenceSystem.fromWkt(
            'ENGCRS["Undefined SRS",EDATUM[""],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
        )
        assert not is_known(undefined)
        assert not is_known(QgsCoordinateReferenceSystem())
        assert is_known(QgsCoordinateReferenceSystem("EPSG:4326"))
        assert is_known(QgsCoordinateReferenceSystem.fromProj(OWN_CRS))
