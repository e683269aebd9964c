"""What the commands of the command line share: options, and how they word what they did."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from polymerge_core.crs import parse_crs
from polymerge_core.errors import CrsError, OptionError
from polymerge_core.options import INSTANCE_FROM

_Command = TypeVar("_Command", bound=Callable[..., Any])


def decorate(*options: Callable[[_Command], _Command]) -> Callable[[_Command], _Command]:
    """Return options as one."""

    def apply(command: _Command) -> _Command:
        for option in reversed(options):
            command = option(command)
        return command

    return apply


def known_crs(_context: click.Context, _option: click.Parameter, text: str | None) -> str | None:
    """Refuse a CRS that nobody knows before anything is read."""
    if text is not None:
        try:
            parse_crs(text)
        except CrsError as error:
            raise OptionError(str(error)) from error
    return text


output_option = click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), help="The file to write."
)

run_options = decorate(
    click.option("--overwrite", is_flag=True, help="Replace existing outputs."),
    click.option("--json", "report_file", metavar="FILE", help="Write a report as JSON; - for standard output."),
    click.option("--progress", type=click.Choice(["auto", "json", "none"]), default="auto", show_default=True),
    click.option("--watch-stdin", is_flag=True, help="Stop, leaving nothing behind, when standard input closes."),
)

source_options = decorate(
    click.option("--class-field", help="Column of the class.  [default: class, if there is one]"),
    click.option("--class-name", default="line", show_default=True, help="The class where no column names one."),
    click.option("--drive-field", help="Column of the drive or survey.  [default: drive, else the file's name]"),
    click.option("--instance-field", help="Column of the local map (frame).  [default: instance, if there is one]"),
    click.option("--instance-from", type=click.Choice(INSTANCE_FROM), help="What a local map is."),
    click.option("--score-field", help="Column of the confidence, 0 to 1.  [default: score, else 1]"),
    click.option("--min-score", type=float, default=0.0, show_default=True, help="Leave out what is under it."),
    click.option("--timestamp-field", help="Column that orders the local maps.  [default: timestamp, if any]"),
)

reading_options = decorate(
    click.option("--main-map", metavar="MAP", help="The map to merge into; its element_id are kept."),
    source_options,
    click.option(
        "--proximity", type=float, default=1.0, show_default=True, help="How near is near, in metres (Th_prox)."
    ),
    click.option("--area", multiple=True, metavar="CLASS", help="A class of areas, beside ped_crossing; repeatable."),
    click.option("--crs", callback=known_crs, help="CRS of layers without one, such as EPSG:32632, or local."),
    click.option(
        "--out-crs", callback=known_crs, help="CRS of the result.  [default: the main map's, else the first layer's]"
    ),
    click.option("--strict", is_flag=True, help="A feature that cannot be used is an error."),
)


def count(number: int, noun: str) -> str:
    """Return a number of things in words."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def left_out(reasons: dict[str, int]) -> str:
    """Return what was left out and why, to be put behind what was not."""
    if not reasons:
        return ""
    listed = ", ".join(f"{reason}: {count}" for reason, count in sorted(reasons.items()))
    return f"; {sum(reasons.values())} left out ({listed})"
