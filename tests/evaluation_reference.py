"""The measures of an evaluation, written out loop for loop, and random maps to try them on.

This is the yardstick of `polymerge_core.evaluate`, of which it imports nothing. It is slow on purpose: one line
after the other, one point after the other, so that it can be checked by reading. Lines are arrays of (x, y); a
line whose ends are the same point is closed. Discrete Frechet distance and partial curve mapping are those of the
package `similaritymeasures`.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import similaritymeasures

STEP_M = 0.25
PIECE_M = 0.5
CHECK_M = 1.0
NEAR_M = 1.5
THRESHOLDS_M = (0.5, 1.0, 1.5)


class Pair(NamedTuple):
    """An estimate and a reference line that pass the check, and what they are compared over."""

    estimate: int
    reference: int
    frechet: float
    section: np.ndarray
    drawn: np.ndarray


class Piece(NamedTuple):
    """A short stretch of a line: its ends and its middle, and its length."""

    start: np.ndarray
    middle: np.ndarray
    end: np.ndarray
    length: float


def is_closed(line):
    return len(line) > 3 and bool((line[0] == line[-1]).all())


def positions(line):
    """Metres from the first vertex, for each vertex."""
    found = [0.0]
    for a, b in itertools.pairwise(line):
        found.append(found[-1] + math.dist(a, b))
    return found


def length(line):
    return positions(line)[-1]


def point_at(line, position):
    where = positions(line)
    return np.array([np.interp(position, where, line[:, 0]), np.interp(position, where, line[:, 1])])


def project(point, line):
    """Distance to the nearest point of a line, and the position of that point."""
    where = positions(line)
    best = (math.inf, math.nan)
    for number, (a, b) in enumerate(itertools.pairwise(line)):
        along = b - a
        t = min(1.0, max(0.0, float((point - a) @ along / (along @ along))))
        distance = math.dist(point, a + t * along)
        if distance < best[0]:
            best = (distance, where[number] + t * (where[number + 1] - where[number]))
    return best


def nearest(point, lines):
    """Distance to the nearest of many lines, and which one that is."""
    best = (math.inf, -1)
    for number, line in enumerate(lines):
        best = min(best, (project(point, line)[0], number))
    return best


def passes_check(a, b):
    return any(project(vertex, b)[0] < CHECK_M for vertex in a) or any(project(vertex, a)[0] < CHECK_M for vertex in b)


def stretch(line, low, high):
    """The part of a line between two positions, the vertices between them included."""
    between = [vertex for vertex, where in zip(line, positions(line), strict=True) if low < where < high]
    return np.array([point_at(line, low), *between, point_at(line, high)])


def resample(line):
    """Equal steps of at most 0.25 m, both ends included; a line without length is one point."""
    whole = length(line)
    if whole == 0:
        return line[:1]
    return np.array([point_at(line, where) for where in np.linspace(0, whole, math.ceil(whole / STEP_M) + 1)])


def started_at(ring, position):
    """The same ring from another position on, once round."""
    if position in (0.0, length(ring)):
        return ring
    return np.vstack((stretch(ring, position, length(ring)), stretch(ring, 0.0, position)[1:]))


def candidates(estimate, reference):
    """What may be compared: the estimate, and the section of the reference that answers to it, in its direction."""
    if is_closed(estimate):
        starts = [started_at(estimate, where) for where in positions(estimate)[:-1]]
        if is_closed(reference):
            # A ring answers to a ring as a whole, from the place nearest to the start of the other.
            return [(ring, started_at(reference, project(ring[0], reference)[1])) for ring in starts]
        where = [project(vertex, reference)[1] for vertex in estimate]
        return [(ring, stretch(reference, min(where), max(where))) for ring in starts]
    first, last = (project(end, reference)[1] for end in (estimate[0], estimate[-1]))
    low, high = sorted((first, last))
    inner = stretch(reference, low, high)
    if not is_closed(reference):
        return [(estimate, inner)]
    outer = np.vstack((stretch(reference, high, length(reference)), stretch(reference, 0.0, low)[1:]))
    return [(estimate, inner), (estimate, outer)]


def frechet(first, second):
    """Discrete Frechet distance, the smaller of both directions."""
    return min(similaritymeasures.frechet_dist(first, second), similaritymeasures.frechet_dist(first[::-1], second))


def compare(estimate, reference):
    """DF of the best of what may be compared, and what that is, resampled."""
    found = [(resample(drawn), resample(section)) for drawn, section in candidates(estimate, reference)]
    distances = [frechet(drawn, section) for drawn, section in found]
    best = int(np.argmin(np.round(distances, 9)))
    return distances[best], *found[best]


def pairs(estimates, references):
    """Compare all that pass the check."""
    found = []
    for i, estimate in enumerate(estimates):
        for j, reference in enumerate(references):
            if passes_check(estimate, reference):
                distance, drawn, section = compare(estimate, reference)
                found.append(Pair(i, j, distance, section, drawn))
    return found


def best_pairs(found):
    """Keep, for each estimate, the pair with the smallest DF."""
    best: dict[int, Pair] = {}
    for pair in found:
        if pair.estimate not in best or pair.frechet < best[pair.estimate].frechet:
            best[pair.estimate] = pair
    return list(best.values())


def mapping(section, drawn):
    """PCM, the smallest over both directions of both lines; nan where there is no curve to map, or no extent.

    The reference is the first of the two, and the measure weighs errors by how far along they are, so that
    digitising either line the other way would change any one of the four.
    """
    if len(section) < 2 or len(drawn) < 2 or (np.ptp(section, axis=0) == 0).any():
        return math.nan
    return min(similaritymeasures.pcm(a, b) for a in (section, section[::-1]) for b in (drawn, drawn[::-1]))


def mapping_turned(section, drawn):
    """PCM in a frame in which the chord of the section lies at 45 degrees; of a ring, its longest from the start."""
    across, up = (
        max(section - section[0], key=lambda step: round(math.hypot(*step), 9))
        if is_closed(section)
        else section[-1] - section[0]
    )
    angle = math.pi / 4 - math.atan2(up, across)
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    return mapping(section @ turn, drawn @ turn)


def pieces(line):
    """Equal pieces of at most half a metre."""
    whole = length(line)
    count = math.ceil(whole / PIECE_M)
    step = whole / count
    return [
        Piece(point_at(line, n * step), point_at(line, (n + 0.5) * step), point_at(line, (n + 1) * step), step)
        for n in range(count)
    ]


def share_within(lines, others, threshold):
    """Share of the length of lines that is within a threshold of any other line."""
    all_pieces = [piece for line in lines for piece in pieces(line)]
    near = [piece.length for piece in all_pieces if nearest(piece.middle, others)[0] <= threshold]
    return sum(near) / sum(piece.length for piece in all_pieces)


def lateral(merged, references):
    """Distances of points along the merged lines: those of at most 1.5 m, and the share of the others."""
    found = [nearest(piece.middle, references)[0] for line in merged for piece in pieces(line)]
    near = np.array([distance for distance in found if distance <= NEAR_M])
    return near, 1 - len(near) / len(found)


def duplication(merged, references):
    """Merged length that lies alongside the reference, over the reference length that it projects onto.

    A step from the middle of one piece to that of the next lies alongside where both are near one and the same line,
    not beyond an end of it, and not at two places of it that are much farther apart than the step is long.
    """
    near = 0.0
    covered: dict[int, list[tuple[float, float]]] = {}
    for here, there in (pair for line in merged for pair in itertools.pairwise(pieces(line))):
        (far, number), (other_far, other) = nearest(here.middle, references), nearest(there.middle, references)
        if max(far, other_far) > NEAR_M or number != other:
            continue
        reference = references[number]
        low, high = sorted((project(here.middle, reference)[1], project(there.middle, reference)[1]))
        if is_closed(reference) and high - low > length(reference) / 2:
            near += here.length
            covered.setdefault(number, []).extend([(0.0, low), (high, length(reference))])
            continue
        is_beyond = not is_closed(reference) and low == high and low in (0.0, length(reference))
        if is_beyond or high - low > 4 * here.length:
            continue
        near += here.length
        covered.setdefault(number, []).append((low, high))
    return near / sum(union_length(intervals) for intervals in covered.values())


def union_length(intervals):
    total, reached = 0.0, -math.inf
    for low, high in sorted(intervals):
        total += max(0.0, high - max(low, reached))
        reached = max(reached, high)
    return total


def zigzag(lines):
    """Absolute turning over length, of all lines together."""
    turned = 0.0
    for line in lines:
        headings = [math.atan2(*(b - a)[::-1]) for a, b in itertools.pairwise(line)]
        if is_closed(line):
            headings.append(headings[0])
        for before, after in itertools.pairwise(headings):
            turned += abs((after - before + math.pi) % (2 * math.pi) - math.pi)
    return turned / sum(length(line) for line in lines)


def chamfer(a, b):
    """Mean of both directed mean distances between points every half metre of one and the other line."""
    there = np.mean([project(piece.middle, b)[0] for piece in pieces(a)])
    back = np.mean([project(piece.middle, a)[0] for piece in pieces(b)])
    return float(there + back) / 2


def average_precision(merged, scores, references, threshold):
    """Area under the envelope of precision over recall; a reference can be found once."""
    taken: set[int] = set()
    precision, recall = [], []
    order = sorted(range(len(merged)), key=lambda number: -scores[number])
    for rank, number in enumerate(order, start=1):
        distance, found = min((chamfer(merged[number], line), j) for j, line in enumerate(references))
        if distance < threshold and found not in taken:
            taken.add(found)
        precision.append(len(taken) / rank)
        recall.append(len(taken) / len(references))
    area, before = 0.0, 0.0
    for rank, reached in enumerate(recall):
        area += (reached - before) * max(precision[rank:])
        before = reached
    return area


def paired(observations, merged, references):
    """For each observation that has a reference and a merged line: its own DF, and that of the merged stretch."""
    own = {pair.estimate: pair for pair in best_pairs(pairs(observations, references))}
    drawn = {pair.estimate: pair for pair in best_pairs(pairs(observations, merged))}
    both = [number for number in own if number in drawn]
    before = [own[number].frechet for number in both]
    after = []
    for number in both:
        if all(is_closed(part) for part in (own[number].section, drawn[number].section)):
            # Both were seen whole: where the observation starts says nothing about them.
            after.append(compare(merged[drawn[number].reference], references[own[number].reference])[0])
        else:
            after.append(frechet(drawn[number].section, own[number].section))
    return np.array(before), np.array(after)


class RandomMap(NamedTuple):
    """Reference lines, merged lines and their scores, and the observations, of one class."""

    reference: list[np.ndarray]
    merged: list[np.ndarray]
    scores: list[float]
    observations: list[np.ndarray]


def random_road(rng):
    """Draw a gently bent line of 10 to 30 m with uneven segments."""
    count = int(rng.integers(4, 9))
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.2, count))
    steps = rng.uniform(2, 4, count)[:, None] * np.column_stack((np.cos(heading), np.sin(heading)))
    return rng.uniform(0, 60, 2) + np.cumsum(steps, axis=0)


def random_ring(rng):
    """Draw an island of 4 to 6 corners."""
    corners = int(rng.integers(4, 7))
    angle = rng.uniform(0, 2 * np.pi) + np.arange(corners) * 2 * np.pi / corners
    ring = rng.uniform(0, 60, 2) + rng.uniform(2, 4) * np.column_stack((np.cos(angle), np.sin(angle)))
    return np.vstack((ring, ring[:1]))


def drawn_again(rng, line):
    """Draw a line once more: a part of it, shifted and noisy, in either direction."""
    if is_closed(line):
        corners = line[:-1] + rng.normal(0, 0.2, 2) + rng.normal(0, 0.1, (len(line) - 1, 2))
        again = np.vstack((corners, corners[:1]))
    else:
        whole = length(line)
        where = np.sort(rng.uniform(0, whole, 2))
        if where[1] - where[0] < 3:
            where = np.array([0.0, whole])
        again = stretch(line, *where)
        again = again + rng.normal(0, 0.2, 2) + rng.normal(0, 0.1, again.shape)
    return again[:: rng.choice([-1, 1])]


def random_map(seed, *, roads=5, rings=1):
    """Draw a reference, two observations of each line, and merged lines: some twice, some false, some missed."""
    rng = np.random.default_rng(seed)
    reference = [random_road(rng) for _ in range(roads)] + [random_ring(rng) for _ in range(rings)]
    reference += [line + rng.uniform(0.4, 0.6, 2) for line in (reference[0], reference[-1])]
    merged = [drawn_again(rng, line) for line in reference if rng.random() < 0.85]
    merged += [drawn_again(rng, line) for line in reference if rng.random() < 0.25]
    merged.append(random_road(rng))
    scores = (rng.permutation(len(merged)) + 1) / (len(merged) + 1)
    observations = [drawn_again(rng, line) for line in reference for _ in range(2)]
    return RandomMap(reference, merged, scores.tolist(), observations)
