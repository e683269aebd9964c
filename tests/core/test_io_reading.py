"""Files of others are read by what they hold, local maps by the layer contract."""

import json
import shutil
import sqlite3
import struct
from pathlib import Path

import numpy as np
import pandas as pd
import pyogrio
import pytest

from polymerge_core.crs import LOCAL_CRS
from polymerge_core.errors import CrsError, InputError
from polymerge_core.io import (
    LayerWarning,
    list_layers,
    local_maps,
    read_layers,
    read_local_maps,
    source_files,
    split_source,
    write_layers,
)
from tests.core.layers import BIG, LINES, SQUARE, UTM, layer, only


@pytest.fixture
def gpkg(tmp_path):
    path = tmp_path / "roads.gpkg"
    write_layers(path, {"roads": layer(a=[1, 2])})
    return path


def test_one_file_needs_no_list(gpkg):
    (by_text,), (by_path,), (by_list,) = (read_local_maps(given) for given in (str(gpkg), gpkg, [gpkg]))
    assert by_text.source == by_path.source == by_list.source
    assert len(by_text.observations) == len(by_list.observations) == 2


# -- reading what others wrote


@pytest.mark.parametrize("extension", ["gpkg", "geojson", "fgb", "parquet"])
def test_files_are_known_by_their_content(tmp_path, extension):
    write_layers(tmp_path / f"a.{extension}", {"a": layer()})
    disguised = tmp_path / "a.dat"
    shutil.copy(tmp_path / f"a.{extension}", disguised)
    assert len(only(disguised)) == 2


@pytest.mark.parametrize("name", ["mit Leerzeichen ü ö.gpkg", "x" * 120 + ".gpkg", "100%20 #?.gpkg", "a|b.gpkg"])
@pytest.mark.parametrize("folder", [".", "tiefer/ordner mit ä" + "/lang" * 30], ids=["short", "long"])
def test_unusual_paths_work(tmp_path, name, folder):
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    path = tmp_path / folder / name
    write_layers(path, {"roads": layer()})
    assert len(only(path)) == 2
    assert len(only(f"{path}|layername=roads")) == 2


@pytest.mark.parametrize(
    ("text", "file", "name"),
    [
        ("a.gpkg", "a.gpkg", None),
        ("a.gpkg|layername=roads", "a.gpkg", "roads"),
        ("a.gpkg|LayerName=x|y", "a.gpkg", "x|y"),
        ("../a b.gpkg|layername=a=b", "../a b.gpkg", "a=b"),
        ("a|b.gpkg", "a|b.gpkg", None),
    ],
)
def test_a_source_is_split_as_qgis_writes_it(text, file, name):
    assert split_source(text) == (Path(file), name)


@pytest.mark.parametrize("option", ["subset=a=1", "layerid=0", "geometrytype=Polygon", "layername="])
def test_a_source_that_selects_features_is_refused(option):
    with pytest.raises(InputError, match=r"only \|layername=LAYER may follow"):
        split_source(f"a.gpkg|{option}")


@pytest.mark.parametrize(
    "source",
    ["/vsicurl/http://x/a.gpkg", "http://x/a.gpkg", "https://x/a", "s3://b/a.gpkg", "/vsizip/a.zip/a.shp"],
)
def test_remote_sources_are_refused(source):
    with pytest.raises(InputError, match="is not a file on this computer"):
        read_layers(source)


def set_geometry(path, wkb, fid=1):
    """Put any WKB in a GeoPackage, as another program would."""
    with sqlite3.connect(path) as database:
        blob = database.execute("SELECT geom FROM roads").fetchone()[0]
        envelope = {0: 0, 1: 32, 2: 48, 3: 48, 4: 64}[(blob[3] >> 1) & 7]
        for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            database.execute(f'DROP TRIGGER "{name}"')
        database.execute("UPDATE roads SET geom = ? WHERE fid = ?", (blob[: 8 + envelope] + wkb, fid))
    database.close()


ARC = struct.pack("<BII6d", 1, 8, 3, 0, 0, 1, 1, 2, 0)


