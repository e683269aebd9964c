"""Pictures: the right file, the same bytes, and pixels where the map has lines."""

from __future__ import annotations

import geopandas as gpd
import matplotlib as mpl
import numpy as np
import pytest
from geopandas.testing import assert_geodataframe_equal
from matplotlib.image import imread

from polymerge_core.errors import CrsError, InputError, OptionError, OutputError
from polymerge_core.figures import before_after

BLUE, ORANGE, GREEN = (0, 114, 178), (213, 94, 0), (0, 158, 115)


def layer(*features, crs="EPSG:32632"):
    classes, wkt = zip(*features, strict=True) if features else ([], [])
    return gpd.GeoDataFrame({"class": list(classes)}, geometry=gpd.GeoSeries.from_wkt(list(wkt)), crs=crs)


def pixels(path, colour, *, half=None, tolerance=30):
    """Count pixels near a colour in the picture or one half of it."""
    image = (imread(path)[..., :3] * 255).astype(int)
    middle = image.shape[1] // 2
    image = {"left": image[:, :middle], "right": image[:, middle:], None: image}[half]
    # The legend is at the bottom.
    image = image[: int(0.92 * image.shape[0])]
    return int((np.abs(image - colour).sum(axis=-1) < tolerance).sum())


OBSERVATIONS = layer(("divider", "LINESTRING (500000 5000000, 500040 5000001)"))
ELEMENTS = layer(("boundary", "LINESTRING (500000 5000010, 500040 5000012)"))


def test_picture_is_1600_pixels_wide_and_repeats_byte_for_byte(tmp_path):
    for name in ("a.png", "b.png"):
        before_after(OBSERVATIONS, ELEMENTS, tmp_path / name, reference=OBSERVATIONS, title="Junction")
    assert imread(tmp_path / "a.png").shape[1] == 1600
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_file_names_no_date_and_no_program(tmp_path):
    before_after(OBSERVATIONS, ELEMENTS, tmp_path / "a.png")
    content = (tmp_path / "a.png").read_bytes()
    assert b"tEXt" not in content
    assert b"tIME" not in content


def test_elements_are_drawn_on_the_right_only(tmp_path):
    before_after(OBSERVATIONS, ELEMENTS, tmp_path / "a.png")
    assert pixels(tmp_path / "a.png", GREEN, half="right") > 300
    assert pixels(tmp_path / "a.png", GREEN, half="left") == 0
    assert pixels(tmp_path / "a.png", ORANGE, half="right") == 0


def test_vertices_of_the_merged_map_are_marked(tmp_path):
    many = layer(("boundary", f"LINESTRING ({', '.join(f'{500000 + x} 5000010' for x in range(41))})"))
    two = layer(("boundary", "LINESTRING (500000 5000010, 500040 5000010)"))
    for name, elements in (("many.png", many), ("two.png", two)):
        before_after(OBSERVATIONS, elements, tmp_path / name)
    assert pixels(tmp_path / "many.png", GREEN) > pixels(tmp_path / "two.png", GREEN) + 100


def test_reference_is_drawn_in_grey_beneath_both(tmp_path):
    reference = layer(("divider", "LINESTRING (500000 5000005, 500040 5000005)"))
    for name, truth in (("with.png", reference), ("without.png", None)):
        before_after(OBSERVATIONS, ELEMENTS, tmp_path / name, reference=truth)
    for half in ("left", "right"):
        # A line between two rows of pixels comes out paler.
        drawn, bare = (
            pixels(tmp_path / name, (138, 138, 138), half=half, tolerance=150) for name in ("with.png", "without.png")
        )
        assert drawn > bare + 100


def test_polygons_are_drawn_by_their_rings(tmp_path):
    crossing = "POLYGON ((500005 5000002, 500015 5000002, 500015 5000008, 500005 5000008, 500005 5000002))"
    before_after(OBSERVATIONS, layer(("ped_crossing", crossing)), tmp_path / "a.png")
    assert pixels(tmp_path / "a.png", BLUE, half="right") > 200


