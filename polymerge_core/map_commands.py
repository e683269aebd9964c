"""The commands of the stored map: update, history, changes, restore, undo, verify. No geometry here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import polymerge_core as pm
from polymerge_core import console
from polymerge_core.command_options import count, known_crs, left_out, output_option, run_options, source_options
from polymerge_core.job import Job, split_off
from polymerge_core.schema import AREAS_LAYER, ELEMENTS_LAYER, polygons_apart
from polymerge_core.store.map_file import PATIENCE_S
from polymerge_core.streaming import run_stream

_patience = click.option(
    "--patience",
    type=click.FloatRange(0),
    default=PATIENCE_S,
    show_default=True,
    help="Seconds to wait for another program that has MAP locked.",
)


@click.command()
@click.argument("stored", metavar="MAP", type=click.Path(path_type=Path))
@click.argument("local_maps", nargs=-1, metavar="[LOCAL...]")
@click.option("--create", is_flag=True, help="Make the map if there is none.")
@click.option("--stream", is_flag=True, help="Read local maps from standard input, one JSON object a line.")
@click.option("--draw-every", type=click.IntRange(1), default=10, show_default=True, help="Of a stream, in frames.")
@source_options
@click.option("--proximity", type=float, help="Of a map that is made: how near is near, in metres.  [default: 1]")
@click.option("--area", multiple=True, metavar="CLASS", help="Of a map that is made: a class of areas; repeatable.")
@_patience
@click.option("--crs", callback=known_crs, help="CRS of a map that is made, and of layers without one.")
@click.option("--strict", is_flag=True, help="A feature that cannot be used is an error.")
@run_options
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
    if stream:
        _check_stream(run, chosen)
    made = crs if create or stream else None
    with Job(None, local_maps, [], **run) as job:
        held = pm.MapStore(stored, create=create, crs=made, proximity=proximity, area=area, patience_s=patience)
        if stream:
            report = run_stream(held, draw_every=draw_every, min_score=chosen["min_score"], strict=chosen["strict"])
        else:
            job.progress(0.0, "reading the files")
            layers = pm.read_local_maps(local_maps)
            without = any(maps.observations.crs is None for maps in layers)
            job.progress(0.2, "updating the map")
            report = held.update(layers, crs=crs if without else None, **chosen).report()
        job.report(report)
    for warning in report["warnings"]:
        console.say(f"warning: {warning}")
    console.say(
        f"{count(report['observations'], 'observation')} of {count(report['instances'], 'local map')}"
        f"{left_out(report['left_out'])}; {_what_changed(report)} -> {stored}, "
        f"revision {report['revision']}"
    )
    if report.get("unusable_lines"):
        raise pm.InputError(f"{count(report['unusable_lines'], 'line')} could not be used; all others are in {stored}")


def _what_changed(report: dict[str, Any]) -> str:
    what = ", ".join(f"{report[kind]} {kind}" for kind in ("added", "changed", "moved", "retired", "merged"))
    return f"{count(report['elements'], 'element')} ({what})"


def _check_stream(run: dict[str, Any], chosen: dict[str, Any]) -> None:
    """Refuse what a stream has no use for."""
    if run["watch_stdin"]:
        raise click.UsageError("--watch-stdin does not go with --stream, which reads standard input")
    usual = {"class_name": "line", "min_score": chosen["min_score"], "strict": chosen["strict"]}
    unused = next((name for name, value in chosen.items() if value != usual.get(name)), None)
    if unused is not None:
        raise click.UsageError(f"--{unused.replace('_', '-')} does not go with --stream, whose frames have no columns")


@click.command()
@click.argument("stored", metavar="MAP", type=click.Path(path_type=Path))
@click.option("--json", "report_file", metavar="FILE", help="Write it as JSON; - for standard output.")
def history(stored: Path, report_file: str | None) -> None:
    """List the revisions of the stored map MAP."""
    with Job(None, [], [], overwrite=True, report_file=report_file, progress="none", watch_stdin=False) as job:
        revisions = pm.MapStore(stored).history()
        told = revisions.astype(object).where(revisions.notna(), None)
        job.report({"revisions": told.to_dict("records")})
    if report_file is None:
        shown = revisions.drop(columns="software")
        click.echo(shown.to_string(index=False, na_rep="") if len(shown) else "no revisions")


@click.command()
@click.argument("stored", metavar="MAP", type=click.Path(path_type=Path))
@click.option("--since", type=click.IntRange(0), default=0, show_default=True, help="A revision; 0 is the empty map.")
@output_option
@run_options
def changes(stored: Path, output: Path, since: int, **chosen: Any) -> None:
    """Write what became of the elements of the stored map MAP since a revision: layers changes and moves."""
    with Job(output, [str(stored)], ["changes", "moves"], **split_off(chosen)) as job:
        found = pm.MapStore(stored).changes(since)
        moves = pm.MapStore(stored).moves(since)
        job.write(polygons_apart("changes", "changes_areas", found) | {"moves": moves}, 0.7)
        kinds = {str(kind): int(number) for kind, number in found["kind"].value_counts(sort=False).items()}
        job.report({"since": since, "changes": kinds})
    listed = ", ".join(f"{number} {kind}" for kind, number in sorted(kinds.items())) or "no changes"
    console.say(f"{listed} -> {job.written}")


@click.command()
@click.argument("stored", metavar="MAP", type=click.Path(path_type=Path))
@click.option("--revision", type=click.IntRange(1), required=True, help="Which one.")
@output_option
@run_options
def restore(stored: Path, output: Path, revision: int, **chosen: Any) -> None:
    """Write the stored map MAP as it was at a revision; MAP itself is left alone."""
    with Job(output, [str(stored)], ["elements"], **split_off(chosen)) as job:
        elements = pm.MapStore(stored).elements(revision)
        job.write(polygons_apart(ELEMENTS_LAYER, AREAS_LAYER, elements), 0.7)
        job.report({"revision": revision, "elements": len(elements)})
    console.say(f"{count(len(elements), 'element')} of revision {revision} -> {job.written}")


@click.command()
@click.argument("stored", metavar="MAP", type=click.Path(path_type=Path))
@click.option("--revision", type=click.IntRange(1), required=True, help="Which one; history lists them.")
@click.option("--until", type=click.IntRange(1), help="With it all from --revision to this one.")
@_patience
@run_options
def undo(stored: Path, *, revision: int, until: int | None, patience: float, **chosen: Any) -> None:
    """Take back what came with a revision of the stored map MAP, as if it had never been told of it."""
    with Job(None, [], [], **split_off(chosen)) as job:
        job.progress(0.1, "taking local maps out")
        report = pm.MapStore(stored, patience_s=patience).undo(revision, until).report()
        job.report(report)
    which = str(revision) if until in (None, revision) else f"{revision} to {until}"
    console.say(f"revision {which} taken back; {_what_changed(report)} -> {stored}, revision {report['revision']}")


@click.command()
@click.argument("stored", metavar="MAP", type=click.Path(path_type=Path))
def verify(stored: Path) -> None:
    """Check that everything that must hold of the file of the stored map MAP does."""
    found = pm.MapStore(stored).verify()
    if found:
        raise pm.InputError(f"{stored} is damaged: {'; '.join(found)}; restore it from a copy")
    console.say(f"{stored} is whole")


COMMANDS = (update, history, changes, restore, undo, verify)
