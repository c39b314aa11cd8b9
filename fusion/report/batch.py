"""The page of a batch run: `batch_report` reads a run's folder, its table of pairs and its fused files."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mapfuse.datasets.errors import FileFormatError, Problem
from mapfuse.datasets.files import read_whole, write_whole

from ..fusedfile import read_fused
from ..result import FusedMap
from ..show.scene import scene_of_group
from ..show.words import percent
from .document import document
from .plain import number, origin_of, scene_plain, text
from .verdict import stand_alone

#: Columns of the table of pairs that the page needs.
COLUMNS = ("map1", "map2", "decision", "probability", "x", "y", "theta", "count")
#: Places of decisions in the page's data, "failed" last.
DECISIONS = ("merged", "ambiguous", "no_overlap")


def batch_report(run: str | Path, path: str | Path | None = None) -> str:
    """The page of a batch run as HTML, written whole to ``path`` where one is given.

    ``run`` holds ``pairs.csv`` and, anywhere below it, one ``.fused.json`` per group. The page lists all pairs, to be
    sorted and filtered, and all groups, each of which is drawn when it is opened.

    Raises `InputError` where there is no table, and `FileFormatError` for a file that breaks a rule, with its place.
    """
    folder = Path(run)
    results = [(file.relative_to(folder), read_fused(file)) for file in sorted(folder.rglob("*.fused.json"))]
    table = _table(folder / "pairs.csv")
    names = sorted({name for row in table for name in (row["map1"], row["map2"])} | _names(results))
    index = {name: k for k, name in enumerate(names)}
    groups, parts = _groups(results, index)
    together = {m for group in groups for m in group["maps"]}
    data: dict[str, Any] = {
        "kind": "batch",
        "maps": [{"name": text(name)} for name in names],
        "groups": groups,
        "alone": [k for k in range(len(names)) if k not in together],
        "pairs": {"rows": [_row(row, index) for row in table]},
    }
    answer, facts = _said(data)
    title = f"Batch run {text(folder.resolve().name)}"
    page = document(title, answer, facts, data, parts=parts)
    if path is not None:
        write_whole(path, page.encode("utf-8"))
    return page


def _names(results: Sequence[tuple[Path, FusedMap]]) -> set[str]:
    return {name for _, fused in results for name in fused.maps}


def _table(path: Path) -> list[dict[str, str]]:
    """The rows of the table of pairs, each with all the columns that are needed."""
    raw = read_whole(path)
    try:
        lines = raw.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise FileFormatError(path, (Problem(f"byte {error.start}", "is not UTF-8"),)) from None
    reader = csv.DictReader(lines)
    missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise FileFormatError(path, (Problem("line 1", f"has no column {', '.join(missing)}"),))
    return list(_checked(reader, path))


def _checked(reader: csv.DictReader[str], path: Path) -> Iterator[dict[str, str]]:
    for row in reader:
        place = f"line {reader.line_num}"
        if row.get(None) is not None or any(row[name] is None for name in COLUMNS):
            raise FileFormatError(path, (Problem(place, "does not have as many fields as the first line"),))
        for name in ("probability", "x", "y", "theta", "count"):
            if row[name] and _number(row[name]) is None and not row.get("error"):
                raise FileFormatError(path, (Problem(f"{place}, {name}", f"is no number: {row[name]!r}"),))
        yield row


def _number(value: str) -> float | None:
    try:
        found = float(value)
    except ValueError:
        return None
    return found if math.isfinite(found) else None


def _row(row: Mapping[str, str], index: Mapping[str, int]) -> list[Any]:
    """Map 1, map 2, decision, probability, common landmarks, and T12 or what went wrong."""
    ends = [index[row["map1"]], index[row["map2"]]]
    if row.get("error") or row["decision"] not in DECISIONS:
        return [*ends, len(DECISIONS), None, None, text(row.get("error") or row["decision"])]
    x, y, theta = (_number(row[name]) for name in ("x", "y", "theta"))
    placed = "" if x is None or y is None or theta is None else f"{x:.2f} m, {y:.2f} m, {math.degrees(theta):.1f}°"
    p, count = _number(row["probability"]), _number(row["count"])
    return [
        *ends,
        DECISIONS.index(row["decision"]),
        None if p is None else number(p, 6),
        None if count is None else int(count),
        placed,
    ]


def _groups(
    results: Sequence[tuple[Path, FusedMap]], index: Mapping[str, int]
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The merged groups, largest first, and their scenes apart, which the page reads when one is opened."""
    found = [(file, fused, k) for file, fused in results for k, names in enumerate(fused.groups) if len(names) > 1]
    found.sort(key=lambda item: (-len(item[1].groups[item[2]]), str(item[0])))
    groups, parts = [], {}
    for n, (file, fused, k) in enumerate(found):
        scene = scene_of_group(fused, k)
        members = [l for l in fused.landmarks if l.group == k]
        plain = scene_plain(scene, origin_of(scene.positions))
        plain["existence"] = [round(l.existence, 4) for l in members]
        plain["counters"] = [[l.visit_counter, l.detection_counter] for l in members]
        plain["sources"] = [
            [[index[name], None, text(i)] for name, ids in l.sources.items() for i in ids] for l in members
        ]
        groups.append({
            "maps": [index[name] for name in fused.groups[k]],
            "count": len(members),
            "sure": percent(fused.probability),
            "file": text(str(file)),
        })  # fmt: skip
        parts[f"group-{n}"] = plain
    return groups, parts


def _said(data: Mapping[str, Any]) -> tuple[dict[str, str], list[list[str]]]:
    """The run in a sentence, and its numbers."""
    counts = [sum(row[2] == k for row in data["pairs"]["rows"]) for k in range(len(DECISIONS) + 1)]
    merged = sum(len(group["maps"]) for group in data["groups"])
    total = len(data["maps"])
    groups = f"{len(data['groups'])} group{'' if len(data['groups']) == 1 else 's'}"
    sentence = f"{merged} of {total} maps were merged into {groups}; {stand_alone(total - merged)}."
    pairs = f"{counts[0]} merged, {counts[1]} ambiguous, {counts[2]} without overlap"
    facts = [["Pairs compared", f"{sum(counts)}: {pairs}" + (f", {counts[3]} failed" if counts[3] else "")]]
    return {"word": "batch", "sentence": sentence, "detail": ""}, facts
