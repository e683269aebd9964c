"""Local maps and merged maps by the layer contract, with the files that were written beside them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from polymerge_core.io.decoding import LayerInfo, known_layers, read_columns, read_layer
from polymerge_core.io.drivers import FORMATS
from polymerge_core.io.fields import SHAPEFILE_NAMES, fit_names
from polymerge_core.io.naming import companion_path, holds_one_layer, tables_beside
from polymerge_core.io.reading import choose_layers, list_layers, read_chosen, read_layers, read_table
from polymerge_core.io.sources import opened, split_source
from polymerge_core.schema import (
    ALIASES_TABLE,
    AREAS_LAYER,
    ELEMENTS_LAYER,
    INSTANCES_LAYER,
    LEFT_OUT_TABLE,
    LOCAL_MAPS_LAYER,
    LocalMaps,
)

_ID_COLUMNS = {"element_id", SHAPEFILE_NAMES["element_id"]}
_LOCAL_MAP_COLUMNS = {"drive", "instance"}
_INSTANCE_COLUMNS = ("drive", "instance", "timestamp_ns", "x", "y", "heading", "n_observations")


def read_local_maps(sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[LocalMaps]:
    """Read local maps by the layer contract.

    Parameters
    ----------
    sources : path, or iterable of path
        One file, or several; each as a path, or as ``FILE|layername=LAYER``. A file without a layer means its
        layer ``local_maps`` (with the layer ``instances`` and the table ``left_out`` beside it) where there is one,
        else its layer ``elements`` (and ``elements_areas`` and the table ``id_aliases``), else all its line and
        polygon layers.
        For a file of one layer, the files that `write_layers` put beside it are read as these:
        ``<stem>_instances.<ext>`` with the table ``left_out`` of ``<stem>_tables.gpkg``, or ``<stem>_areas.<ext>``
        and the table ``id_aliases`` where the file holds elements.

    Returns
    -------
    list of LocalMaps
        One for each layer, in the order given. Its source is the file's stem, or the layer's name where a
        file gives several; where two would be called the same, the shortest end of their paths that tells
        them apart (``monday/track``). The same layer given twice keeps its one name.

    Raises
    ------
    InputError
        As for `read_layers`.
    CrsError
        As for `read_layers`.
    """
    several = [sources] if isinstance(sources, (str, os.PathLike)) else sources
    given = [split_source(source) for source in several]
    named = {file.resolve() for file, _ in given}
    found: list[tuple[Path, str, LocalMaps]] = []
    for file, layer in given:
        beside = _companions(file, layer)
        found += [(file, name, _complete(maps, beside)) for name, maps in _read_file(file, layer).items()]
        areas = beside.get(AREAS_LAYER)
        if areas is not None and areas.resolve() not in named:
            # A map without areas may have an empty layer of them, which is no local map of its own.
            found += [(areas, name, maps) for name, maps in _read_file(areas).items() if len(maps.observations)]
    titles = _source_names([(file, name) for file, name, _ in found])
    return [replace(maps, source=title) for title, (_, _, maps) in zip(titles, found, strict=True)]


def source_files(source: str | os.PathLike[str]) -> list[Path]:
    """List the files that `read_local_maps` reads for a source.

    Parameters
    ----------
    source : path
        A file, or ``FILE|layername=LAYER``.

    Returns
    -------
    list of Path
        The file, and those that were written beside it. A run must not write to any of them.

    Raises
    ------
    InputError
        As for `read_layers`.
    """
    file, layer = split_source(source)
    return [file, *_companions(file, layer).values()]


def is_merged_map(file: Path) -> bool:
    """Whether a file is there and holds elements, which have ids of their own."""
    return not _columns(file).isdisjoint(_ID_COLUMNS)


def _companions(file: Path, layer: str | None) -> dict[str, Path]:
    """Find what was written beside a file of one layer, by layer name; its columns say what belongs together."""
    if not holds_one_layer(file):
        return {}
    areas, tables = companion_path(file, AREAS_LAYER, ELEMENTS_LAYER), tables_beside(file)
    if is_merged_map(file):
        has_areas = layer is None and is_merged_map(areas)
        has_aliases = any(each.name == ALIASES_TABLE for each in _layers(tables))
        return ({AREAS_LAYER: areas} if has_areas else {}) | ({ALIASES_TABLE: tables} if has_aliases else {})
    instances = companion_path(file, INSTANCES_LAYER, LOCAL_MAPS_LAYER)
    if not (_columns(instances).issuperset(_written_as(file)) and _columns(file).issuperset(_LOCAL_MAP_COLUMNS)):
        return {}
    has_left_out = any(each.name == LEFT_OUT_TABLE for each in _layers(tables))
    return {INSTANCES_LAYER: instances} | ({LEFT_OUT_TABLE: tables} if has_left_out else {})


def _columns(file: Path) -> set[str]:
    return {name for layer in _layers(file) for name in layer.fields}


def _layers(file: Path) -> list[LayerInfo]:
    # pathlib raises an error for a name that is too long; no such file can be there.
    return list_layers(file) if os.path.isfile(file) else []  # noqa: PTH113


def _written_as(file: Path) -> dict[str, str]:
    """Return the names that the columns of instances have in a file, and what they mean."""
    names = fit_names(_INSTANCE_COLUMNS, FORMATS[file.suffix.lower()], str(file))
    return dict(zip(names, _INSTANCE_COLUMNS, strict=True))


def _complete(maps: LocalMaps, beside: dict[str, Path]) -> LocalMaps:
    """Add what was written beside the observations."""
    if ALIASES_TABLE in beside:
        return replace(maps, id_aliases=read_table(beside[ALIASES_TABLE], ALIASES_TABLE))
    if INSTANCES_LAYER not in beside:
        return maps
    file = beside[INSTANCES_LAYER]
    (instances,) = read_layers(file).values()
    left_out = read_table(beside[LEFT_OUT_TABLE], LEFT_OUT_TABLE) if LEFT_OUT_TABLE in beside else None
    return replace(maps, instances=instances.rename(columns=_written_as(file)), left_out=left_out)


def _read_file(file: Path, layer: str | None = None) -> dict[str, LocalMaps]:
    """Read the layers of one file that are meant, by their names."""
    with opened(file) as source:
        known = known_layers(source)
        chosen = choose_layers(source, known, layer or _contract_layer(known))
        if layer is None and chosen[0].name == ELEMENTS_LAYER:
            chosen += [each for each in known if each.name == AREAS_LAYER]
        maps = {name: LocalMaps(frame) for name, frame in read_chosen(source, chosen).items()}
        if LOCAL_MAPS_LAYER in maps:
            beside = {each.name: each for each in known}
            instances = read_layer(source, beside[INSTANCES_LAYER]) if INSTANCES_LAYER in beside else None
            left_out = read_columns(source, beside[LEFT_OUT_TABLE]) if LEFT_OUT_TABLE in beside else None
            maps[LOCAL_MAPS_LAYER] = replace(maps[LOCAL_MAPS_LAYER], instances=instances, left_out=left_out)
        aliases = next((each for each in known if each.name == ALIASES_TABLE), None)
        if ELEMENTS_LAYER in maps and aliases is not None:
            maps[ELEMENTS_LAYER] = replace(maps[ELEMENTS_LAYER], id_aliases=read_columns(source, aliases))
    return maps


def _contract_layer(known: Sequence[LayerInfo]) -> str | None:
    names = [each.name for each in known]
    return next((name for name in (LOCAL_MAPS_LAYER, ELEMENTS_LAYER) if name in names), None)


def _source_names(layers: Sequence[tuple[Path, str]]) -> list[str]:
    """Name each layer by the shortest end of its path that no other layer has."""
    spelled: dict[tuple[Path, str], Path] = {}
    keys = [(file.resolve(), name) for file, name in layers]
    for key, (file, _) in zip(keys, layers, strict=True):
        spelled[key] = min(spelled.get(key, file.absolute()), file.absolute())
    several = {file for file, _ in spelled if sum(other == file for other, _ in spelled) > 1}
    tails: dict[tuple[Path, str], tuple[str, ...]] = {}
    for key, path in spelled.items():
        tails[key] = (*path.parts[:-1], path.stem, *([key[1]] if key[0] in several else []))
    alike = [key for key in tails if list(tails.values()).count(tails[key]) > 1]  # track.shp beside track.gpkg
    for key in alike:
        stem_at = len(spelled[key].parts) - 1
        tails[key] = (*tails[key][:stem_at], spelled[key].name, *tails[key][stem_at + 1 :])
    titles = {}
    for key, tail in tails.items():
        others = [other for unlike, other in tails.items() if unlike != key]
        lengths = range(1, len(tail) + 1)
        length = next((n for n in lengths if all(other[-n:] != tail[-n:] for other in others)), len(tail))
        titles[key] = "/".join(tail[-length:])
    return [titles[key] for key in keys]
