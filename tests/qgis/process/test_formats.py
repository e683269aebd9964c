"""Other formats than GeoPackage, and columns that a file format or a GIS treats in a way of its own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import shapely

from tests.cli.layers import draw, noisy_copies
from tests.qgis.process.comparing import assert_same_merge, command_line, destinations, schema, table
from tests.qgis.process.running import Qgis


@pytest.fixture(scope="module")
def roads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few looks at one road."""
    return draw(tmp_path_factory.mktemp("roads") / "roads.gpkg", noisy_copies(4, 8), name=["a", "b", "c", "d"])


@pytest.fixture(scope="module")
def shapefiles(qgis: Qgis, roads: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A merge as a Shapefile, written by QGIS and by the command line."""
    folder = tmp_path_factory.mktemp("shapefiles")
    command_line("merge", roads, "-o", folder / "expected.shp")
    return qgis.merge(roads, OUTPUT=folder / "merged.shp").results["OUTPUT"], folder / "expected.shp"


def test_a_shapefile_has_the_names_and_values_of_the_command_line(shapefiles: tuple[str, Path]) -> None:
    found, wanted = map(table, shapefiles)

    numbers = ["score", "n_obs", "n_inst", "length_m", "sigma_m"]
    assert list(found.columns) == ["elem_id", "class", *numbers, "name", "geometry"]
    assert found.drop(columns="geometry").to_dict("list") == wanted.drop(columns="geometry").to_dict("list")
    assert list(shapely.to_wkb(found.geometry)) == list(shapely.to_wkb(wanted.geometry))
    assert found.crs == wanted.crs


def test_ids_and_counts_in_a_shapefile_are_whole_numbers(shapefiles: tuple[str, Path]) -> None:
    found, wanted = map(schema, shapefiles)

    assert found["columns"] == wanted["columns"]


def test_geojson_and_csv_can_be_written(qgis: Qgis, roads: Path, tmp_path: Path) -> None:
    expected = tmp_path / "expected.gpkg"
    command_line("merge", roads, "-o", expected)

    done = qgis.merge(roads, OUTPUT=tmp_path / "merged.geojson", LINEAGE=tmp_path / "lineage.csv").results

    found, wanted = table(done["OUTPUT"]), table(expected, "elements")
    assert list(found.columns) == list(wanted.columns)
    assert list(found["element_id"]) == list(wanted["element_id"])
    assert found.crs is not None
    assert shapely.hausdorff_distance(found.to_crs(wanted.crs).geometry, wanted.geometry).max() < 1e-3
    assert len(table(done["LINEAGE"])) == len(table(expected, "lineage"))


@pytest.fixture(scope="module")
def odd_columns(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file whose columns bear names that GeoPackage uses itself, names that differ in case alone, and a list."""
    lines = shapely.get_coordinates(noisy_copies(3, 6)).reshape(3, -1, 2).tolist()
    features = [
        {
            "type": "Feature",
            "properties": {
                "fid": "twice",
                "geom": f"g{n}",
                "Name": f"upper {n}",
                "name": f"lower {n}",
                "ogc_fid": n,
                "tags": ["a", "b, c", str(n)],
                "deep": {"k": n},
            },
            "geometry": {"type": "LineString", "coordinates": vertices},
        }
        for n, vertices in enumerate(lines)
    ]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    path = tmp_path_factory.mktemp("odd") / "odd.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}), encoding="utf-8")
    return path


def test_columns_of_any_name_and_type_come_through(qgis: Qgis, odd_columns: Path, tmp_path: Path) -> None:
    expected = tmp_path / "expected.gpkg"
    command_line("merge", odd_columns, "-o", expected)

    done = qgis.merge(odd_columns, **destinations(tmp_path / "out")).results

    assert_same_merge(done, expected)
    (merged,) = table(done["OUTPUT"]).to_dict("records")
    assert merged["fid_1"] == "twice"  # GeoPackage has a column fid of its own
    assert (merged["Name"], merged["name_1"]) in {(f"upper {n}", f"lower {n}") for n in range(3)}
    assert json.loads(merged["tags"])[:2] == ["a", "b, c"]


def test_features_keep_the_ids_of_their_file_whatever_its_format(qgis: Qgis, roads: Path, tmp_path: Path) -> None:
    shapes = table(roads).geometry
    copies = [draw(tmp_path / f"in_{kind}.{kind}", shapes, number=range(4)) for kind in ("geojson", "fgb", "shp")]
    expected = tmp_path / "expected.gpkg"
    command_line("merge", *copies, "-o", expected)

    done = qgis.merge(*copies, **destinations(tmp_path / "out")).results

    assert_same_merge(done, expected)
    assert set(table(done["LINEAGE"])["source_fid"]) == {0, 1, 2, 3}


def test_a_column_called_id_is_carried_from_geojson_and_is_the_id_of_its_features(
    qgis: Qgis, roads: Path, tmp_path: Path
) -> None:
    path = draw(tmp_path / "roads.geojson", table(roads).geometry, id=range(10, 14))

    done = qgis.merge(path, **destinations(tmp_path / "out")).results

    assert table(done["OUTPUT"])["id"].isin(range(10, 14)).all()
    assert set(table(done["LINEAGE"])["source_fid"]) == {10, 11, 12, 13}