def test_curves_become_lines_and_integers_stay_exact(tmp_path):
    path = tmp_path / "roads.gpkg"
    write_layers(path, {"roads": layer(a=pd.array([BIG, None], dtype="Int64"))})
    set_geometry(path, ARC)
    back = only(path)
    assert back.geom_type.tolist() == ["LineString", "LineString"]
    assert back.geometry.iloc[0].length == pytest.approx(np.pi, rel=1e-3)
    assert back.a.tolist() == [BIG, pd.NA]


@pytest.mark.parametrize(
    "wkb",
    [struct.pack("<BIIBII6d", 1, 7, 1, 1, 8, 3, 0, 0, 1, 1, 2, 0), struct.pack("<BIIdd", 1, 2, 1, 0, 0)],
    ids=["curve in a collection", "line of one vertex"],
)
def test_a_geometry_that_cannot_be_decoded_is_none_with_a_warning(gpkg, wkb):
    set_geometry(gpkg, wkb)
    with pytest.warns(LayerWarning, match="layer roads"):
        back = only(gpkg)
    assert back.geometry.isna().tolist() == [True, False]


def test_a_flatgeobuf_feature_without_geometry_does_not_crash_the_reader(tmp_path):
    frame = layer([LINES[0], None], a=[1, 2])
    pyogrio.write_dataframe(frame, tmp_path / "a.fgb", SPATIAL_INDEX="NO", use_arrow=False)
    back = only(tmp_path / "a.fgb")
    assert back.geometry.isna().tolist() == [False, True]
    assert back.a.tolist() == [1, 2]


def test_an_attribute_called_geometry_is_kept_under_another_name(tmp_path):
    (tmp_path / "a.geojson").write_text(
        '{"type":"FeatureCollection","features":[{"type":"Feature","properties":{"geometry":"abc","fid":7},'
        '"geometry":{"type":"LineString","coordinates":[[0,0],[1,1]]}}]}'
    )
    back = only(tmp_path / "a.geojson")
    assert back.geometry_1.tolist() == ["abc"]
    assert back.fid.tolist() == [7]
    assert back.geom_type.tolist() == ["LineString"]


def test_a_shapefile_in_an_old_encoding_is_read(tmp_path):
    frame = layer(LINES[:1], name=["Straße"])
    pyogrio.write_dataframe(frame, tmp_path / "a.shp", encoding="ISO-8859-1")
    (tmp_path / "a.cpg").unlink()
    assert only(tmp_path / "a.shp").name.tolist() == ["Straße"]


def test_geoparquet_with_its_own_index_and_geometry_name(tmp_path):
    frame = layer(a=[1, 2]).rename_geometry("shape").set_index("a")
    frame.to_parquet(tmp_path / "a.parquet")
    back = only(tmp_path / "a.parquet")
    assert back.geometry.name == "geometry"
    assert back.a.tolist() == [1, 2]
    assert back.index.tolist() == [0, 1]


def test_a_geopackage_of_undefined_geographic_crs_has_none(gpkg):
    with sqlite3.connect(gpkg) as database:
        database.execute("UPDATE gpkg_geometry_columns SET srs_id = 0")
        database.execute("UPDATE gpkg_contents SET srs_id = 0")
    database.close()
    assert only(gpkg).crs is None


def test_plain_coordinates_in_feet_are_refused(tmp_path):
    feet = LOCAL_CRS.to_wkt().replace('"metre",1', '"foot",0.3048').replace("Undefined Cartesian SRS", "Site grid")
    write_layers(tmp_path / "a.parquet", {"a": layer(crs=feet)})
    with pytest.raises(CrsError, match="plain coordinates are in foot"):
        read_layers(tmp_path / "a.parquet")


# -- local maps


def test_the_contract_says_which_layers_are_meant(tmp_path):
    footprint = layer([SQUARE], n_observations=[0])
    left_out = pd.DataFrame({"reason": ["zero length"]})
    write_layers(
        tmp_path / "a.gpkg",
        {
            "local_maps": layer(),
            "instances": footprint,
            "left_out": left_out,
            "elements": layer(),
            "x": layer(),
        },
    )
    (maps,) = read_local_maps([tmp_path / "a.gpkg"])
    assert maps.source == "a"
    assert len(maps.observations) == 2
    assert maps.instances.n_observations.tolist() == [0]
    assert maps.left_out.reason.tolist() == ["zero length"]
    (named,) = read_local_maps([f"{tmp_path / 'a.gpkg'}|layername=x"])
    assert named.instances is None
    assert named.left_out is None


