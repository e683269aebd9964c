"""The command line: ``python -m polymerge_core``, or ``polymerge``. No geometry here."""

from __future__ import annotations

import platform
import sys
from pathlib import Path
from typing import Any

import click
import geopandas as gpd
import numpy as np

import polymerge_core as pm
from polymerge_core import console, map_commands
from polymerge_core.command_options import count, known_crs, left_out, output_option, reading_options, run_options
from polymerge_core.environment import library_versions
from polymerge_core.evaluation import REGION_FROM
from polymerge_core.formats import read_matrix
from polymerge_core.job import Job, split_off
from polymerge_core.options import AGGREGATES, METHODS, Options


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110}, no_args_is_help=False)
@click.version_option(pm.__version__, prog_name="polymerge")
def cli() -> None:
    """Merge many overlapping, imperfect digitisations of the same lines into one clean map."""


@cli.command()
@click.argument("predictions", type=click.Path())
@click.option("--poses", required=True, type=click.Path(), help="Poses as CSV or JSON.")
@click.option("--crs", required=True, callback=known_crs, help="CRS of the result, such as EPSG:32617, or local.")
@click.option(
    "--pose-kind",
    type=click.Choice(["crs", "origin", "geodetic", "offset"]),
    default="crs",
    show_default=True,
    help="What the poses are given in.",
)
@click.option("--origin", metavar="LAT,LON", help="Map origin in degrees, for --pose-kind origin.")
@click.option("--pose-offset", metavar="E,N", help="Metres to add to the poses, for --pose-kind offset.")
@click.option("--lidar-to-ego", metavar="FILE", help="4x4 matrix as JSON, for predictions in the LiDAR's frame.")
@click.option(
    "--footprint",
    metavar="XMIN,YMIN,XMAX,YMAX",
    default="-30,-15,30,15",
    show_default=True,
    help="What the predictor looks at, in the vehicle's frame, metres.",
)
@click.option("--drive", help="Name of the drive.  [default: the output's name]")
@output_option
@run_options
def project(predictions: str, poses: str, output: Path, lidar_to_ego: str | None, **chosen: Any) -> None:
    """Carry a predictor's local maps from the vehicle's frame into the world."""
    run = split_off(chosen)
    for name, form in (("origin", "LAT,LON"), ("pose_offset", "E,N"), ("footprint", "XMIN,YMIN,XMAX,YMAX")):
        chosen[name] = _numbers(name, chosen[name], form)
    chosen["drive"] = chosen["drive"] or output.stem
    inputs = [predictions, poses, *([lidar_to_ego] if lidar_to_ego else [])]
    with Job(output, inputs, ["local_maps", "instances"], **run) as job:
        job.progress(0.0, "reading the predictions")
        seen = pm.read_predictions(predictions)
        matrix = read_matrix(lidar_to_ego) if lidar_to_ego else None
        job.progress(0.3, "reading the poses")
        located = pm.read_poses(poses)
        job.progress(0.4, "projecting")
        local = pm.project(seen, located, lidar_to_ego=matrix, **chosen)
        job.write(local.layers(), 0.6)
        report = local.report()
        job.report(report)
    console.say(
        f"{count(report['observations'], 'observation')} of {count(report['instances'], 'local map')}"
        f"{left_out(report['left_out'])} -> {job.written}"
    )


