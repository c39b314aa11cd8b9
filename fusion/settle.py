"""Choose, solve, and choose again where the joint graph of a group doesn't bear out what was chosen."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .config import FuseConfig
from .consistent import Choice, choose
from .joint import Joint, Members, Walled, solve_group
from .pairwise import Comparison
from .placing import Against, Landmark, Pair, places_of
from .prepared import PreparedMap

#: How often a choice is made again without candidates that the joint graph took apart.
MAX_CHOICES = 5


def settled(
    prepared: Mapping[str, PreparedMap], comparisons: Mapping[Pair, Comparison], config: FuseConfig, against: Against
) -> tuple[Choice, dict[tuple[str, ...], Joint]]:
    """Groups of maps, and the joint graph of each that has more than one.

    A candidate that loses half of its matches to the gate of the joint graph was wrong: the choice is made without it.
    """
    forbidden: frozenset[tuple[Pair, int]] = frozenset()
    for _ in range(MAX_CHOICES):
        choice = choose(prepared, comparisons, config, against, forbidden)
        several = [names for names in choice.groups if len(names) > 1]
        joints = {names: joint_of(names, prepared, comparisons, choice, config) for names in several}
        broken = [
            item for names, joint in joints.items() for item in broken_candidates(names, joint, comparisons, choice)
        ]
        if not broken or len(comparisons) == 1:
            break
        forbidden |= frozenset(broken)
    return choice, joints


def joint_of(
    names: tuple[str, ...],
    prepared: Mapping[str, PreparedMap],
    comparisons: Mapping[Pair, Comparison],
    choice: Choice,
    config: FuseConfig,
) -> Joint:
    """The joint graph of a group, as it was chosen."""
    maps = tuple(prepared[name] for name in names)
    shared = _shared(names, {p: k for p, k in choice.chosen.items() if p[0] in names}, comparisons)
    rank = {name: r for r, name in enumerate(names)}
    between = tuple((rank[a], rank[b]) for a, b in sorted(choice.chosen) if a in rank and b in rank)
    walled = Walled(between, config.walls) if config.walls.use else None
    only = comparisons.get(names) if len(names) == 2 else None
    if only is not None and only.solution is not None and choice.chosen[only.maps] == 0:
        return Joint(maps, only.solution, shared, 0, walled)
    frames = [choice.frames[name].array for name in names]
    return solve_group(maps, frames, shared, config.solving, walled)


def _shared(
    names: tuple[str, ...], chosen: Mapping[Pair, int], comparisons: Mapping[Pair, Comparison]
) -> tuple[Members, ...]:
    """The places that several maps of the group have, in order."""
    rank = {name: r for r, name in enumerate(names)}
    members: dict[Landmark, list[tuple[int, int]]] = {}
    for (name, k), root in places_of(chosen, comparisons).items():
        members.setdefault(root, []).append((rank[name], k))
    return tuple(sorted(tuple(sorted(place)) for place in members.values() if len(place) > 1))


def broken_candidates(
    names: tuple[str, ...], joint: Joint, comparisons: Mapping[Pair, Comparison], choice: Choice
) -> list[tuple[Pair, int]]:
    """Chosen candidates of which the joint graph leaves less than half of the matches together."""
    place = {(names[r], k): n for n, members in enumerate(joint.shared) for r, k in members}
    found = []
    for pair, k in choice.chosen.items():
        if pair[0] not in names:
            continue
        matches = comparisons[pair].candidates[k].matches
        together = [place.get((pair[0], i), -1) == place.get((pair[1], j), -2) for i, j in matches]
        if np.mean(together) < 0.5:
            found.append((pair, k))
    return found
