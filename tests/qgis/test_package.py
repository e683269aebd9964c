"""The plugin's zip: what is in it, what the plugin site asks of it, and what its metadata, styles and icons say."""

from __future__ import annotations

import configparser
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import pytest

import polymerge_core
from polymerge_core import schema
from polymerge_core.evaluation.result import MEASURE_COLUMNS
from polymerge_core.figures import _COLOURS
from polymerge_core.store.tables import ELEMENT
from qgis_plugin import package

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]
STYLES = sorted((ROOT / "resources" / "styles").glob("*.qml"))
ICONS = sorted((ROOT / "resources" / "icons").glob("*.svg"))
LARGEST_UPLOAD = 25_000_000

#: The columns of the merged map, and what three of them are called in a Shapefile.
ELEMENTS = {*schema.ELEMENT_COLUMNS, "elem_id", "n_obs", "n_inst"}

#: The columns of evaluated elements.
EVALUATED = {"element_id", "class", "score", "length_m", "reference_id", "frechet_m", "iou", "beyond_share"}
EVALUATED |= {"lateral_median_m", "lateral_p95_m"}

#: The columns of a stored map, and of its changes.
STORED = {"element_id", *ELEMENT}
CHANGES = {*STORED, "kind", "revision", "moved_m"}

COLUMNS = {
    "local_maps": {"class", "drive", "instance", "score", "timestamp"},
    "instances": {"drive", "instance", "timestamp_ns", "x", "y", "heading", "n_observations"},
    "merged_map": ELEMENTS,
    "merged_areas": ELEMENTS,
    "network_observations": {"observation", "source", "source_fid", "drive", "instance", "class", "component"},
    "network_edges": {"from_observation", "to_observation", "class", "component", "distance_m"},
    "lineage": set(schema.LINEAGE_COLUMNS),
    "left_out": set(schema.LEFT_OUT_COLUMNS),
    "id_aliases": set(schema.ALIAS_COLUMNS),
    "evaluation_errors": {"element_id", "class", "error_m", "beyond"},
    "evaluated": EVALUATED,
    "evaluated_areas": EVALUATED,
    "measures": set(MEASURE_COLUMNS),
    "stored_map": STORED,
    "stored_map_areas": STORED,
    "changes": CHANGES,
    "changes_areas": CHANGES,
    "moves": {"element_id", "moved_m"},
}


@pytest.fixture(scope="module")
def plugin(tmp_path_factory) -> zipfile.ZipFile:
    path = tmp_path_factory.mktemp("zip") / "polymerge.zip"
    assert package.main(["-o", str(path)]) == 0
    with zipfile.ZipFile(path) as archive:
        yield archive


@pytest.fixture(scope="module")
def metadata(plugin) -> dict[str, str]:
    parser = configparser.ConfigParser()  # with interpolation, as QGIS and its site read it
    parser.optionxform = str
    parser.read_string(plugin.read("polymerge/metadata.txt").decode("utf-8"))
    return dict(parser["general"])


@pytest.fixture
def tree(tmp_path) -> Path:
    """A small tree that can be packed, and spoiled."""
    for name in (*package.FILES, *package.NEEDED):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    for folder, kinds in package.FOLDERS.items():
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        (tmp_path / folder / f"one{kinds[0]}").write_text(folder)
    return tmp_path


