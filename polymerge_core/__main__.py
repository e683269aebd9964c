"""The command line: ``python -m polymerge_core``, or ``polymerge``. No geometry here."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click
import geopandas as gpd
import numpy as np

import polymerge_core as pm
from polymerge_core import console
from polymerge_core.crs import parse_crs
from polymerge_core.environment import library_versions
from polymerge_core.evaluation import REGION_FROM
from polymerge_core.formats import read_matrix
from polymerge_core.job import Job, split_off
from polymerge_core.options import AGGREGATES, INSTANCE_FROM, METHODS, Options
from polymerge_core.schema import AREAS_LAYER, ELEMENTS_LAYER, polygons_apart
from polymerge_core.store.map_file import PATIENCE_S
from polymerge_core.streaming import run_stream

_Command = TypeVar("_Command", bound=Callable[..., Any])


def _decorate(*options: Callable[[_Command], _Command]) -> Callable[[_Command], _Command]:
    def apply(command: _Command) -> _Command:
        for option in reversed(options):
            command = option(command)
        return command

    return apply


def _known_crs(_context: click.Context, _option: click.Parameter, text: str | None) -> str | None:
    """Refuse a CRS that nobody knows before anything is read."""
    if text is not None:
        try:
            parse_crs(text)
        except pm.CrsError as error:
            raise pm.OptionError(str(error)) from error
    return text


_output = click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="The file to write.")

_run_options = _decorate(
    click.option("--overwrite", is_flag=True, help="Replace existing outputs."),
    click.option("--json", "report_file", metavar="FILE", help="Write a report as JSON; - for standard output."),
    click.option("--progress", type=click.Choice(["auto", "json", "none"]), default="auto", show_default=True),
    click.option("--watch-stdin", is_flag=True, help="Stop, leaving nothing behind, when standard input closes."),
)

_source_options = _decorate(
    click.option("--class-field", help="Column of the class.  [default: class, if there is one]"),
    click.option("--class-name", default="line", show_default=True, help="The class where no column names one."),
    click.option("--drive-field", help="Column of the drive or survey.  [default: drive, else the file's name]"),
    click.option("--instance-field", help="Column of the local map (frame).  [default: instance, if there is one]"),
    click.option("--instance-from", type=click.Choice(INSTANCE_FROM), help="What a local map is."),
    click.option("--score-field", help="Column of the confidence, 0 to 1.  [default: score, else 1]"),
    click.option("--min-score", type=float, default=0.0, show_default=True, help="Leave out what is under it."),
    click.option("--timestamp-field", help="Column that orders the local maps.  [default: timestamp, if any]"),
)

_reading_options = _decorate(
    click.option("--main-map", metavar="MAP", help="The map to merge into; its element_id are kept."),
    _source_options,
    click.option(
        "--proximity", type=float, default=1.0, show_default=True, help="How near is near, in metres (Th_prox)."
    ),
    click.option("--area", multiple=True, metavar="CLASS", help="A class of areas, beside ped_crossing; repeatable."),
    click.option("--crs", callback=_known_crs, help="CRS of layers without one, such as EPSG:32632, or local."),
    click.option(
        "--out-crs", callback=_known_crs, help="CRS of the result.  [default: the main map's, else the first layer's]"
    ),
    click.option("--strict", is_flag=True, help="A feature that cannot be used is an error."),
)


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110}, no_args_is_help=False)
@click.version_option(pm.__version__, prog_name="polymerge")
def cli() -> None:
    """Merge many overlapping, imperfect digitisations of the same lines into one clean map."""


@cli.command()
@click.argument("predictions", type=click.Path())
@click.option("--poses", required=True, type=click.Path(), help="Poses as CSV or JSON.")
@click.option("--crs", required=True, callback=_known_crs, help="CRS of the result, such as EPSG:32617, or local.")
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
@_output
@_run_options
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
        f"{_count(report['observations'], 'observation')} of {_count(report['instances'], 'local map')}"
        f"{_left_out(report['left_out'])} -> {job.written}"
    )


@cli.command()
@click.argument("local_maps", nargs=-1, required=True, metavar="LOCAL...")
@_reading_options
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
@_output
@_run_options
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
    into_what = "" if main_map is None else f" and {_count(kept, 'element')} of the main map"
    console.say(
        f"{_count(report['observations'], 'observation')} of {_count(report['instances'], 'local map')}{into_what} "
        f"became {_count(report['elements'], 'element')}{_left_out(report['left_out'])} -> {job.written}"
    )


@cli.command()
@click.argument("local_maps", nargs=-1, required=True, metavar="LOCAL...")
@_reading_options
@_output
@_run_options
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
        f"{_count(report['observations'], 'observation')}, {_count(report['edges'], 'edge')}, "
        f"{_count(report['components'], 'component')} (the largest has {report['largest_component']})"
        f"{_left_out(report['left_out'])} -> {job.written}"
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
@click.option("--crs", callback=_known_crs, help="CRS of layers without one, such as EPSG:32632, or local.")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="A page with tables and pictures, HTML.")
@click.option("--layers", type=click.Path(path_type=Path), help="The errors along the lines, as layers.")
@_run_options
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
        console.say(f"{_left_out(result.report['left_out']).removeprefix('; ') or 'done'} -> {job.written}")


@cli.command()
@click.argument("stored", metavar="MAP", type=click.Path(path_type=Path))
@click.argument("local_maps", nargs=-1, metavar="[LOCAL...]")
@click.option("--create", is_flag=True, help="Make the map if there is none.")
@click.option("--stream", is_flag=True, help="Read local maps from standard input, one JSON object a line.")
@click.option("--draw-every", type=click.IntRange(1), default=10, show_default=True, help="Of a stream, in frames.")
@_source_options
@click.option("--proximity", type=float, help="Of a map that is made: how near is near, in metres.  [default: 1]")
@click.option("--area", multiple=True, metavar="CLASS", help="Of a map that is made: a class of areas; repeatable.")
@click.option(
    "--patience",
    type=click.FloatRange(0),
    default=PATIENCE_S,
    show_default=True,
    help="Seconds to wait for another program that has MAP locked.",
)
@click.option("--crs", callback=_known_crs, help="CRS of a map that is made, and of layers without one.")
@click.option("--strict", is_flag=True, help="A feature that cannot be used is an error.")
@_run_options
def update(
    stored: Path,
    local_maps: tuple[str, ...],
    *,
    create: bool,
    stream: bool,
    draw_every: int,
    crs: str | None,
    proximity: float | None,
    area: tuple[str, ...],
    patience: float,
    **chosen: Any,
) -> None:
    """Feed the stored map MAP local maps (FILE, or "FILE|layername=LAYER" in quotes), all of them or none."""
    run = split_off(chosen)
    if stream == bool(local_maps):
        raise click.UsageError("give local maps, or --stream to read them from standard input")
    if stream and run["watch_stdin"]:
        raise click.UsageError("--watch-stdin does not go with --stream, which reads standard input")
    made = crs if create else None
    with Job(None, local_maps, [], **run) as job:
        held = pm.MapStore(stored, create=create, crs=made, proximity=proximity, area=area, patience_s=patience)
        if stream:
            report = run_stream(held, draw_every=draw_every)
        else:
            job.progress(0.0, "reading the files")
            layers = pm.read_local_maps(local_maps)
            without = any(maps.observations.crs is None for maps in layers)
            job.progress(0.2, "updating the map")
            report = held.update(layers, crs=crs if without else None, **chosen).report()
        job.report(report)
    for warning in report["warnings"]:
        console.say(f"warning: {warning}")
    what = ", ".join(f"{report[kind]} {kind}" for kind in ("added", "changed", "moved", "retired", "merged"))
    console.say(
        f"{_count(report['observations'], 'observation')} of {_count(report['instances'], 'local map')}"
        f"{_left_out(report['left_out'])}; {_count(report['elements'], 'element')} ({what}) -> {stored}, "
        f"revision {report['revision']}"
    )


@cli.command()
@click.argument("stored", metavar="MAP", type=click.Path(path_type=Path))
@click.option("--json", "report_file", metavar="FILE", help="Write it as JSON; - for standard output.")
def history(stored: Path, report_file: str | None) -> None:
    """List the revisions of the stored map MAP."""
    with Job(None, [], [], overwrite=True, report_file=report_file, progress="none", watch_stdin=False) as job:
        revisions = pm.MapStore(stored).history()
        job.report({"revisions": revisions.to_dict("records")})
    if report_file is None:
        shown = revisions.drop(columns="software")
        click.echo(shown.to_string(index=False) if len(shown) else "no revisions")


@cli.command()
@click.argument("stored", metavar="MAP", type=click.Path(path_type=Path))
@click.option("--since", type=click.IntRange(0), default=0, show_default=True, help="A revision; 0 is the empty map.")
@_output
@_run_options
def changes(stored: Path, output: Path, since: int, **chosen: Any) -> None:
    """Write what became of the elements of the stored map MAP since a revision: layers changes and moves."""
    with Job(output, [str(stored)], ["changes", "moves"], **split_off(chosen)) as job:
        found = pm.MapStore(stored).changes(since)
        moves = pm.MapStore(stored).moves(since)
        job.write(polygons_apart("changes", "changes_areas", found) | {"moves": moves}, 0.7)
        kinds = {str(kind): int(count) for kind, count in found["kind"].value_counts(sort=False).items()}
        job.report({"since": since, "changes": kinds})
    listed = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items())) or "no changes"
    console.say(f"{listed} -> {job.written}")


@cli.command()
@click.argument("stored", metavar="MAP", type=click.Path(path_type=Path))
@click.option("--revision", type=click.IntRange(1), required=True, help="Which one.")
@_output
@_run_options
def restore(stored: Path, output: Path, revision: int, **chosen: Any) -> None:
    """Write the stored map MAP as it was at a revision; MAP itself is left alone."""
    with Job(output, [str(stored)], ["elements"], **split_off(chosen)) as job:
        elements = pm.MapStore(stored).elements(revision)
        job.write(polygons_apart(ELEMENTS_LAYER, AREAS_LAYER, elements), 0.7)
        job.report({"revision": revision, "elements": len(elements)})
    console.say(f"{_count(len(elements), 'element')} of revision {revision} -> {job.written}")


@cli.command()
@click.argument("stored", metavar="MAP", type=click.Path(path_type=Path))
def verify(stored: Path) -> None:
    """Check that everything that must hold of the file of the stored map MAP does."""
    found = pm.MapStore(stored).verify()
    if found:
        raise pm.InputError(f"{stored} is damaged: {'; '.join(found)}; restore it from a copy")
    console.say(f"{stored} is whole")


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


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _left_out(reasons: dict[str, int]) -> str:
    if not reasons:
        return ""
    listed = ", ".join(f"{reason}: {count}" for reason, count in sorted(reasons.items()))
    return f"; {sum(reasons.values())} left out ({listed})"


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    return console.run(cli, arguments)


if __name__ == "__main__":
    sys.exit(main())
