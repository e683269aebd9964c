"""How well a stored map follows the road: changes found, false ones, the error after ever more drives, frame by frame.

    python benchmarks/dynamics.py --data FOLDER [--only PART ...] [-o dynamics.json]

Drives are simulated on real roads (Argoverse 2; without FOLDER through the simulated town). ``changes``: after the
second drive dividers vanish, a boundary moves by 1.5 m, a divider is painted 0.8 m aside, and a crossing and a divider
appear. ``errors``: how far the map is off after 1, 2, 4 and 8 drives. ``unchanged``: what is taken for a change on a
road that stays as it is. ``frames``: a map that was fed one frame at a time beside one that was fed all at once.
``real``: the real drives of `deecamp`, one after another.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import polymerge_core as pm
from benchmarks.noise import Noise
from benchmarks.scenarios import MIAMI, PITTSBURGH, Road, Scenario, av2_road, deecamp, town_road
from polymerge_core.observations import as_lines
from polymerge_core.store.evidence import as_area

#: The road changes after so many drives, and is looked at after so many.
CHANGED_AFTER, LOOKED_AT, DRIVES = 2, 5, 8

#: What changes is in view of so many of the 15 frames of each drive for this long, metres.
FRAMES_IN_VIEW, LENGTH_M = 5, 15.0

#: How far a boundary moves and a divider is painted aside, metres.
BOUNDARY_M, DIVIDER_M = 1.5, 0.8

#: A change counts as found where what was found lies along half of it, no farther away than this, metres.
_NEAR = 2.5

#: What lies along the road's for the most part, no farther away than this, metres, is really there.
_THERE = 1.5

#: The error is looked at after so many drives, of these classes.
STAGES, LINES = (1, 2, 4, 8), ("divider", "boundary")

PARTS = ("changes", "errors", "unchanged", "frames", "real")

_DAY_NS = 86_400_000_000_000


@dataclass(frozen=True)
class Change:
    """Something that is another on the changed road: where it was and where it is, None where it is not."""

    kind: str
    cls: str
    old: shapely.Geometry | None
    new: shapely.Geometry | None


def in_view(drive: Scenario) -> shapely.Geometry:
    """Return what at least `FRAMES_IN_VIEW` frames of a drive look at."""
    footprints = drive.local[0].instances.geometry.to_numpy()
    faces = shapely.get_parts(
        shapely.polygonize(shapely.get_parts(shapely.node(shapely.union_all(shapely.boundary(footprints)))))
    )
    points = shapely.point_on_surface(faces)
    count = np.array([int(shapely.contains(footprints, point).sum()) for point in points])
    return shapely.union_all(faces[count >= FRAMES_IN_VIEW])


def changed_road(road: Road, seed: int, seen: shapely.Geometry) -> tuple[Road, Road, list[Change]]:
    """Return the road before and after it changes, and what changes, all of it within view.

    Parameters
    ----------
    road : Road
        The true road.
    seed : int
        Of the choice.
    seen : Polygon or MultiPolygon
        What drives look at.
    """
    rng = np.random.default_rng(seed)
    truth = road.truth
    inside = shapely.length(shapely.intersection(truth.geometry.to_numpy(), seen))
    share = inside / np.maximum(shapely.length(truth.geometry.to_numpy()), 1e-9)
    cls = truth["class"].to_numpy()
    dividers = rng.permutation(np.flatnonzero((cls == "divider") & (inside > LENGTH_M)))
    boundaries = rng.permutation(np.flatnonzero((cls == "boundary") & (inside > LENGTH_M)))
    crossings = rng.permutation(np.flatnonzero((cls == "ped_crossing") & (share > 0.99)))
    vanish, appear, paint = dividers[:2], dividers[2:3], dividers[3:4]
    move, new = boundaries[:1], crossings[:1]
    before, after = truth.drop(index=truth.index[[*appear, *new]]), truth.drop(index=truth.index[vanish])
    found = [Change("vanished", "divider", truth.geometry.iloc[row], None) for row in vanish]
    found += [Change("appeared", cls[row], None, truth.geometry.iloc[row]) for row in [*appear, *new]]
    for rows, by in ((move, BOUNDARY_M), (paint, DIVIDER_M)):
        for row in rows:
            old = truth.geometry.iloc[row]
            aside = _aside(old, by)
            after.loc[truth.index[row], "geometry"] = aside
            found.append(Change("moved", cls[row], old, aside))
    return replace(road, truth=before), replace(road, truth=after), found


def _aside(line: shapely.Geometry, by: float) -> shapely.Geometry:
    """Move a line sideways: every stretch of it to the left by as much."""
    parts = shapely.get_parts(shapely.line_merge(shapely.offset_curve(line, by, join_style="mitre")))
    return parts[np.argmax(shapely.length(parts))]


def drives(road: Road, later: Road, seed: int, noise: Noise | None, count: int) -> list[Scenario]:
    """Return drives along the same way, a day apart, the later ones on the changed road."""
    found = []
    for number in range(count):
        here = road if number < CHANGED_AFTER else later
        drive = here.drive(f"drive {number}", seed=1000 * seed + number, noise=noise)
        (local,) = drive.local
        shift = number * _DAY_NS
        seen = local.observations.assign(timestamp=local.observations["timestamp"] + shift)
        instances = local.instances.assign(timestamp_ns=local.instances["timestamp_ns"] + shift)
        found.append(replace(drive, local=[replace(local, observations=seen, instances=instances)]))
    return found


def renewals(path: Path) -> gpd.GeoDataFrame:
    """Return where the map found that the road changed."""
    found = gpd.read_file(path, layer="renewed")
    return found.set_geometry(found.geometry)


def follow(road: Road, seed: int, noise: Noise | None, folder: Path) -> dict[str, Any]:
    """Feed a map drives on a road that changes; count what it found."""
    seen = in_view(road.drive("look", seed=seed, noise=noise))
    before, after, changes = changed_road(road, seed, seen)
    store = pm.MapStore(folder / f"{seed}.gpkg", create=True)
    for drive in drives(before, after, seed, noise, LOOKED_AT):
        store.update(drive.local)
    zones = renewals(store.path)
    right = np.zeros(len(zones), dtype=bool)
    found = []
    for change in changes:
        lines = [line for line in (change.old, change.new) if line is not None]
        along = shapely.union_all([shapely.intersection(line, seen) for line in lines])
        near = shapely.buffer(along, _NEAR)
        own = (zones["class"] == change.cls).to_numpy() & (
            shapely.area(shapely.intersection(zones.geometry.to_numpy(), near)) > 0.5 * zones.area.to_numpy()
        )
        right |= own
        kinds = set(zones.loc[own, "kind"])
        covered = shapely.union_all(zones.geometry.to_numpy()[own])
        told = [shapely.intersection(line, seen) for line in lines]
        enough = any(shapely.intersection(line, covered).length > 0.5 * line.length for line in told)
        wanted = {"vanished": {"vanished"}, "appeared": {"appeared"}, "moved": {"moved", "vanished", "appeared"}}
        found.append((change.kind, bool(enough and kinds & wanted[change.kind])))
    if store.verify():
        raise AssertionError(store.verify())
    return {
        "found": found,
        "zones": len(zones),
        "right": int(right.sum()),
        "wrong": zones.loc[~right, ["class", "kind"]].value_counts().to_dict(),
    }


def errors(road: Road, seed: int, folder: Path) -> list[dict[str, float]]:
    """Feed a map drives on a road that stays as it is; return its error after some of them."""
    store = pm.MapStore(folder / f"errors_{seed}.gpkg", create=True)
    found = []
    for number, drive in enumerate(drives(road, road, seed, None, DRIVES), 1):
        store.update(drive.local)
        if number in STAGES:
            result = pm.evaluate(store.elements(), road.truth, local_maps=drive.local)
            found.append({name: result.value(name, "lateral_median") for name in LINES})
    return found


def unchanged(road: Road, seed: int, count: int, path: Path) -> dict[str, Any]:
    """Feed a map drives on a road that stays as it is; count what it takes for changes, and what it loses."""
    store = pm.MapStore(path, create=True)
    lost = dict.fromkeys(("retired", "of these really there", "merged"), 0)
    for number, drive in enumerate(drives(road, road, seed, None, count)):
        before = store.elements().query("state == 'confirmed'") if number else None
        done = store.update(drive.local)
        if before is not None:
            now = store.changes(done.revision - 1)
            retired, merged = (
                before[before["element_id"].isin(now.loc[now["kind"] == kind, "element_id"])]
                for kind in ("retired", "merged")
            )
            lost["retired"] += len(retired)
            told = zip(retired["class"], retired.geometry, strict=True)
            lost["of these really there"] += sum(is_there(cls, shape, road) for cls, shape in told)
            lost["merged"] += len(merged)
    kinds = renewals(store.path)["kind"].value_counts().to_dict()
    return {"confirmed elements lost": lost, "taken for changes": kinds, "elements": len(store.elements())}


def is_there(cls: str, shape: shapely.Geometry, road: Road) -> bool:
    """Return whether an element is really there: half of an area within one of the road's, half of a line along one."""
    true = road.truth.geometry[road.truth["class"] == cls].to_numpy()
    if cls == "ped_crossing":
        area, areas = as_area(shape), np.array([as_area(each) for each in true])
        return bool(shapely.area(shapely.intersection(areas, area)).max(initial=0.0) > 0.5 * area.area)
    along = shapely.intersection(shape, shapely.union_all(shapely.buffer(true, _THERE)))
    return bool(along.length > 0.5 * shape.length)


