"""The published method, written out loop for loop: Alg. 1, eq. 2 and the four scenarios.

This is the yardstick of `polymerge_core`, of which it imports nothing. It is slow on purpose: plain floats,
lists of (x, y) tuples, one statement for one step of the paper, so that it can be checked by reading. It
knows lines only; area classes have tests of their own.

Points that the paper leaves open, as settled for this project:

- A segment shorter than 1e-9 m is removed before anything else, never afterwards: in exact arithmetic no
  scenario makes one (see `merge_vertex`).
- Of equally near segments the one with the lowest index wins. The scenario follows from the clamped segment
  parameter, compared with 0 and 1 exactly.
- Without a main map, the first instance in the order is the main map. Two polylines of the main map get no
  edge.
- The base of a component is its longest main-map polyline; without one, the longest polyline of its earliest
  instance.
- The others follow by (steps from the base in the network, instance order, sort key), those of the main map
  before all others that are as many steps away.
"""

from __future__ import annotations

import math
from typing import NamedTuple

Point = tuple[float, float]
Line = list[Point]

SHORTEST_SEGMENT_M = 1e-9


class Polyline(NamedTuple):
    """One observation.

    `instance_rank` is the place of its instance in the order of instances. `key` breaks the ties left: (WKB
    of the normalised geometry, WKB of the geometry as it is), handed in to need no geometry library here.
    """

    points: Line
    cls: str
    instance_rank: int
    is_main: bool
    key: tuple[bytes, bytes]


class Foot(NamedTuple):
    """The projection of a point onto a polyline: where it lies and how far away."""

    segment: int
    parameter: float
    point: Point
    distance: float


class Merged(NamedTuple):
    """Edges of the network, the merged lines, and the indices of the polylines that each was made of."""

    edges: set[frozenset[int]]
    elements: list[Line]
    members: list[list[int]]


def remove_short_segments(line: Line) -> Line:
    """Drop vertices until no segment is shorter than 1e-9 m; both ends stay."""
    kept = [line[0]]
    for vertex in line[1:]:
        if math.dist(kept[-1], vertex) >= SHORTEST_SEGMENT_M:
            kept.append(vertex)
    if kept[-1] != line[-1]:
        kept[-1] = line[-1]
    return kept


def project_to_segment(a: Point, b: Point, c: Point) -> tuple[float, Point]:
    """Eq. 2: the segment parameter of A on the segment BC, clamped to [0, 1], and the point D there."""
    ax, ay = a
    bx, by = b
    cx, cy = c
    t = ((ax - bx) * (cx - bx) + (ay - by) * (cy - by)) / ((cx - bx) * (cx - bx) + (cy - by) * (cy - by))
    t = max(0.0, min(1.0, t))
    if t == 1.0:
        return t, c
    return t, (bx + t * (cx - bx), by + t * (cy - by))


def project(a: Point, line: Line) -> Foot:
    """Projection of A onto the nearest segment of a polyline; of equally near ones, onto the first."""
    best_squared = math.inf
    best = Foot(-1, math.nan, (math.nan, math.nan), math.nan)
    for segment in range(len(line) - 1):
        t, d = project_to_segment(a, line[segment], line[segment + 1])
        squared = (a[0] - d[0]) ** 2 + (a[1] - d[1]) ** 2
        if squared < best_squared:
            best_squared = squared
            best = Foot(segment, t, d, math.sqrt(squared))
    return best


def check_distance(vi: Line, vj: Line) -> float:
    """Compute the smallest distance of a vertex of one polyline to the other polyline, both ways."""
    smallest = math.inf
    for vertex in vi:
        smallest = min(smallest, project(vertex, vj).distance)
    for vertex in vj:
        smallest = min(smallest, project(vertex, vi).distance)
    return smallest


def polyline_merge_check(vi: Line, vj: Line, proximity: float) -> bool:
    """Tell whether any vertex of either polyline is nearer than the threshold to the other polyline."""
    vi_near_vj = any(project(vertex, vj).distance < proximity for vertex in vi)
    vj_near_vi = any(project(vertex, vi).distance < proximity for vertex in vj)
    return vi_near_vj or vj_near_vi


def generate_network(polylines: list[Polyline], proximity: float) -> set[frozenset[int]]:
    """Alg. 1, with the labels compared before the distances, which changes nothing but the time."""
    edges: set[frozenset[int]] = set()
    for i, vi in enumerate(polylines):
        if vi.is_main:
            continue
        for j, vj in enumerate(polylines):
            if i == j:
                continue
            if vi.cls == vj.cls and polyline_merge_check(vi.points, vj.points, proximity):
                edges.add(frozenset((i, j)))
    return edges


