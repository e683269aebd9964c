"""`polymerge:projectlocalmaps`: a predictor's local maps, from the vehicle's frame into the world."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import QgsProcessingContext, QgsProcessingParameterCrs, QgsProcessingParameterDefinition

from ..destinations import Place
from ..parameters import absolute_file, choice_parameter, explained, file_parameter, switch_parameter, text_parameter
from ..progress import Part
from ..results import Result
from ..translation import mark, tr
from .base import Parameters, Staged, WorkerAlgorithm


class ProjectLocalMaps(WorkerAlgorithm):
    """Carry predictions from the vehicle's frame into a CRS."""

    NAME = "projectlocalmaps"
    TITLE = mark("Project local maps")
    ICON = "project"
    TAGS = mark("predictions,pose,ego,vehicle,frame,HD map,VectorMapNet,MapTR,StreamMapNet,project,georeference,JSON")
    SUMMARY = mark("Carries the polylines that a perception model saw from a vehicle into the world.")
    HELP = mark(
        "Reads predictions of VectorMapNet, MapTR, StreamMapNet and others as JSON, and the vehicle's poses as CSV or "
        "JSON, and makes a layer of local maps that can be merged."
    )
    COMMAND = "project"
    OPTIONS = ("CRS", "POSE_KIND", "ORIGIN", "POSE_OFFSET", "LIDAR_TO_EGO", "FOOTPRINT", "DRIVE")
    NUMBERS = (
        ("N_OBSERVATIONS", mark("Number of observations")),
        ("N_INSTANCES", mark("Number of local maps")),
        ("N_LEFT_OUT", mark("Number of predictions left out")),
    )

    def inputs(self) -> list[QgsProcessingParameterDefinition]:
        """Return the files, the CRS and what the poses are given in."""
        tables = tr("Poses (*.csv *.json)")
        return [
            file_parameter(
                "PREDICTIONS", tr("Predictions"), tr("The predictor's results as JSON."), kinds="JSON (*.json)"
            ),
            file_parameter(
                "POSES", tr("Poses"), tr("Where the vehicle was at each frame, as CSV or JSON."), kinds=tables
            ),
            explained(
                QgsProcessingParameterCrs("CRS", tr("CRS of the result"), optional=True),
                tr("A projected CRS in metres, such as the UTM zone; poses are in it unless they are of another kind."),
            ),
            switch_parameter(
                "LOCAL_CRS",
                tr("Plain metres without a CRS"),
                tr("The poses are metres that lie nowhere on Earth; the result has no CRS."),
            ),
            choice_parameter(
                "POSE_KIND",
                tr("What the poses are given in"),
                tr(
                    "crs: metres of the CRS; origin: metres east and north of a map origin; geodetic: latitude, "
                    "longitude and heading; offset: grid metres to which an offset is added."
                ),
                ("crs", "origin", "geodetic", "offset"),
                advanced=False,
            ),
            text_parameter("ORIGIN", tr("Map origin"), tr("LAT,LON in degrees, for poses of the kind origin.")),
            text_parameter("POSE_OFFSET", tr("Offset"), tr("E,N in metres, for poses of the kind offset.")),
            file_parameter(
                "LIDAR_TO_EGO",
                tr("LiDAR to vehicle"),
                tr("A 4x4 matrix as JSON, for predictions in the LiDAR's frame."),
                kinds="JSON (*.json)",
                optional=True,
            ),
            text_parameter(
                "FOOTPRINT",
                tr("What the predictor looks at"),
                tr("XMIN,YMIN,XMAX,YMAX in metres, in the vehicle's frame: x forward, y to the left."),
                default="-30,-15,30,15",
            ),
            text_parameter("DRIVE", tr("Name of the drive"), tr("Empty: the name of the predictions' file.")),
        ]

    def places_read(self, parameters: Parameters, context: QgsProcessingContext) -> list[Place]:
        """Return the predictions, the poses and the matrix."""
        files = [self.parameterAsFile(parameters, name, context) for name in ("PREDICTIONS", "POSES", "LIDAR_TO_EGO")]
        return [Place(file) for file in files if file]

    def fault(self, parameters: Parameters, context: QgsProcessingContext) -> str:
        """Ask for a CRS, or for the word that there is none."""
        has_crs = self.parameterAsCrs(parameters, "CRS", context).isValid()
        if has_crs == self.parameterAsBoolean(parameters, "LOCAL_CRS", context):
            return tr("Choose a CRS of the result, or tick “Plain metres without a CRS”: one of the two, not both.")
        return super().fault(parameters, context)

    def stage(self, parameters: Parameters, context: QgsProcessingContext, folder: Path, part: Part) -> Staged:
        """Name the files, which the worker reads itself."""
        del folder, part
        predictions, poses = (absolute_file(self, parameters, name, context) for name in ("PREDICTIONS", "POSES"))
        drive = self.parameterAsString(parameters, "DRIVE", context)
        named = [] if drive else [f"--drive={Path(predictions).stem}"]
        return Staged([f"--poses={poses}", *named], [predictions], {})

    def results(self) -> list[Result]:
        """Return the local maps, and where the predictor looked."""
        return [
            Result(
                "OUTPUT",
                tr("Local maps"),
                ("local_maps",),
                "line",
                tr("One line for each prediction, with its class, drive, frame, score and time."),
                style="local_maps",
                optional=False,
                shown_empty=True,
            ),
            Result(
                "INSTANCES",
                tr("Footprints"),
                ("instances",),
                "polygon",
                tr("What the predictor looked at in each frame, those included in which it saw nothing."),
                style="instances",
            ),
            Result(
                "LEFT_OUT",
                tr("Left out"),
                ("left_out",),
                "table",
                tr("Predictions that cannot be used, with the reason."),
                style="left_out",
            ),
        ]

    def numbers(self, report: dict[str, Any]) -> dict[str, float]:
        """Count what came out."""
        return {
            "N_OBSERVATIONS": report["observations"],
            "N_INSTANCES": report["instances"],
            "N_LEFT_OUT": sum(report["left_out"].values()),
        }
