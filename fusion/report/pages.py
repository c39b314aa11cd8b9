"""Pages of a result, of one map, and of a log: `fused_report`, `map_report`, `log_report`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mapfuse.datasets.files import write_whole
from mapfuse.datasets.maps import LandmarkMap

from ..result import FusedMap
from .document import document
from .fused_data import fused_data
from .joint import coupling
from .plain import flat, map_plain, origin_of, shades, text, thinned

if TYPE_CHECKING:
    from mapfuse.datasets.logs import LogHeader

    from ..show.log_page import Drive


def fused_report(fused: FusedMap, path: str | Path | None = None) -> str:
    """The page of a result as HTML, written whole to ``path`` where one is given.

    It shows the maps as they were recorded, laid together under every rival hypothesis, and merged; what speaks for
    and against each; residuals and uncertainty. One file, which loads nothing. Names and ids are shown as text,
    without control characters, the middle of very long ones left out.

    Raises `OutputError` where the file can't be written, which then isn't there in part.

    >>> from mapfuse.fusion.result import FusedMap, PairResult
    >>> pair = PairResult(("A", "B"), "no_overlap", 0.0, 1.0, (), (), "no landmark kinds in common")
    >>> fused = FusedMap("no_overlap", 1.0, ("A", "B"), (("A",), ("B",)), {}, (pair,), (), {})
    >>> "These maps show different places" in fused_report(fused)
    True
    """
    data = fused_data(fused)
    names = " + ".join(text(name) for name in fused.maps) if len(fused.maps) <= 4 else f"{len(fused.maps)} maps"
    return _written(document(names, data["answer"], data["facts"], data, made_by=data["made_by"]), path)


def map_report(map_: LandmarkMap, path: str | Path | None = None) -> str:
    """The page of one map as HTML; file and errors as for `fused_report`.

    >>> from mapfuse.datasets.maps import Landmark, LandmarkMap
    >>> "1 landmark" in map_report(LandmarkMap("D1", (Landmark("c1", "corner", 0.0, 0.0),)))
    True
    """
    count = f"{len(map_)} landmark{'' if len(map_) == 1 else 's'}"
    answer = {"word": "map", "sentence": f"{text(map_.name)}: {count}.", "detail": ""}
    facts = []
    if map_.extra.get("simulated"):
        facts.append(["Data", "simulated"])
    if map_.robot:
        facts.append(["Robot", text(map_.robot)])
    facts += [["Kinds", _kinds(map_)]] if len(map_) else []
    scene = map_plain(map_, 0)
    if map_.joint_covariance is not None:
        place = map_.index_from_id
        order = [place[identifier] for identifier in map_.joint_covariance.order]
        scene["joint"] = {"order": order, **shades(coupling(map_.joint_covariance))}
    data: dict[str, Any] = {"kind": "map", "answer": answer, "maps": [{"name": text(map_.name), "scene": scene}]}
    return _written(document(text(map_.name), answer, facts, data), path)


def _kinds(map_: LandmarkMap) -> str:
    counts = {name: map_.types.count(name) for name in sorted(set(map_.types))}
    common = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    more = f" and {len(common) - 8} more kinds" if len(common) > 8 else ""
    return ", ".join(f"{n} {text(name)}" for name, n in common[:8]) + more


def log_report(header: LogHeader, drive: Drive, path: str | Path | None = None, *, simulated: bool = False) -> str:
    """The page of one drive as HTML: path, detections, scan points, truth and map; file and errors as above."""
    from ..show.log_page import log_page

    page = log_page(header, drive, simulated=simulated)
    ground, scene = page.mains[0].ground, page.mains[0].scene
    assert ground is not None
    origin = origin_of(np.concatenate(ground.spots))
    lines = (
        ("building", "true wall", [*ground.walls]),
        ("truepath", "true path", [ground.true_path]),
        ("odometry", "path by odometry", [ground.odometry]),
        ("mapped", "path in the map", [ground.mapped]),
    )
    dots = (
        ("points", "scan point", ground.points),
        ("detections", "detection", ground.detections[~ground.false]),
        ("alarms", "false alarm", ground.detections[ground.false]),
        ("trueplaces", "true landmark", ground.places),
    )
    parts: list[dict[str, Any]] = [
        {"looks": looks, "label": label, "lines": [flat(thinned(line), origin) for line in of if len(line)]}
        for looks, label, of in lines
        if any(len(line) for line in of)
    ]
    parts += [
        {"looks": looks, "label": label, "dots": True, "at": flat(thinned(of, 20_000), origin),
         "beyond": looks == "points"}
        for looks, label, of in dots
        if len(of)
    ]  # fmt: skip
    answer = {"word": "log", "sentence": f"{page.title}.", "detail": ""}
    maps = [{"name": text(drive.map.name), "scene": _placed(drive, scene, origin)}] if drive.map is not None else []
    data = {"kind": "log", "answer": answer, "ground": parts, "maps": maps}
    facts = [["Holds", fact] for fact in page.facts]
    return _written(document(text(header.name), answer, facts, data), path)


def _placed(drive: Drive, scene: Any, origin: Any) -> dict[str, Any]:
    """The map on top of its drive, in the frame of the page."""
    from .plain import scene_plain

    assert drive.map is not None
    plain = scene_plain(scene, origin)
    plain["counters"] = [[l.visit_counter, l.detection_counter] for l in drive.map.landmarks]
    plain["existence"] = [None if l.existence is None else round(l.existence, 4) for l in drive.map.landmarks]
    return plain


def _written(page: str, path: str | Path | None) -> str:
    if path is not None:
        write_whole(path, page.encode("utf-8"))
    return page