class TestContents:
    def test_all_lies_in_one_folder_whose_name_is_a_python_identifier(self, plugin):
        tops = {name.split("/")[0] for name in plugin.namelist()}
        assert tops == {"polymerge"}
        assert all(name.count("/") for name in plugin.namelist())
        assert plugin.testzip() is None

    @pytest.mark.parametrize(
        "name",
        [
            "__init__.py",
            "metadata.txt",
            "LICENSE",
            "README.md",
            "qgis_plugin/__init__.py",
            "qgis_plugin/requirements.txt",
            "polymerge_core/__main__.py",
            "polymerge_core/py.typed",
            "resources/sample/predictions.json",
            "resources/sample/poses.csv",
            "resources/sample/reference.gpkg",
        ],
    )
    def test_holds(self, plugin, name):
        assert plugin.namelist().count(f"polymerge/{name}") == 1

    def test_holds_every_source_and_resource_of_the_tree_but_the_packer(self, plugin):
        folders = [ROOT / name for name in ("polymerge_core", "qgis_plugin", "resources")]
        tree = {path for folder in folders for path in folder.rglob("*") if path.is_file()}
        leftovers = re.compile(r"__pycache__|/\.|\.pyc$|\.gpkg-|~$")
        wanted = {path.relative_to(ROOT).as_posix() for path in tree if not leftovers.search(path.as_posix())}
        packed = {name.removeprefix("polymerge/") for name in plugin.namelist()}
        assert packed - {"__init__.py", *package.FILES} == wanted - {"qgis_plugin/package.py"}

    def test_files_are_the_tree_s_byte_for_byte(self, plugin):
        for name in plugin.namelist():
            inside = name.removeprefix("polymerge/")
            if inside != "__init__.py":
                assert plugin.read(name) == (ROOT / inside).read_bytes()

    def test_has_nothing_that_the_site_refuses(self, plugin):
        refused = re.compile(r"\.\.|\.pyc|__pycache__|__MACOSX|/\.|\.(exe|dll|so|dylib|bat|sh|ps1|cmd)$", re.IGNORECASE)
        assert [name for name in plugin.namelist() if refused.search(name)] == []

    def test_is_far_smaller_than_the_site_s_limit(self, plugin):
        assert Path(plugin.filename).stat().st_size < LARGEST_UPLOAD / 10

    def test_no_file_is_executable_and_all_can_be_read(self, plugin):
        assert {entry.external_attr >> 16 for entry in plugin.infolist()} == {0o100644}

    def test_no_file_names_a_folder_of_the_machine_it_was_made_on(self, plugin):
        homes = [str(ROOT), str(Path.home())]
        texts = {name: plugin.read(name) for name in plugin.namelist()}
        assert [name for name, text in texts.items() if any(len(h) > 1 and h.encode() in text for h in homes)] == []

    def test_the_start_module_is_all_that_qgis_needs(self, plugin):
        source = plugin.read("polymerge/__init__.py").decode()
        assert "from .qgis_plugin import classFactory" in source
        compile(source, "__init__.py", "exec")

    def test_unpacked_it_can_be_imported_without_qgis(self, plugin, tmp_path):
        plugin.extractall(tmp_path)
        command = [sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import polymerge"]
        subprocess.run(command, check=True)

    def test_unpacked_it_runs_the_command_line_of_the_zip(self, plugin, tmp_path):
        plugin.extractall(tmp_path)
        folder = tmp_path / "polymerge"
        code = "import polymerge_core; print(polymerge_core.__file__)"
        found = subprocess.run(
            [sys.executable, "-c", code],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(folder)},
            check=True,
            capture_output=True,
            text=True,
        )
        assert Path(found.stdout.strip()).parent == folder / "polymerge_core"


class TestPacking:
    def test_the_same_tree_gives_the_same_bytes(self, tree, tmp_path):
        package.write(tmp_path / "a.zip", package.contents(tree))
        for path in sorted(tree.rglob("*.py"), reverse=True):
            os.utime(path, (1e9, 1e9))
            path.chmod(0o755)
        package.write(tmp_path / "b.zip", package.contents(tree))
        assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()

    @pytest.mark.parametrize(
        "name",
        [
            "polymerge_core/__pycache__/one.cpython-311.pyc",
            "polymerge_core/__pycache__/one.py",
            "polymerge_core/one.pyc",
            "polymerge_core/.hidden.py",
            "qgis_plugin/.idea/workspace.py",
            "qgis_plugin/package.py",
            "resources/sample/reference.gpkg-wal",
            "resources/sample/.poses.csv",
            "polymerge_core/one.py~",
        ],
    )
    def test_leaves_out(self, tree, name):
        before = package.contents(tree)
        (tree / name).parent.mkdir(exist_ok=True)
        (tree / name).write_text("of no use to others")
        assert package.contents(tree) == before

    @pytest.mark.parametrize("name", [*package.FILES, *package.NEEDED])
    def test_a_missing_file_is_named(self, tree, name):
        (tree / name).unlink()
        with pytest.raises(FileNotFoundError, match=rf"{re.escape(name)} is missing"):
            package.contents(tree)

    @pytest.mark.parametrize("folder", ["resources/icons", "resources/styles", "resources/sample"])
    def test_a_missing_folder_is_named(self, tree, folder):
        shutil.rmtree(tree / folder)
        with pytest.raises(FileNotFoundError, match=f"{folder} is missing or empty"):
            package.contents(tree)

    def test_what_goes_wrong_is_one_line_and_exit_1(self, tree, monkeypatch, capsys):
        (tree / "LICENSE").unlink()
        monkeypatch.setattr(package, "ROOT", tree)
        assert package.main(["-o", str(tree / "x.zip")]) == 1
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert "LICENSE is missing" in error
        assert not (tree / "x.zip").exists()

    def test_needs_the_standard_library_alone(self, tmp_path):
        command = [sys.executable, "-I", "-S", str(ROOT / "qgis_plugin" / "package.py"), "-o", str(tmp_path / "p.zip")]
        subprocess.run(command, check=True, capture_output=True)
        assert zipfile.is_zipfile(tmp_path / "p.zip")