def test_a_merged_map_means_its_lines_and_areas(tmp_path):
    areas = layer([SQUARE])
    write_layers(tmp_path / "m.gpkg", {"x": layer(), "elements": layer(), "elements_areas": areas})
    maps = read_local_maps([tmp_path / "m.gpkg"])
    assert [(each.source, len(each.observations)) for each in maps] == [
        ("elements", 2),
        ("elements_areas", 1),
    ]


def test_any_other_file_means_all_its_lines_and_polygons(tmp_path):
    write_layers(
        tmp_path / "a.gpkg",
        {"n": layer(), "s": layer(), "t": pd.DataFrame({"a": [1]}), "p": layer(["POINT (0 0)"])},
    )
    with pytest.warns(LayerWarning, match="layer p holds points"):
        assert [each.source for each in read_local_maps([tmp_path / "a.gpkg"])] == ["n", "s"]


def test_sources_are_named_by_the_shortest_end_of_their_paths(tmp_path):
    files = ["one/track.shp", "two/track.shp", "two/other.shp", "x/two/track.shp"]
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        write_layers(tmp_path / file, {"a": layer()})
    names = [maps.source for maps in read_local_maps(tmp_path / file for file in [*files, files[0]])]
    assert names == ["one/track", f"{tmp_path.name}/two/track", "other", "x/two/track", "one/track"]


def test_the_order_of_the_files_does_not_change_their_names(tmp_path):
    keys = [(tmp_path / folder / f"t.{ext}", "l") for folder in "ab" for ext in ("gpkg", "shp")]
    names = dict(zip(keys, local_maps._source_names(keys), strict=True))
    assert sorted(names.values()) == ["a/t.gpkg", "a/t.shp", "b/t.gpkg", "b/t.shp"]
    assert dict(zip(keys[::-1], local_maps._source_names(keys[::-1]), strict=True)) == names


def test_layers_of_the_same_name_in_two_files_are_told_apart(tmp_path):
    keys = [(tmp_path / file, name) for file in ("a.gpkg", "b.gpkg") for name in ("dividers", "boundaries")]
    assert local_maps._source_names(keys) == ["a/dividers", "a/boundaries", "b/dividers", "b/boundaries"]


# -- what was written beside a file of one layer

ONE_LAYER = ["shp", "geojson", "fgb", "parquet"]


def local(**changes):
    """Local maps as `project` gives them: two observations of one drive, of which one instance saw nothing."""
    instances = layer([SQUARE, SQUARE], drive=["d", "d"], instance=["0", "1"], timestamp_ns=[5, 6])
    instances = instances.assign(x=[0.0, 1.0], y=0.0, heading=0.0, n_observations=[2, 0])
    left_out = pd.DataFrame({"source": ["s"], "source_fid": [7], "reason": ["zero length"]})
    layers = {"local_maps": layer(drive=["d", "d"], instance=["0", "0"]), "instances": instances, "left_out": left_out}
    return layers | changes


def merged(**changes):
    """A merged map of lines and areas."""
    return {"elements": layer(element_id=[1, 2]), "elements_areas": layer([SQUARE], element_id=[3])} | changes


@pytest.mark.parametrize("named", [False, True], ids=["file", "file and layer"])
@pytest.mark.parametrize("extension", ["gpkg", *ONE_LAYER])
def test_local_maps_come_back_with_their_instances_and_what_was_left_out(tmp_path, extension, named):
    path = tmp_path / f"drive.{extension}"
    write_layers(path, local())
    (info, *_) = list_layers(path)
    (maps,) = read_local_maps([f"{path}|layername={info.name}" if named else path])
    assert maps.source == "drive"
    assert len(maps.observations) == 2
    expected = local()["instances"].drop(columns="geometry")
    back = maps.instances.sort_values("instance")[expected.columns].reset_index(drop=True)
    pd.testing.assert_frame_equal(back, expected, check_dtype=False)
    assert maps.instances.crs == UTM
    assert maps.left_out.reason.tolist() == ["zero length"]
    assert maps.report()["empty_instances"] == 1


