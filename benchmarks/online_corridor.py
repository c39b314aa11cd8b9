"""A corridor that a half turn maps onto itself, told landmark by landmark. Part of ``benchmarks/online.py``; tests of
`mapfuse.fusion.online` have their corridor from here."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from mapfuse.datasets import Landmark, LandmarkMap, Link, se2
from mapfuse.fusion.online import LandmarkSeen, Merged, OnlineFuser

Row = dict[str, Any]


def symmetric(seed: int, _: argparse.Namespace) -> Row:
    """Two maps of a symmetric floor, landmark by landmark, without compass; then something that breaks the symmetry.

    Both robots have everything by heart; only when all of it has been told they see the three doors near the middle
    of one side, which the other side lacks.
    """
    rng = np.random.default_rng(seed)
    one, two, late1, late2, true = symmetric_maps(rng)
    fuser = OnlineFuser()
    numbers = {"A": 0, "B": 0}
    t = 0.0
    early: list[bool] = []

    def tell(name: str, landmark: Landmark) -> None:
        nonlocal t
        t += 1.0
        fuser.take(LandmarkSeen(robot=name, sequence=numbers[name], t=t, landmark=landmark))
        numbers[name] += 1
        fuser.advance()
        early.extend(_right(fuser, true) for event in fuser.events() if isinstance(event, Merged))

    for a, b in zip(one, two, strict=True):
        tell("A", a)
        tell("B", b)
    fuser.advance(force=True)
    early.extend(_right(fuser, true) for event in fuser.events() if isinstance(event, Merged))
    held, before, first = fuser.fused().decision == "merged", fuser.fused().pairs[0], tuple(early)
    needed: int | None = None
    course: list[float] = []
    for k, (a, b) in enumerate(zip(late1, late2, strict=True)):
        tell("A", a)
        tell("B", b)
        fuser.advance(force=True)
        course.append(fuser.fused().pairs[0].probability)
        if needed is None and fuser.fused().decision == "merged":
            needed = k + 1
    fused = fuser.fused()
    return {
        "early": first,
        "held": held,
        "rivals": [h.probability for h in before.hypotheses[:3]],
        "needed": needed,
        "course": course,
        "wrong": fused.decision == "merged" and not _right(fuser, true),
        "probability": fused.probability,
    }


def _right(fuser: OnlineFuser, true: np.ndarray) -> bool:
    """Whether B lies where it is."""
    off = fuser.fused().frames["B"].T.array - true
    return bool(np.hypot(*off[:2]) <= 3.0 and abs(se2.wrap(off[2])) <= 0.5)


ARMS = {
    "end": ((0, "open"), (90, "blocked"), (180, "blocked"), (-90, "blocked")),
    "end2": ((180, "open"), (90, "blocked"), (0, "blocked"), (-90, "blocked")),
    "junction+": ((0, "open"), (180, "open"), (90, "open"), (-90, "blocked")),
    "junction-": ((0, "open"), (180, "open"), (-90, "open"), (90, "blocked")),
    "door+": ((0, "open"), (180, "open"), (90, "door"), (-90, "blocked")),
    "door-": ((0, "open"), (180, "open"), (-90, "door"), (90, "blocked")),
}
TYPES = {"end": "corner", "end2": "corner", "junction+": "junction", "junction-": "junction"}
#: Half of the corridor, from its one end to the middle [m, kind]; the other half is the same, turned.
HALF = ((-36.0, "end"), (-30.0, "door+"), (-25.0, "door-"), (-18.0, "door+"), (-10.0, "junction+"), (-4.0, "door-"))
TURNED = {"door+": "door-", "door-": "door+", "junction+": "junction-", "end": "end2"}
WHOLE = (*HALF, *((-x, TURNED[kind]) for x, kind in reversed(HALF)))
#: What only one end has.
LATE = (
    *((13.5, "door+"), (20.5, "door-"), (27.0, "door+"), (33.0, "junction+")),
    *((7.5, "door-"), (1.5, "door+"), (15.5, "door-"), (23.0, "junction-")),
)


def corridor(
    name: str,
    places: Sequence[tuple[float, str]],
    frame: np.ndarray,
    rng: np.random.Generator,
    *,
    heading_sigma: float = 0.02,
    distance_sigma: tuple[float, float] = (0.05, 0.01),
) -> LandmarkMap:
    """Places (along the corridor, what is there) as a robot maps them whose frame is at ``frame`` in the world.

    ``heading_sigma`` [rad] of arms; ``distance_sigma`` of links: [m] and per metre.
    """
    order = sorted(range(len(places)), key=lambda k: places[k][0])
    floor, per_metre = distance_sigma
    found = []
    for k, (x, kind) in enumerate(places):
        rank = order.index(k)
        xy = se2.transform(se2.inverse(frame), np.array([x, 0.0])) + rng.normal(0, 0.1, 2)
        links = []
        for degrees, type_ in ARMS[kind]:
            heading = float(se2.wrap(np.deg2rad(degrees) - frame[2] + rng.normal(0, heading_sigma)))
            far = order[rank + 1] if degrees == 0 and rank + 1 < len(places) else None
            far = order[rank - 1] if degrees == 180 and rank else far
            if far is None or type_ != "open":
                links.append(Link(type_, heading))
            else:
                d = abs(places[far][0] - x)
                links.append(Link(type_, heading, None, f"l{far}", d + rng.normal(0, floor + per_metre * d), 1))
        found.append(Landmark(f"l{k}", TYPES.get(kind, "door"), float(xy[0]), float(xy[1]), links=tuple(links)))
    return LandmarkMap(name, tuple(found), name)


def symmetric_maps(
    rng: np.random.Generator,
) -> tuple[list[Landmark], list[Landmark], list[Landmark], list[Landmark], np.ndarray]:
    """The corridor of 72 m as two robots have it, and late landmarks that one end has and the other hasn't. The last
    value is the true T12."""
    # as a robot tells them that goes to and fro from the middle: of each two that look alike one after the other
    places = sorted(WHOLE, key=lambda place: (abs(place[0]), place[0]))
    frames = [np.array([*rng.uniform(-20, 20, 2), rng.uniform(-np.pi, np.pi)]) for _ in range(2)]
    told: list[tuple[list[Landmark], list[Landmark]]] = []
    for name, frame in zip("AB", frames, strict=True):
        known, after = (
            corridor(name, row, frame, rng, heading_sigma=0.03, distance_sigma=(0.1, 0.02)).landmarks
            for row in (places, (*places, *LATE))
        )
        told.append((list(known), list(after[len(places) :])))
    return told[0][0], told[1][0], told[0][1], told[1][1], np.asarray(se2.between(frames[0], frames[1]))


def symmetric_table(rows: Sequence[Row]) -> Iterator[str]:
    """Ambiguous until something is seen that breaks the symmetry."""
    n = len(rows)
    needed = [row["needed"] for row in rows if row["needed"] is not None]
    yield "# A simulated floor that looks the same from both ends, no compass"
    yield ""
    yield "| | asked | measured |"
    yield "|---|---|---|"
    held = sum(row["held"] for row in rows)
    early = [row["early"] for row in rows if row["early"] and not row["held"]]
    yield f"| merged once all is told, both ends looking alike | never | {held} of {n} |"
    yield (
        "| merged before, by the few landmarks told by then, and un-merged by itself | 1 in 100, which is what "
        f"`accept` allows | {len(early)} of {n} |"
    )
    yield f"| of these the wrong way round | | {sum(not all(right) for right in early)} |"
    yield f"| merged once one end is seen to differ | within a few landmarks | {len(needed)} of {n} |"
    if needed:
        yield f"| landmarks it took, median and most of 8 | | {np.median(needed):.0f}, {max(needed)} |"
    yield f"| merged the wrong way round | none | {sum(row['wrong'] for row in rows)} |"