class TestMetadata:
    @pytest.mark.parametrize(
        "field",
        [
            "name",
            "description",
            "version",
            "qgisMinimumVersion",
            "author",
            "email",
            "about",
            "tracker",
            "repository",
            "homepage",
            "license",
        ],
    )
    def test_says(self, metadata, field):
        assert metadata[field].strip()

    def test_version_is_the_core_s(self, metadata):
        assert metadata["version"] == polymerge_core.__version__

    def test_versions_of_qgis_reach_from_3_22_through_all_of_4(self, metadata):
        assert metadata["qgisMinimumVersion"] == "3.22"
        assert metadata["qgisMaximumVersion"] == "4.99"

    def test_qgis_process_is_told_that_there_is_a_provider(self, metadata):
        assert metadata["hasProcessingProvider"].lower() in {"yes", "true"}

    def test_description_is_one_line_and_nothing_is_html(self, metadata):
        assert "\n" not in metadata["description"]
        assert not re.search(r"<\w+|&\w+;", metadata["description"] + metadata["about"])

    def test_about_says_where_the_work_is_done_and_what_is_downloaded(self, metadata):
        assert "Set up PolyMerge" in metadata["about"]
        assert "Nothing is downloaded otherwise" in metadata["about"]

    def test_about_says_how_it_differs_from_plugins_alike(self, metadata):
        assert "differs from plugins alike" in metadata["about"]

    def test_name_and_author_keep_the_site_s_rules(self, metadata):
        assert "plugin" not in metadata["name"].lower()
        assert "/" not in metadata["author"]
        assert re.fullmatch(r"[^@\s]+@[^@\s]+\.\w+", metadata["email"])

    @pytest.mark.parametrize("field", ["tracker", "repository", "homepage"])
    def test_addresses_are_of_the_web(self, metadata, field):
        assert re.fullmatch(r"https://[\w.-]+/\S+", metadata[field])

    def test_category_and_tags_help_to_find_it(self, metadata):
        tags = metadata["tags"].split(",")
        assert metadata["category"] == "Vector"
        assert "processing" in tags
        assert "vector" not in tags
        assert all(tag == tag.strip() for tag in tags)

    def test_icon_is_in_the_zip(self, metadata, plugin):
        assert plugin.read(f"polymerge/{metadata['icon']}").startswith(b"<svg")

    def test_flags_are_booleans_as_the_site_reads_them(self, metadata):
        assert [metadata[flag] for flag in ("experimental", "deprecated", "server")] == ["True", "False", "False"]


def test_requirements_are_the_dependencies_of_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    required = (ROOT / "qgis_plugin" / "requirements.txt").read_text(encoding="utf-8").splitlines()
    assert required == project["dependencies"]