def test_local_maps_without_a_table_have_nothing_left_out(tmp_path):
    layers = local()
    del layers["left_out"]
    write_layers(tmp_path / "a.fgb", layers)
    (maps,) = read_local_maps([tmp_path / "a.fgb"])
    assert len(maps.instances) == 2
    assert maps.left_out is None
    write_layers(tmp_path / "a_tables.gpkg", {"lineage": pd.DataFrame({"weight": [1.0]})})
    assert read_local_maps([tmp_path / "a.fgb"])[0].left_out is None


@pytest.mark.parametrize(
    "changes",
    [{"instances": layer([SQUARE], height=[3.0])}, {"local_maps": layer(name=["a", "b"])}],
    ids=["the file beside it holds something else", "the file is no local map"],
)
def test_files_of_the_same_naming_that_are_no_instances_are_left_alone(tmp_path, changes):
    write_layers(tmp_path / "town.shp", local(**changes))
    (maps,) = read_local_maps([tmp_path / "town.shp"])
    assert maps.instances is None
    assert maps.left_out is None


@pytest.mark.parametrize("extension", ONE_LAYER)
def test_a_merged_map_of_two_files_means_its_lines_and_areas(tmp_path, extension):
    path, areas = tmp_path / f"m.{extension}", tmp_path / f"m_areas.{extension}"
    write_layers(path, merged(left_out=pd.DataFrame({"reason": ["too short"]})))
    maps = read_local_maps([path])
    assert [(each.source, each.observations.geom_type.tolist()) for each in maps] == [
        ("m", ["LineString", "LineString"]),
        ("m_areas", ["Polygon"]),
    ]
    assert [each.left_out for each in maps] == [None, None]
    assert [each.source for each in read_local_maps([path, areas])] == ["m", "m_areas"]
    (name,) = [info.name for info in list_layers(path)]
    assert [each.source for each in read_local_maps([f"{path}|layername={name}"])] == ["m"]


@pytest.mark.parametrize(
    "changes",
    [
        {"elements": layer(name=["a", "b"])},
        {"elements_areas": layer([SQUARE], name=["a"])},
        {"elements_areas": layer([SQUARE], element_id=[3]).iloc[:0]},
    ],
    ids=["the file is no merged map", "the areas are of something else", "there are no areas"],
)
def test_files_of_the_same_naming_that_are_no_areas_are_left_alone(tmp_path, changes):
    write_layers(tmp_path / "m.shp", merged(**changes))
    assert [each.source for each in read_local_maps([tmp_path / "m.shp"])] == ["m"]


def test_areas_that_cannot_be_read_are_not_passed_over(tmp_path):
    write_layers(tmp_path / "m.shp", merged())
    (tmp_path / "m_areas.dbf").unlink()
    with pytest.raises(InputError, match=r"m_areas\.dbf is missing"):
        read_local_maps([tmp_path / "m.shp"])


def test_a_name_that_leaves_no_room_for_another_beside_it_is_read(tmp_path):
    path = tmp_path / ("x" * 247 + ".parquet")
    layer().to_parquet(path)
    assert len(read_local_maps([path])[0].observations) == 2


def test_source_files_are_all_that_is_read(tmp_path):
    write_layers(tmp_path / "drive.shp", local())
    write_layers(tmp_path / "m.shp", merged(lineage=pd.DataFrame({"weight": [1.0]})))
    write_layers(tmp_path / "m.gpkg", merged())

    def names(source):
        return [path.name for path in source_files(tmp_path / source)]

    assert names("drive.shp") == ["drive.shp", "drive_instances.shp", "drive_tables.gpkg"]
    assert names("m.shp") == ["m.shp", "m_areas.shp"]
    assert names("m.shp|layername=m") == ["m.shp"]
    assert names("m.gpkg") == ["m.gpkg"]
    assert names("predictions.json") == ["predictions.json"]


def test_a_geojson_keeps_its_column_id_and_takes_feature_ids_from_it(tmp_path):
    features = [
        {
            "type": "Feature",
            "properties": {"name": name, "id": number},
            "geometry": {"type": "LineString", "coordinates": line},
        }
        for name, number, line in (("a", 5, [[7, 50], [8, 50]]), ("b", 9, [[7, 51], [8, 51]]))
    ]
    file = tmp_path / "roads.geojson"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    (roads,) = read_layers(file).values()
    assert roads.index.tolist() == [5, 9]
    assert list(roads.columns) == ["name", "id", "geometry"]
    assert roads["id"].tolist() == [5, 9]
