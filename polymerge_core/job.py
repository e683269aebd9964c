"""One run of a command: what it reads and writes, its report, its progress."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import geopandas as gpd
import numpy as np
import pandas as pd

from polymerge_core import console
from polymerge_core.errors import OptionError
from polymerge_core.io import layer_targets, source_files, stage_layers
from polymerge_core.outputs import StagedOutputs


class Job:
    """One run of a command: its outputs appear together at the end, or not at all.

    Parameters
    ----------
    output : Path, optional
        The file of layers.
    inputs : sequence of str
        What it reads; none of it may be written to.
    layers, tables : sequence of str
        Those that it writes whatever comes out.
    pages : sequence of Path
        Other files that it writes.
    overwrite, report_file, progress, watch_stdin
        The options of every run.
    """

    def __init__(
        self,
        output: Path | None,
        inputs: Sequence[str],
        layers: Sequence[str],
        *,
        tables: Sequence[str] = (),
        pages: Sequence[Path] = (),
        overwrite: bool,
        report_file: str | None,
        progress: console.ProgressMode,
        watch_stdin: bool,
    ) -> None:
        self._output, self._report_file, self._printed = output, report_file, ""
        if not all(inputs):
            raise OptionError("the name of an input is empty; name a file")
        files = [file for path in inputs for file in source_files(path)]
        self._outputs = StagedOutputs(overwrite=overwrite, inputs=files)
        report = [Path(report_file)] if report_file not in (None, "-") else []
        # All layers of a run are known at its end; those that are certain are checked before its work.
        certain = {name: gpd.GeoDataFrame() for name in layers} | {name: pd.DataFrame() for name in tables}
        targets = {} if output is None else layer_targets(output, certain)
        self._outputs.check([*dict.fromkeys(targets.values()), *pages, *report])
        #: Called with the fraction done and a message.
        self.progress = console.ProgressReport(progress)
        #: What was written, in words.
        self.written = ", ".join(map(str, pages))
        if watch_stdin:
            console.watch_stdin()

    def __enter__(self) -> Job:  # noqa: PYI034 - typing.Self is newer than Python 3.10
        self._outputs.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        if error[0] is None:
            self.progress(1.0, "done")
        try:
            self._outputs.__exit__(*error)  # type: ignore[arg-type]
        finally:
            self.progress.close()
        if error[0] is None and self._printed:
            # Whoever reads this may go on to the outputs, so they must be there.
            click.echo(self._printed, nl=False)

    def write(self, layers: dict[str, Any], fraction: float) -> None:
        """Stage the layers; `fraction` is how far the run is when writing starts."""
        self.progress(fraction, "writing")
        if self._output is None:
            return
        done = stage_layers(self._outputs, self._output, layers)
        names = [path.name if path != self._output else str(path) for path in done.paths]
        self.written = ", ".join([*([self.written] if self.written else []), *names])
        for layer, changed in done.renamed.items():
            for old, new in changed.items():
                console.say(f"column {old!r} of layer {layer!r} is called {new!r} in the file")

    def page(self, path: Path, text: str) -> None:
        """Stage a text file."""
        self._outputs.stage(path).write_text(text, encoding="utf-8")

    def report(self, content: dict[str, Any]) -> None:
        """Stage the JSON report, or keep it until the end where it goes to standard output."""
        if self._report_file is None:
            return
        # Standard output may be a terminal that knows few letters.
        printed = self._report_file == "-"
        text = json.dumps(content, indent=2, ensure_ascii=printed, default=_plain) + "\n"
        if printed:
            self._printed = text
        else:
            self._outputs.stage(self._report_file).write_text(text, encoding="utf-8")


def split_off(chosen: dict[str, Any]) -> dict[str, Any]:
    """Take the options of `Job` out of a command's options."""
    return {name: chosen.pop(name) for name in ("overwrite", "report_file", "progress", "watch_stdin")}


def _plain(value: Any) -> Any:
    """Turn numpy's numbers into JSON's."""
    if isinstance(value, np.generic):
        return value.item()
    return str(value)