class TestIcons:
    def test_there_is_one_for_the_plugin_and_each_algorithm(self):
        names = ["changes", "evaluate", "merge", "network", "polymerge", "project", "setup", "undo", "update"]
        assert [path.stem for path in ICONS] == names

    @pytest.mark.parametrize("path", ICONS, ids=lambda path: path.stem)
    def test_is_a_small_plain_drawing(self, path):
        drawing = ET.parse(path).getroot()
        assert drawing.get("viewBox") == "0 0 24 24"
        tags = {element.tag.rpartition("}")[2] for element in drawing.iter()}
        assert tags <= {"svg", "title", "g", "path", "circle"}

    @pytest.mark.parametrize("path", ICONS, ids=lambda path: path.stem)
    def test_colours_stand_out_from_white_and_from_dark_themes(self, path):
        colours = set(re.findall(r"#[0-9a-f]{6}", path.read_text(encoding="utf-8")))
        assert colours
        for colour in colours:
            assert min(_contrast(colour, "#ffffff"), _contrast(colour, "#2b2b2b")) > 2.5


class TestStyles:
    def test_there_is_one_for_each_output(self):
        assert {path.stem for path in STYLES} == set(COLUMNS)

    @pytest.mark.parametrize("path", STYLES, ids=lambda path: path.stem)
    def test_every_column_has_a_readable_name(self, path):
        aliases = {alias.get("field"): alias.get("name") for alias in ET.parse(path).getroot().iter("alias")}
        assert set(aliases) == COLUMNS[path.stem]
        assert all(name[0].isupper() and "_" not in name for name in aliases.values())

    @pytest.mark.parametrize("path", STYLES, ids=lambda path: path.stem)
    def test_is_of_qgis_3_22_and_says_nothing_of_a_machine_or_a_layer(self, path):
        style = ET.parse(path).getroot()
        assert style.get("version").startswith("3.22")
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"/(home|root|tmp|work|Users)\b|[A-Z]:\\|file:|<id>|<datasource", text)

    @pytest.mark.parametrize("name", ["merged_map", "merged_areas"])
    def test_the_element_comes_first_in_the_attribute_table(self, name):
        style = ET.parse(ROOT / "resources" / "styles" / f"{name}.qml").getroot()
        columns = [column.get("name") for column in style.iter("column") if column.get("hidden") == "0"]
        assert columns == list(schema.ELEMENT_COLUMNS)

    @pytest.mark.parametrize("name", ["changes", "changes_areas"])
    def test_every_kind_of_change_is_drawn_in_a_colour_of_its_own(self, name):
        style = ET.parse(ROOT / "resources" / "styles" / f"{name}.qml").getroot()
        symbols = {symbol.get("name"): _colour(symbol) for symbol in style.iter("symbol")}
        drawn = {category.get("value"): symbols[category.get("symbol")] for category in style.iter("category")}
        assert set(drawn) == {"added", "moved", "changed", "retired", "merged"}
        assert len(set(drawn.values())) == len(drawn)

    @pytest.mark.parametrize("name", ["local_maps", "merged_map", "merged_areas", "stored_map", "stored_map_areas"])
    def test_classes_have_the_colours_of_the_pictures_and_any_other_class_is_drawn(self, name):
        style = ET.parse(ROOT / "resources" / "styles" / f"{name}.qml").getroot()
        symbols = {symbol.get("name"): _colour(symbol) for symbol in style.iter("symbol")}
        drawn = {category.get("value"): symbols[category.get("symbol")] for category in style.iter("category")}
        assert {value: colour for value, colour in drawn.items() if value} == {
            value: colour.lower() for value, colour in _COLOURS.items()
        }
        assert drawn[""] not in {drawn[value] for value in _COLOURS}
        assert style.find("renderer-v2").get("attr") == "class"


def _colour(symbol: ET.Element) -> str:
    options = {option.get("name"): option.get("value") for option in symbol.iter("Option")}
    stroke = options.get("line_color") or options["outline_color"]
    return "#" + "".join(f"{int(part):02x}" for part in stroke.split(",")[:3])


def _contrast(one: str, other: str) -> float:
    """Contrast ratio of two colours as the Web Content Accessibility Guidelines define it."""
    darker, lighter = sorted((_luminance(one), _luminance(other)))
    return (lighter + 0.05) / (darker + 0.05)


def _luminance(colour: str) -> float:
    channels = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    linear = [value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4 for value in channels]
    return sum(weight * value for weight, value in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
