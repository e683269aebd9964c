"""Saved models that hold the algorithms as steps, beside those of QGIS."""

from __future__ import annotations

import subprocess
from pathlib import Path
from textwrap import dedent

import pytest
import shapely

from tests.cli.layers import UTM, draw, noisy_copies
from tests.qgis.process.comparing import assert_same, command_line, table
from tests.qgis.process.running import PATIENCE_S, Qgis, qgis_python

_BEGINNING = """
    import sys
    from qgis.core import *
    QgsApplication([], False).initQgis()

    def step(model, name, algorithm, **given):
        child = QgsProcessingModelChildAlgorithm(algorithm)
        child.setChildId(name)
        for parameter, value in given.items():
            child.addParameterSources(parameter, value if isinstance(value, list) else [value])
        model.addChildAlgorithm(child)

    def output(model, name, parameter, title):
        out = QgsProcessingModelOutput(title)
        out.setChildId(name)
        out.setChildOutputName(parameter)
        child = model.childAlgorithm(name)
        child.setModelOutputs({title: out})
        model.setChildAlgorithm(child)

    def parameter(model, definition):
        model.addModelParameter(definition, QgsProcessingModelParameter(definition.name()))

    Source = QgsProcessingModelChildParameterSource
    model = QgsProcessingModelAlgorithm(sys.argv[1], "tests")
"""
_END = """
    sys.exit(0 if model.toFile(sys.argv[2]) else 1)
"""


def save_model(qgis: Qgis, path: Path, steps: str) -> Path:
    """Have PyQGIS write a model, which knows nothing of the plugin."""
    script = path.with_suffix(".py")
    script.write_text(dedent(_BEGINNING) + dedent(steps) + dedent(_END), encoding="utf-8")
    subprocess.run([qgis_python(), script, path.stem, path], check=True, env=qgis.environment(), timeout=PATIENCE_S)
    return path


@pytest.fixture(scope="module")
def sample_model(qgis: Qgis, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Predictions and poses to local maps, and these to a merged map."""
    steps = """
        parameter(model, QgsProcessingParameterFile("predictions"))
        parameter(model, QgsProcessingParameterFile("poses"))
        step(
            model, "project", "polymerge:projectlocalmaps",
            PREDICTIONS=Source.fromModelParameter("predictions"),
            POSES=Source.fromModelParameter("poses"),
            CRS=Source.fromStaticValue("EPSG:32632"),
        )
        step(
            model, "merge", "polymerge:mergelocalmaps",
            LOCAL_MAPS=Source.fromChildOutput("project", "OUTPUT"),
            INSTANCES=Source.fromChildOutput("project", "INSTANCES"),
            MIN_SCORE=Source.fromStaticValue(0.3),
        )
        output(model, "merge", "OUTPUT", "merged")
    """
    return save_model(qgis, tmp_path_factory.mktemp("models") / "sample.model3", steps)


@pytest.fixture(scope="module")
def buffer_model(qgis: Qgis, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two layers to a merged map, and this to the space around it, as wide as the number of elements."""
    steps = """
        parameter(model, QgsProcessingParameterVectorLayer("first"))
        parameter(model, QgsProcessingParameterVectorLayer("second"))
        step(
            model, "merge", "polymerge:mergelocalmaps",
            LOCAL_MAPS=[Source.fromModelParameter("first"), Source.fromModelParameter("second")],
        )
        step(
            model, "buffer", "native:buffer",
            INPUT=Source.fromChildOutput("merge", "OUTPUT"),
            DISTANCE=Source.fromChildOutput("merge", "N_ELEMENTS"),
        )
        output(model, "buffer", "OUTPUT", "around")
        output(model, "merge", "LINEAGE", "lineage")
    """
    return save_model(qgis, tmp_path_factory.mktemp("models") / "around.model3", steps)


def test_a_model_takes_the_sample_from_predictions_to_a_merged_map(
    qgis: Qgis, sample_model: Path, sample_folder: Path, tmp_path: Path
) -> None:
    predictions, poses = sample_folder / "predictions.json", sample_folder / "poses.csv"
    local, expected, merged = (tmp_path / f"{name}.gpkg" for name in ("local", "expected", "merged"))
    command_line("project", predictions, "--poses", poses, "--crs", UTM, "--drive", "predictions", "-o", local)
    command_line("merge", f"{local}|layername=local_maps", "--min-score", 0.3, "-o", expected)

    done = qgis.run(str(sample_model), {"predictions": predictions, "poses": poses, "merge:merged": merged})

    assert done.results["merge:merged"] == str(merged)
    assert_same(merged, expected, "elements")


def test_a_model_hands_a_merge_on_to_an_algorithm_of_qgis(qgis: Qgis, buffer_model: Path, tmp_path: Path) -> None:
    roads = [draw(tmp_path / f"{n}.shp", [road]) for n, road in enumerate(noisy_copies(2, 10))]
    expected, around, lineage = (tmp_path / f"{name}.gpkg" for name in ("expected", "around", "lineage"))
    command_line("merge", *roads, "-o", expected)
    parameters = {"first": roads[0], "second": roads[1], "buffer:around": around, "merge:lineage": lineage}

    done = qgis.run(str(buffer_model), parameters)

    assert done.code == 0, done.err
    line, space = table(expected, "elements").geometry, table(around).geometry
    assert shapely.contains_properly(space, line).all()
    assert shapely.hausdorff_distance(space.boundary, line).max() == pytest.approx(len(line), abs=0.05)
    assert list(table(around)["element_id"]) == list(table(expected, "elements")["element_id"])
    assert sorted(table(lineage)["instance"]) == ["0", "1"]