def test_zoom_adds_a_second_row(tmp_path):
    before_after(OBSERVATIONS, ELEMENTS, tmp_path / "plain.png")
    before_after(OBSERVATIONS, ELEMENTS, tmp_path / "zoom.png", zoom=(500010.0, 4999995.0, 500030.0, 5000015.0))
    assert imread(tmp_path / "zoom.png").shape[0] > 1.5 * imread(tmp_path / "plain.png").shape[0]


def test_region_leaves_out_what_lies_beyond(tmp_path):
    before_after(OBSERVATIONS, ELEMENTS, tmp_path / "a.png", region=(500000.0, 4999990.0, 500040.0, 5000005.0))
    assert pixels(tmp_path / "a.png", GREEN, half="right") == 0


def test_layers_in_degrees_are_drawn_in_metres(tmp_path):
    # A square of 0.001 degrees at 60 N is twice as high as wide on the ground.
    square = "LINESTRING (9 60, 9.001 60, 9.001 60.001, 9 60.001, 9 60)"
    degrees = layer(("boundary", square), crs="EPSG:4326")
    before_after(degrees, degrees, tmp_path / "degrees.png", region=(9.0, 60.0, 9.001, 60.001))
    metric = degrees.to_crs(32632)
    before_after(metric, metric, tmp_path / "metric.png", region=tuple(metric.total_bounds))
    heights = [imread(tmp_path / name).shape[0] for name in ("degrees.png", "metric.png")]
    assert heights[0] == pytest.approx(heights[1], abs=10)
    assert heights[0] > 1200


@pytest.mark.parametrize(
    ("observations", "elements"),
    [(OBSERVATIONS, layer()), (layer(), ELEMENTS), (OBSERVATIONS.drop(columns="class"), ELEMENTS)],
    ids=["nothing merged", "no observations", "no class column"],
)
def test_missing_parts_are_no_obstacle(tmp_path, observations, elements):
    before_after(observations, elements, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 5000


def test_plain_metric_layers_without_a_crs_are_drawn(tmp_path):
    line = layer(("lane", "LINESTRING (0 0, 10 1)"), ("kerb", "LINESTRING (0 5, 10 5)"), crs=None)
    before_after(line, line, tmp_path / "a.png", zoom=(0.0, 0.0, 5.0, 5.0))
    assert (tmp_path / "a.png").exists()


def test_inputs_and_the_callers_matplotlib_are_left_alone(tmp_path):
    before, backend = OBSERVATIONS.copy(), mpl.rcParams["backend"]
    before_after(OBSERVATIONS, ELEMENTS, tmp_path / "a.png")
    assert_geodataframe_equal(before, OBSERVATIONS)
    assert mpl.rcParams["backend"] == backend


def test_nothing_at_all_to_draw_is_refused(tmp_path):
    with pytest.raises(InputError, match="nothing to draw"):
        before_after(layer(), layer(), tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["region", "zoom"])
def test_bounds_without_area_are_refused(tmp_path, name):
    with pytest.raises(OptionError, match=name):
        before_after(OBSERVATIONS, ELEMENTS, tmp_path / "a.png", **{name: (5.0, 0.0, 5.0, 1.0)})


def test_a_layer_without_a_crs_beside_one_with_is_refused(tmp_path):
    with pytest.raises(CrsError, match="declare the CRS"):
        before_after(OBSERVATIONS, ELEMENTS.set_crs(None, allow_override=True), tmp_path / "a.png")


def test_a_folder_that_is_not_there_is_named_and_nothing_is_left(tmp_path):
    with pytest.raises(OutputError, match="nowhere"):
        before_after(OBSERVATIONS, ELEMENTS, tmp_path / "nowhere" / "a.png")
    assert list(tmp_path.iterdir()) == []


def test_a_picture_that_cannot_be_moved_into_place_leaves_nothing_behind(tmp_path):
    (tmp_path / "a.png").mkdir()
    with pytest.raises(OutputError, match=r"a\.png"):
        before_after(OBSERVATIONS, ELEMENTS, tmp_path / "a.png")
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]