def midpoint(a: Point, b: Point) -> Point:
    """Pm = (A + B) / 2."""
    return ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2)


def merge_vertex(base: Line, a: Point) -> Line:
    """Merge one vertex onto the base by the one of the four scenarios that applies; a new list.

    No scenario can make a zero-length segment. Pm falls on the end C of a segment only if A = 2 C - B, and
    then A lies nearer to C than to B, so that B was not its projection. The same holds for a vertex that is
    replaced and its neighbours; and an end is put on only if it is not there.
    """
    segment, t, b, _ = project(a, base)
    closed = base[0] == base[-1]
    last = len(base) - 1
    merged = list(base)
    if 0.0 < t < 1.0:  # first scenario: B inside CD
        merged.insert(segment + 1, midpoint(a, b))
        return merged
    vertex = segment if t == 0.0 else segment + 1
    if closed and vertex in (0, last):  # second scenario, for the vertex that a closed base holds twice
        merged[0] = merged[last] = midpoint(a, b)
    elif vertex == 0:  # third scenario: B is the first vertex
        if a != base[0]:
            merged.insert(0, a)
    elif vertex == last:  # fourth scenario: B is the last vertex
        if a != base[last]:
            merged.append(a)
    else:  # second scenario: B is an inner vertex
        merged[vertex] = midpoint(a, b)
    return merged


def merge_polyline(base: Line, polyline: Line) -> Line:
    """Merge a polyline onto the base vertex by vertex, onto the base as it stands after each."""
    for vertex in polyline:
        base = merge_vertex(base, vertex)
    return base


def connected_components(count: int, edges: set[frozenset[int]]) -> list[list[int]]:
    """Sets of connected nodes, each sorted, in the order of their lowest members."""
    components: list[list[int]] = []
    seen: set[int] = set()
    for node in range(count):
        if node not in seen:
            depths = steps_from(node, edges)
            seen.update(depths)
            components.append(sorted(depths))
    return components


def steps_from(root: int, edges: set[frozenset[int]]) -> dict[int, int]:
    """Breadth-first search: the number of edges from the root, for every node that can be reached."""
    depths = {root: 0}
    front = [root]
    while front:
        reached = []
        for node in front:
            for edge in edges:
                if node in edge:
                    (other,) = edge - {node}
                    if other not in depths:
                        depths[other] = depths[node] + 1
                        reached.append(other)
        front = reached
    return depths


def length(line: Line) -> float:
    """Sum of the lengths of the segments."""
    return sum(math.dist(line[k], line[k + 1]) for k in range(len(line) - 1))


def choose_base(polylines: list[Polyline], members: list[int]) -> int:
    """Choose the polyline of a component onto which the others are merged."""
    candidates = [i for i in members if polylines[i].is_main]
    if not candidates:
        earliest = min(polylines[i].instance_rank for i in members)
        candidates = [i for i in members if polylines[i].instance_rank == earliest]
    return min(candidates, key=lambda i: (-length(polylines[i].points), polylines[i].key))


def merge_order(polylines: list[Polyline], members: list[int], base: int, edges: set[frozenset[int]]) -> list[int]:
    """Order in which the others are merged onto the base."""
    depths = steps_from(base, edges)

    def order(i: int) -> tuple[int, int, tuple[bytes, bytes]]:
        polyline = polylines[i]
        return depths[i], -1 if polyline.is_main else polyline.instance_rank, polyline.key

    return sorted((i for i in members if i != base), key=order)


def merge_reference(polylines: list[Polyline], proximity: float) -> Merged:
    """Merge the concatenation of all maps by the whole published method (lines only)."""
    clean = [polyline._replace(points=remove_short_segments(polyline.points)) for polyline in polylines]
    if clean and not any(polyline.is_main for polyline in clean):
        first = min(polyline.instance_rank for polyline in clean)
        clean = [polyline._replace(is_main=polyline.instance_rank == first) for polyline in clean]
    edges = generate_network(clean, proximity)
    members = connected_components(len(clean), edges)
    elements = []
    for component in members:
        base = choose_base(clean, component)
        line = clean[base].points
        for i in merge_order(clean, component, base, edges):
            line = merge_polyline(line, clean[i].points)
        elements.append(line)
    return Merged(edges, elements, members)
