"""How well a stored map follows the road: changes found, false ones, and the error after ever more drives.

    python benchmarks/dynamics.py --data FOLDER

Drives are simulated on real roads (Argoverse 2; without FOLDER through the simulated town). After the second drive
dividers vanish, a boundary moves by 1.5 m, a divider is painted 0.8 m aside, and a crossing and a divider appear. The
real drives of `deecamp` are fed one after another.
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

#: The road changes after so many drives, and is looked at after so many.
CHANGED_AFTER, LOOKED_AT, DRIVES = 2, 5, 8

#: What changes is in view of so many of the 15 frames of each drive for this long, metres.
FRAMES_IN_VIEW, LENGTH_M = 5, 15.0

#: How far a boundary moves and a divider is painted aside, metres.
BOUNDARY_M, DIVIDER_M = 1.5, 0.8

#: A change counts as found where what was found lies along half of it, no farther away than this, metres.
_NEAR = 2.5

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
    """Move a line sideways as a whole: across the direction from its one end to the other."""
    points = shapely.get_coordinates(line)
    along = points[-1] - points[0] if np.any(points[-1] != points[0]) else np.array([1.0, 0.0])
    normal = np.array([-along[1], along[0]]) / np.hypot(*along)
    return shapely.transform(line, lambda xy: xy + by * normal)


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


def unchanged(road: Road, seed: int, count: int, folder: Path) -> dict[str, Any]:
    """Feed a map drives on a road that stays as it is; count what it takes for changes, and its error."""
    store = pm.MapStore(folder / f"unchanged_{seed}.gpkg", create=True)
    errors, retired = [], 0
    for number, drive in enumerate(drives(road, road, seed, None, count), 1):
        sure = set(store.elements().query("state == 'confirmed'")["element_id"]) if number > 1 else set()
        done = store.update(drive.local)
        now = store.changes(done.revision - 1) if number > 1 else None
        if now is not None:
            retired += int((now["element_id"].isin(sure) & (now["kind"] == "retired")).sum())
        if number in (1, 2, 4, 8):
            result = pm.evaluate(store.elements(), road.truth, local_maps=drive.local)
            errors.append({name: result.value(name, "lateral_median") for name in ("divider", "boundary")})
    kinds = renewals(store.path)["kind"].value_counts().to_dict()
    return {"errors": errors, "retired": retired, "taken for changes": kinds}


def real(data: Path, folder: Path) -> list[dict[str, float]]:
    """Feed a map the real drives one after another; return its error after some."""
    scenario = deecamp(data)
    store = pm.MapStore(folder / "deecamp.gpkg", create=True)
    found = []
    for number, local in enumerate(scenario.local, 1):
        start = time.perf_counter()
        store.update(local)
        took = time.perf_counter() - start
        if number in (1, 2, 4, 8, 14):
            result = pm.evaluate(store.elements(), scenario.truth, local_maps=scenario.local[:number], crs="local")
            error = result.value("divider", "lateral_median")
            found.append({"drives": number, "lateral_median": error, "elements": len(store.elements()), "s": took})
    return found


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder of the real data")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--unchanged", type=int, default=50, help="drives over a road that stays as it is")
    parser.add_argument(
        "--only", choices=["changes", "unchanged", "real"], nargs="+", default=["changes", "unchanged", "real"]
    )
    parser.add_argument("-o", "--output", type=Path, help="JSON file for the figures")
    options = parser.parse_args()
    roads = {"town": town_road()}
    if options.data:
        roads = {"Miami": av2_road(options.data, MIAMI), "Pittsburgh": av2_road(options.data, PITTSBURGH)}
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        if "changes" in options.only:
            figures["changes"] = _changes(roads, options.seeds, Path(name))
        if "unchanged" in options.only:
            for road, held in roads.items():
                figures[f"unchanged {road}"] = told = unchanged(held, 7, options.unchanged, Path(name))
                print(f"{road}, {options.unchanged} drives, nothing changes: {told}", flush=True)
        if "real" in options.only and options.data:
            figures["real"] = real(options.data, Path(name))
            print(pd.DataFrame(figures["real"]).round(3).to_string(index=False), flush=True)
    if options.output:
        options.output.write_text(json.dumps(figures, indent=2, default=str) + "\n", encoding="utf-8")


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