def apart(one: gpd.GeoDataFrame, other: gpd.GeoDataFrame) -> dict[str, float]:
    """Return how many elements two maps have, and how far points along either are from the class in the other."""
    found = []
    for left, right in ((one, other), (other, one)):
        for cls, own in left.groupby("class"):
            there = shapely.multilinestrings(as_lines(right.geometry[right["class"] == cls].to_numpy()))
            points = [
                shapely.line_interpolate_point(line, np.arange(0.5, line.length, 1.0))
                for line in as_lines(own.geometry.to_numpy())
            ]
            found.append(shapely.distance(there, np.concatenate(points)))
    every = np.nan_to_num(np.concatenate(found), nan=np.inf)
    counts = {"one by one": len(one), "at once": len(other)}
    return counts | {"median": float(np.median(every)), "p95": float(np.quantile(every, 0.95))}


def one_by_one(local: list[pm.LocalMaps], folder: Path, draw_every: int) -> dict[str, float]:
    """Feed a map frame by frame, drawing every so many, and another one all of them at once; compare the two."""
    path = folder / "frames.gpkg"
    path.unlink(missing_ok=True)
    store = pm.MapStore(path, create=True)
    waiting = 0
    for maps in local:
        for row in range(len(maps.instances)):
            instance = maps.instances.iloc[[row]]
            own = maps.observations["instance"] == instance["instance"].iloc[0]
            waiting += 1
            store.update(
                replace(maps, observations=maps.observations[own], instances=instance, left_out=None),
                draw=waiting % draw_every == 0,
            )
    store.draw()
    path.with_name("at_once.gpkg").unlink(missing_ok=True)
    at_once = pm.MapStore(path.with_name("at_once.gpkg"), create=True)
    at_once.update(local)
    return apart(store.elements(), at_once.elements())


