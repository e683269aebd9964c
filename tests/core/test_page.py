"""The page of an evaluation: what stands on it, that it needs nothing from elsewhere, and that it repeats."""

from __future__ import annotations

import base64
import html
import re

import geopandas as gpd
import numpy as np
import pytest
from shapely import LineString, box

import polymerge_core as pm
from polymerge_core.evaluation.page import describe, render_page
from polymerge_core.evaluation.pictures import BINS


def layer(*points, cls="divider", **columns):
    shapes = [LineString(each) for each in points]
    return gpd.GeoDataFrame({"class": [cls] * len(shapes), **columns}, geometry=shapes)


TRUTH = layer([(0, 0), (100, 0)], [(0, 20), (100, 20)])
DRAWN = layer([(0, 0.2), (40, 0.2)], [(50, 0.7), (90, 0.7)], [(0, 60), (30, 60)], score=[0.9, 0.8, 0.3])
LOOKS = layer([(0, 0.4), (40, 0.1)], [(50, 0.9), (90, 0.5)])


def page(merged=DRAWN, reference=TRUTH, **options):
    return render_page(pm.evaluate(merged, reference, crs="local", **options))


def text_of(source):
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", source)))


def test_every_measure_stands_on_the_page_with_its_figure():
    result = pm.evaluate(DRAWN, TRUTH, local_maps=LOOKS, pcm=True, crs="local")
    text = text_of(render_page(result))
    for row in result.table[result.table["class"] == "divider"].itertuples():
        _, name, meaning = describe(row.measure)
        assert f"{name}{', ' + row.unit if row.unit else ''} {meaning}" in text
        if not np.isnan(row.value):
            assert f"{row.value:.3f}" in text
    assert f"mAP {result.value('all', 'ap'):.3f}" in text


def test_every_measure_is_described():
    table = pm.evaluate(DRAWN, TRUTH, local_maps=LOOKS, pcm=True, crs="local").table
    areas = gpd.GeoDataFrame({"class": ["ped_crossing"]}, geometry=[box(0, 0, 4, 4)])
    measures = {*table["measure"], *pm.evaluate(areas, areas, crs="local").table["measure"]}
    assert all(describe(measure)[2] for measure in measures)


def test_nothing_is_asked_from_elsewhere():
    source = page(local_maps=LOOKS)
    assert "default-src 'none'" in source
    assert "<script" not in source
    assert not re.search(r"(?:src|href)=\"(?!data:)", source)
    assert "url(" not in source


def test_pictures_are_pngs_that_say_what_they_show():
    source = page(local_maps=LOOKS)
    pictures = re.findall(r'<img[^>]*src="data:image/png;base64,([^"]+)" alt="([^"]+)"', source)
    assert len(pictures) == 3
    assert all(base64.b64decode(data).startswith(b"\x89PNG") for data, _ in pictures)
    assert "2 observations before, 3 elements after, over 2 reference elements" in pictures[0][1]
    assert "30 m have no reference within 1.5 m" in pictures[1][1]
    assert "median 0.450 m, 95 % below 0.700 m" in pictures[2][1]


def test_the_histogram_stands_there_as_numbers():
    result = pm.evaluate(DRAWN, TRUTH, crs="local")
    counts, _ = np.histogram(result.lateral["error_m"], BINS)
    rows = re.findall(r"<td>([\d.]+) to ([\d.]+)</td><td>(\d+)</td>", render_page(result))
    assert [int(count) for _, _, count in rows] == counts[counts > 0].tolist()
    assert [float(low) for low, _, _ in rows] == pytest.approx(BINS[:-1][counts > 0], abs=0.005)


def test_the_same_evaluation_gives_the_same_page():
    assert page(local_maps=LOOKS) == page(local_maps=LOOKS)


def test_names_are_text_and_not_markup():
    name = "<b>\"kerb\" & 'co'"
    source = page(layer([(0, 0.2), (40, 0.2)], cls=name), layer([(0, 0), (50, 0)], cls=name))
    assert name not in source
    assert name in html.unescape(source)


def test_the_worst_elements_come_first():
    text = text_of(page()).split("The worst elements")[1]
    rows = re.findall(r"([012]) divider", text)
    assert rows == ["2", "1", "0"]


@pytest.mark.parametrize(
    ("merged", "reference"),
    [
        pytest.param(DRAWN.iloc[:0], TRUTH, id="an empty map"),
        pytest.param(layer([(0, 0), (9, 0)], cls="kerb"), TRUTH, id="no class in common"),
        pytest.param(layer([(0, 500), (9, 500)]), TRUTH, id="nothing near"),
        pytest.param(layer([(0, 0), (0, 9)]), layer([(0, 0), (0, 9)]), id="a map without width"),
    ],
)
def test_maps_with_little_to_show(merged, reference):
    source = page(merged, reference)
    assert "divider" in source
    assert "nan" not in text_of(source).lower().replace("dominance", "")


def test_warnings_and_what_was_left_out_are_told():
    merged = gpd.GeoDataFrame({"class": ["divider", "divider"]}, geometry=[LineString([(0, 0), (9, 0)]), None])
    text = text_of(page(merged, layer([(0, 0), (9, 0)], cls="kerb")))
    assert "Left out: 1 (no geometry)" in text
    assert "the reference has no 'divider'" in text
