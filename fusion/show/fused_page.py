"""What stands on a page: title, facts, panels and reasons of one result, before anything is drawn."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mapfuse.datasets.maps import LandmarkMap

from ..result import FusedMap, PairResult, RankedHypothesis
from .layout import MAX_SOURCES, Panel
from .scene import Scene, laid_together, scene_of_group, scene_of_map
from .words import probability_text, shortened, transform_text

#: So many rivals of an ambiguous pair are drawn, merged groups likewise; the text names how many there are.
MAX_RIVALS, MAX_GROUPS, MAX_FACTS = 3, 4, 5
#: Probability above which a placement is worth drawing.
POSSIBLE = 1e-3


@dataclass(frozen=True, slots=True)
class Page:
    """All that a page says: ``names`` of all maps (their looks follow this order), ``facts`` below the title,
    ``statement`` in a box where there is no merged map, ``notes`` at the end."""

    title: str
    names: tuple[str, ...]
    facts: tuple[str, ...] = ()
    sources: tuple[Panel, ...] = ()
    mains: tuple[Panel, ...] = ()
    statement: str | None = None
    notes: tuple[str, ...] = ()


def counted(n: int, noun: str) -> str:
    """``1 landmark``, ``2 landmarks``."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


def _joined(names: Iterable[str]) -> str:
    return " + ".join(shortened(name) for name in names)


def map_page(map_: LandmarkMap) -> Page:
    """The page of one map."""
    robot = f" by {map_.robot}" if map_.robot else ""
    title = f"{shortened(map_.name)}: {counted(len(map_), 'landmark')}{robot}{_origin([map_])}"
    return Page(title, (map_.name,), mains=(Panel("", scene_of_map(map_)),))


def _origin(maps: Sequence[LandmarkMap]) -> str:
    """Says of maps that no robot recorded that they are simulated."""
    if not any(map_.extra.get("simulated") for map_ in maps):
        return ""
    return ", simulated" + (" (a reconstruction)" if any(map_.extra.get("reconstruction") for map_ in maps) else "")


def fused_page(fused: FusedMap) -> Page:
    """The page of a result: what is merged, what could be, or that nothing is, and why."""
    statement: str | None = None
    merged = [k for k, names in enumerate(fused.groups) if len(names) > 1]
    ambiguous = [pair for pair in fused.pairs if pair.decision == "ambiguous"]
    if merged:
        mains = tuple(_group_panel(fused, k) for k in merged[:MAX_GROUPS])
    elif ambiguous:
        mains = _rival_panels(fused, ambiguous[0])
        statement = _ambiguous_statement(ambiguous[0], drawn=len(mains))
    else:
        mains = ()
        statement = _no_overlap_statement(fused)
    notes = _notes(fused, len(merged) - MAX_GROUPS)
    if statement is not None and len(fused.pairs) == 1:
        statement, notes = "\n".join([statement, *notes]), ()
    return Page(_title(fused), fused.maps, _facts(fused), _source_panels(fused), mains, statement, notes)


def pair_page(fused: FusedMap, pair: PairResult) -> Page:
    """The page of one pair of a result: both maps, and the best placements side by side, whatever was decided."""
    mains = _rival_panels(fused, pair)
    shown = tuple(panel for panel in _source_panels(fused, pair.maps))
    none = f"probability of no overlap {probability_text(pair.no_overlap_probability)}"
    origin = _origin([fused.sources[name] for name in pair.maps if name in fused.sources])
    title = f"{_joined(pair.maps)}{origin}: {pair.decision.replace('_', ' ')}"
    overruled = f" (overruled by {', '.join(map(shortened, pair.overruled_by))})" if pair.overruled_by else ""
    statement = None if mains else "The placements can't be drawn: there are none, or the maps aren't embedded."
    return Page(title, fused.maps, (none,), shown, mains, statement, (f"{pair.reason}{overruled}",))


def _title(fused: FusedMap) -> str:
    names = _joined(fused.maps) if len(fused.maps) <= 4 else counted(len(fused.maps), "map")
    origin = _origin(list(fused.sources.values()))
    return f"{names}{origin}: {fused.decision.replace('_', ' ')}, {_probability(fused)}"


def _probability(fused: FusedMap) -> str:
    if fused.decision in ("merged", "partial") or not fused.pairs:
        return f"probability {probability_text(fused.probability)}"
    pair = fused.pairs[0]
    if fused.decision == "no_overlap":
        return f"probability of no overlap {probability_text(pair.no_overlap_probability)}"
    pair = next((pair for pair in fused.pairs if pair.decision == "ambiguous"), pair)
    return f"probability of the best hypothesis {probability_text(pair.probability)}"