@cli.command()
@click.argument("local_maps", nargs=-1, required=True, metavar="LOCAL...")
@reading_options
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default=METHODS[0],
    show_default=True,
    help="consensus: one robust line from all looks at it; polymerge: as it was published.",
)
@click.option(
    "--coverage",
    type=float,
    default=0.5,
    show_default=True,
    help="Of polymerge, for area classes: the share of areas that must cover a place (Th_cov).",
)
@click.option(
    "--aggregate",
    multiple=True,
    metavar="[COLUMN=]FUNCTION",
    help=f"How columns are carried: {', '.join(AGGREGATES)}; repeatable.  [default: first]",
)
@output_option
@run_options
def merge(local_maps: tuple[str, ...], output: Path, main_map: str | None, **chosen: Any) -> None:
    """Merge local maps (FILE, or "FILE|layername=LAYER" in quotes) into one map."""
    run = split_off(chosen)
    chosen["aggregate"] = _aggregate(chosen["aggregate"])
    Options.of(**chosen)  # a wrong value is told before anything is read
    inputs = [*local_maps, *([] if main_map is None else [main_map])]
    with Job(output, inputs, ["elements"], tables=["lineage"], **run) as job:
        job.progress(0.0, "reading the files")
        layers = pm.read_local_maps(local_maps)
        into = None if main_map is None else pm.read_local_maps([main_map])
        result = pm.merge(layers, into, progress=job.progress.part(0.05, 0.9), **chosen)
        job.write(result.layers(), 0.9)
        job.report(result.report)
    report = result.report
    for warning in report["warnings"]:
        console.say(f"warning: {warning}")
    kept = report["main_map_elements"]
    into_what = "" if main_map is None else f" and {count(kept, 'element')} of the main map"
    console.say(
        f"{count(report['observations'], 'observation')} of {count(report['instances'], 'local map')}{into_what} "
        f"became {count(report['elements'], 'element')}{left_out(report['left_out'])} -> {job.written}"
    )


@cli.command()
@click.argument("local_maps", nargs=-1, required=True, metavar="LOCAL...")
@reading_options
@output_option
@run_options
def network(local_maps: tuple[str, ...], output: Path, main_map: str | None, **chosen: Any) -> None:
    """Write who would be merged with whom by --method polymerge: layers edges and observations."""
    run = split_off(chosen)
    Options.of(**chosen)
    inputs = [*local_maps, *([] if main_map is None else [main_map])]
    with Job(output, inputs, ["edges", "observations"], **run) as job:
        job.progress(0.0, "reading the files")
        layers = pm.read_local_maps(local_maps)
        into = None if main_map is None else pm.read_local_maps([main_map])
        graph = pm.merge_network(layers, into, progress=job.progress.part(0.05, 0.7), **chosen)
        written = pm.network_layers(graph)
        job.write(written, 0.8)
        sizes = written["observations"]["component"].value_counts()
        report = {
            "observations": len(written["observations"]),
            "edges": len(written["edges"]),
            "components": len(sizes),
            "largest_component": int(sizes.max()) if len(sizes) else 0,
            "left_out": graph.graph["left_out"]["reason"].value_counts(sort=False).to_dict(),
        }
        job.report(report)
    console.say(
        f"{count(report['observations'], 'observation')}, {count(report['edges'], 'edge')}, "
        f"{count(report['components'], 'component')} (the largest has {report['largest_component']})"
        f"{left_out(report['left_out'])} -> {job.written}"
    )