def real(data: Path, folder: Path) -> list[dict[str, float]]:
    """Feed a map the real drives one after another; return its error after some, and that of each drive by itself."""
    scenario = deecamp(data)
    store = pm.MapStore(folder / "deecamp.gpkg", create=True)
    found = []

    def error(held: pm.MapStore, local: list[pm.LocalMaps]) -> float:
        result = pm.evaluate(held.elements(), scenario.truth, local_maps=local, crs="local")
        return float(result.value("divider", "lateral_median"))

    alone = []
    for number, local in enumerate(scenario.local):
        single = pm.MapStore(folder / f"alone_{number}.gpkg", create=True)
        single.update(local)
        alone.append(error(single, [local]))
    found.append({"drives": 1, "lateral_median": float(np.mean(alone)), "least": min(alone), "most": max(alone)})
    for number, local in enumerate(scenario.local, 1):
        start = time.perf_counter()
        store.update(local)
        took = time.perf_counter() - start
        if number in (*STAGES, len(scenario.local)):
            off = error(store, scenario.local[:number])
            found.append({"drives": number, "lateral_median": off, "elements": len(store.elements()), "s": took})
    return found


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder of the real data")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--unchanged", type=int, default=50, help="drives over a road that stays as it is")
    parser.add_argument("--only", choices=PARTS, nargs="+", default=PARTS)
    parser.add_argument("--draw-every", type=int, default=100, help="of the real frames one by one")
    parser.add_argument("-o", "--output", type=Path, help="JSON file for the figures")
    options = parser.parse_args()
    roads = {"town": town_road()}
    if options.data:
        roads = {"Miami": av2_road(options.data, MIAMI), "Pittsburgh": av2_road(options.data, PITTSBURGH)}
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        if "changes" in options.only:
            figures["changes"] = _changes(roads, options.seeds, Path(name))
        if "errors" in options.only:
            figures["errors"] = _errors(roads, options.seeds, Path(name))
        if "frames" in options.only:
            figures["frames"] = _frames(roads, options, Path(name))
        if "unchanged" in options.only:
            for road, held in roads.items():
                figures[f"unchanged {road}"] = told = unchanged(held, 7, options.unchanged, Path(name, f"{road}.gpkg"))
                print(f"{road}, {options.unchanged} drives, nothing changes: {told}", flush=True)
        if "real" in options.only and options.data:
            figures["real"] = real(options.data, Path(name))
            print(pd.DataFrame(figures["real"]).round(3).to_string(index=False), flush=True)
    if options.output:
        options.output.write_text(json.dumps(figures, indent=2, default=str) + "\n", encoding="utf-8")