def _facts(fused: FusedMap) -> tuple[str, ...]:
    """Where each merged map's frame is, with one sigma; of two maps as T12."""
    if len(fused.maps) == 2 and fused.decision == "merged" and fused.pairs and fused.pairs[0].T12 is not None:
        pair = fused.pairs[0]
        first, second = map(shortened, pair.maps)
        how = f"takes {second} into {first}, ± 1 σ"
        return (f"T12:  {transform_text(fused.pairs[0].T12)}   ({how})",)
    facts = [
        f"{shortened(name)} in {shortened(names[0])}:  {transform_text(fused.frames[name].T)}"
        for names in fused.groups
        for name in names[1:]
    ]  # fmt: skip
    facts = [fact + "   (± 1 σ)" if k == 0 else fact for k, fact in enumerate(facts)]
    more = len(facts) - MAX_FACTS
    return (*facts[:MAX_FACTS], *([f"and {counted(more, 'map')} more"] if more > 0 else []))


def _source_panels(fused: FusedMap, among: Sequence[str] | None = None) -> tuple[Panel, ...]:
    wanted = fused.maps if among is None else among
    shown = [(k, name) for k, name in enumerate(fused.maps) if name in fused.sources and name in wanted][:MAX_SOURCES]
    return tuple(
        Panel(
            f"{shortened(name)}, in its own frame: {counted(len(fused.sources[name]), 'landmark')}",
            scene_of_map(fused.sources[name], k),
        )
        for k, name in shown
    )


def _group_panel(fused: FusedMap, group: int) -> Panel:
    scene = scene_of_group(fused, group)
    names = fused.groups[group]
    which = "merged map" if len(names) == len(fused.maps) else _joined(names)
    counts = f"{counted(len(scene), 'landmark')}, {int(scene.common.sum())} common"
    title = f"{which}, in the frame of {shortened(names[0])}: {counts}"
    sigma = _position_sigmas(scene)
    if len(sigma):
        title += f"; position σ {np.median(sigma):.2f} m (median), {sigma.max():.2f} m (largest)"
    return Panel(title, scene)


def _position_sigmas(scene: Scene) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Largest standard deviation [m] of each landmark's position, over all directions."""
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(scene.covariances)[:, -1], 0.0)))


def _rival_panels(fused: FusedMap, pair: PairResult) -> tuple[Panel, ...]:
    if not all(name in fused.sources for name in pair.maps):
        return ()
    first, second = (scene_of_map(fused.sources[name], fused.maps.index(name)) for name in pair.maps)
    return tuple(
        Panel(
            f"possible placement {k}: probability {probability_text(h.probability)}, {h.count} matching\n"
            f"{transform_text(h.T12)}",
            laid_together(first, second.moved(h.T12.array)),
            labelled=False,  # both maps may use the same ids
        )
        for k, h in enumerate(_possible(pair)[:MAX_RIVALS], start=1)
    )


def _possible(pair: PairResult) -> tuple[RankedHypothesis, ...]:
    """The placements that may be the right one: the best, and those worth looking at besides."""
    return tuple(h for k, h in enumerate(pair.hypotheses) if k == 0 or h.probability >= POSSIBLE)


def _ambiguous_statement(pair: PairResult, drawn: int) -> str:
    """What is known of an ambiguous pair; placements that aren't drawn are listed."""
    first, second = map(shortened, pair.maps)
    possible = _possible(pair)
    lines = [
        f"Ambiguous: nothing is merged. Where {second} lies in {first} can't be told: "
        f"{counted(len(possible), 'placement')} possible, "
        f"probability of no overlap {probability_text(pair.no_overlap_probability)}."
    ]
    lines += [
        f"{k}:  probability {probability_text(h.probability)}, {h.count} matching,  {transform_text(h.T12)}"
        for k, h in list(enumerate(possible[:MAX_FACTS], start=1))[drawn:]
    ]
    more = len(possible) - max(drawn, MAX_FACTS)
    return "\n".join([*lines, f"and {more} more"] if more > 0 else lines)


def _no_overlap_statement(fused: FusedMap) -> str | None:
    if len(fused.maps) < 2:
        return None
    lines = ["No overlap was found: nothing is merged."]
    if len(fused.pairs) == 1 and fused.pairs[0].hypotheses:
        pair = fused.pairs[0]
        best = f"probability {probability_text(pair.probability)}, {pair.hypotheses[0].count} matching"
        lines.append(f"The best placement that was rejected: {best}.")
    return "\n".join(lines)


def _notes(fused: FusedMap, groups_left_out: int) -> tuple[str, ...]:
    """The reasons, pair by pair, and what the page leaves out."""
    notes = []
    for pair in fused.pairs[:MAX_FACTS]:
        who = "" if len(fused.pairs) == 1 else f"{_joined(pair.maps)}, {pair.decision.replace('_', ' ')}: "
        overruled = f" (overruled by {', '.join(map(shortened, pair.overruled_by))})" if pair.overruled_by else ""
        if pair.reason or who:
            notes.append(f"{who}{pair.reason}{overruled}")
    if len(fused.pairs) > MAX_FACTS:
        notes.append(f"and {counted(len(fused.pairs) - MAX_FACTS, 'pair')} more.")
    if groups_left_out > 0:
        notes.append(f"{counted(groups_left_out, 'merged group')} more not drawn.")
    left_out = sum(name in fused.sources for name in fused.maps) - MAX_SOURCES
    if left_out > 0:
        notes.append(f"{counted(left_out, 'recorded map')} more not drawn.")
    return tuple(notes)