@cli.command()
@click.argument("merged", metavar="MERGED", nargs=-1, required=True)
@click.option("--reference", multiple=True, required=True, metavar="TRUTH", help="The true map; repeatable.")
@click.option("--local", "local_maps", multiple=True, metavar="LOCAL", help="What MERGED was made from; repeatable.")
@click.option("--region", metavar="FILE", help="Polygons of the part that counts.")
@click.option("--region-from", type=click.Choice(REGION_FROM), help="Which part of the reference counts.")
@click.option("--pcm", is_flag=True, help="Work out partial curve mapping too, of at most 2,000 pairs.")
@click.option("--class-field", help="Column of the class.  [default: class, if there is one]")
@click.option("--class-name", default="line", show_default=True, help="The class where no column names one.")
@click.option("--score-field", help="Column of the confidence, 0 to 1.  [default: score, else 1]")
@click.option("--area", multiple=True, metavar="CLASS", help="A class of areas, beside ped_crossing; repeatable.")
@click.option("--crs", callback=known_crs, help="CRS of layers without one, such as EPSG:32632, or local.")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="A page with tables and pictures, HTML.")
@click.option("--layers", type=click.Path(path_type=Path), help="The errors along the lines, as layers.")
@run_options
def evaluate(
    merged: tuple[str, ...],
    reference: tuple[str, ...],
    local_maps: tuple[str, ...],
    region: str | None,
    output: Path | None,
    layers: Path | None,
    **chosen: Any,
) -> None:
    """Measure how close the map MERGED (FILE, or "FILE|layername=LAYER" in quotes; repeatable) is to a reference."""
    run = split_off(chosen)
    if output is not None and output.suffix.lower() not in {".html", ".htm"}:
        raise pm.OptionError(
            f"--output is a page, {output} has no name of one; end it in .html (--layers writes layers)"
        )
    inputs = [*merged, *reference, *local_maps, *([] if region is None else [region])]
    pages = [] if output is None else [output]
    with Job(layers, inputs, ["errors", "evaluated"], tables=["measures"], pages=pages, **run) as job:
        job.progress(0.0, "reading the files")
        maps = [pm.read_local_maps(sources) for sources in (merged, reference, local_maps)]
        area = None if region is None else _region(region)
        result = pm.evaluate(
            maps[0], maps[1], local_maps=maps[2] or None, region=area, progress=job.progress.part(0.05, 0.8), **chosen
        )
        job.report(result.report)
        if output is not None:
            from polymerge_core.evaluation.page import render_page  # noqa: PLC0415 - matplotlib is slow to load

            job.progress(0.8, "drawing")
            job.page(output, render_page(result))
        job.write(result.layers(), 0.95)
    for warning in result.report["warnings"]:
        console.say(f"warning: {warning}")
    if run["report_file"] != "-":
        click.echo(result.summary())
    if job.written:
        console.say(f"{left_out(result.report['left_out']).removeprefix('; ') or 'done'} -> {job.written}")


for _command in map_commands.COMMANDS:
    cli.add_command(_command)


@cli.command("demo")
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False), default="polymerge_demo")
@click.option("--method", type=click.Choice(METHODS), default=METHODS[0], show_default=True)
@click.option("--overwrite", is_flag=True, help="Replace the outputs of an earlier run.")
def run_demo(folder: Path, *, method: str, overwrite: bool) -> None:
    """Merge the sample, a simulated drive through a town junction, into FOLDER and draw it.

    Without FOLDER everything goes to the folder polymerge_demo, here.
    """
    from polymerge_core import demo  # noqa: PLC0415 - matplotlib is slow to load, and only this command draws

    click.echo(demo.run_demo(folder, method=method, overwrite=overwrite))


@cli.command()
def env() -> None:
    """Print the versions of PolyMerge and of the libraries it runs on."""
    click.echo(f"polymerge_core {pm.__version__}")
    click.echo(f"Python {platform.python_version()} on {platform.platform()}")
    for name, version in library_versions().items():
        click.echo(f"{name} {version}")


def _numbers(name: str, text: str | None, form: str) -> tuple[float, ...] | None:
    """Read comma-separated numbers."""
    if text is None:
        return None
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    count = form.count(",") + 1
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise pm.OptionError(
            f"--{name.replace('_', '-')} is {text!r}; it takes {count} numbers with commas between, {form}"
        )
    return numbers


def _region(source: str) -> gpd.GeoSeries:
    """Read the polygons of a file."""
    layers = list(pm.read_layers(source).values())
    if len(layers) > 1:
        raise pm.InputError(f'{source} holds several layers; name the one of the region, "FILE|layername=LAYER"')
    return layers[0].geometry


def _aggregate(chosen: tuple[str, ...]) -> str | dict[str, str]:
    """Read ``FUNCTION`` or ``COLUMN=FUNCTION``, the latter any number of times."""
    plain = [entry for entry in chosen if "=" not in entry]
    if plain and len(chosen) > 1:
        raise pm.OptionError("--aggregate takes one function for all columns, or COLUMN=FUNCTION for each")
    if plain:
        return plain[0]
    return dict(entry.rsplit("=", 1) for entry in chosen) or "first"


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    return console.run(cli, arguments)


if __name__ == "__main__":
    sys.exit(main())