def _errors(roads: dict[str, Road], seeds: int, folder: Path) -> dict[str, Any]:
    """Print the error after some drives, in the mean over seeds, and beside that after the first."""
    figures = {}
    for name, road in roads.items():
        every = [errors(road, seed, folder) for seed in range(seeds)]
        for cls in LINES:
            mean = np.mean([[stage[cls] for stage in told] for told in every], axis=0)
            figures[f"{name}, {cls}"] = mean.tolist()
            told = ", ".join(f"{value:.3f}" for value in mean)
            print(f"{name}, {cls}, {seeds} seeds, after {STAGES} drives: {told} ({mean[-1] / mean[0]:.2f})", flush=True)
        for seed in range(seeds):
            (folder / f"errors_{seed}.gpkg").unlink()
    return figures


def _frames(roads: dict[str, Road], options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    figures = {}
    for name, road in roads.items():
        for seed in range(options.seeds):
            (drive,) = road.drive("drive 0", seed=seed, noise=None).local
            figures[f"{name}, {seed}"] = told = one_by_one([drive], folder, 1)
            print(f"{name}, seed {seed}, one frame at a time: {_rounded(told)}", flush=True)
    if options.data:
        figures["deecamp"] = told = one_by_one(deecamp(options.data).local, folder, options.draw_every)
        print(f"deecamp, one frame at a time, drawn every {options.draw_every}: {_rounded(told)}", flush=True)
    return figures


def _rounded(told: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 3) for name, value in told.items()}


def _changes(roads: dict[str, Road], seeds: int, folder: Path) -> dict[str, Any]:
    rows = []
    for name, road in roads.items():
        for seed in range(seeds):
            told = follow(road, seed, None, folder)
            rows.append(told)
            print(f"{name}, seed {seed}: {told}", flush=True)
            (folder / f"{seed}.gpkg").unlink()
    every = [each for told in rows for each in told["found"]]
    figures = {
        kind: (sum(ok for name, ok in every if name == kind), sum(name == kind for name, _ in every))
        for kind in ("vanished", "appeared", "moved")
    }
    figures["precision"] = (sum(told["right"] for told in rows), sum(told["zones"] for told in rows))
    for name, (right, count) in figures.items():
        print(f"{name}: {right} of {count} ({right / max(count, 1):.2f})", flush=True)
    return figures


if __name__ == "__main__":
    main()
