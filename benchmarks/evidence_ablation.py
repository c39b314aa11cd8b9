"""What each part of the evidence buys: decisions on simulated pairs with one part left out at a time.

    .venv/bin/python benchmarks/evidence_ablation.py --pairs 100 --jobs 2 --write

Pairs of some classes of `calibration_pairs`, on `TEST_SEEDS` from ``--first`` on (``--tuning``: `TUNING_SEEDS`). Each
pair is grown and weighed once, and judged without each part in turn; nothing is tuned again for the part that
is lacking. ``--write`` keeps the table in ``benchmarks/results/evidence-ablation.md``.
"""

from __future__ import annotations

import argparse
import os
import platform
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from calibration_pairs import CLASSES

from mapfuse.datasets.simulation.pairs import TEST_SEEDS, TUNING_SEEDS
from mapfuse.fusion import FuseConfig
from mapfuse.fusion.background import Background
from mapfuse.fusion.config import EvidenceConfig
from mapfuse.fusion.evidence import Weighed, weigh
from mapfuse.fusion.pair import distinct, grow_all, judged
from mapfuse.fusion.prepared import prepare
from mapfuse.matching import propose

HERE = Path(__file__).resolve().parent
CONFIG = FuseConfig()
COLUMNS = (
    "irregular",
    "irregular, 5-7 common",
    "oblique, different",
    "alike",
    "alike, 5-7 common",
    "alike, different",
    "alike, different, compass",
    "symmetric",
    "symmetric, compass",
)


@dataclass(frozen=True, slots=True)
class Part:
    """What is left out: of each hypothesis' terms, or of the rules that judge them."""

    without: Callable[[Weighed], Weighed] = lambda w: w
    evidence: tuple[tuple[str, float], ...] = ()
    self_match: bool = True


def _lacking(*names: str) -> Callable[[Weighed], Weighed]:
    def without(w: Weighed) -> Weighed:
        # arms that contradict tell less between a place and its image than against no overlap: not what the term holds
        told_apart = {"arms": w.apart - w.terms.crossings - w.terms.compass, "compass": w.terms.compass}
        apart = w.apart - sum(told_apart.get(name, 0.0) for name in names)
        lacking = np.zeros_like(w.lacking) if "misses" in names else w.lacking
        return replace(w, terms=replace(w.terms, **dict.fromkeys(names, 0.0)), apart=apart, lacking=lacking)

    return without


def _without_search(w: Weighed) -> Weighed:
    return replace(w, terms=replace(w.terms, prior=w.terms.prior + CONFIG.evidence.look_elsewhere / 2))


PARTS: Mapping[str, Part] = {
    "nothing": Part(),
    "regular buildings": Part(_lacking("regular")),
    "misses and void": Part(_lacking("misses", "void")),
    "void alone": Part(_lacking("void")),
    "arms": Part(_lacking("arms")),
    "compass": Part(_lacking("compass")),
    "half of look-elsewhere": Part(_without_search),
    "repetition rule": Part(evidence=(("repetition_rate", 0.0),)),
    "the maps' matches with themselves": Part(self_match=False),
}


def judge_pair(job: tuple[str, int]) -> tuple[str, dict[str, str]]:
    """Of one pair, what is decided without each part: ``right``, ``wrong``, or nothing."""
    name, seed = job
    map1, map2, truth = CLASSES[name].draw(seed)
    m1, m2 = prepare(map1, CONFIG.solving), prepare(map2, CONFIG.solving)
    hypotheses = propose(m1.straightened, m2.straightened, CONFIG.matching)
    background = Background(m1, m2)
    weighed = [weigh(g, background, CONFIG.evidence) for g in grow_all(m1, m2, hypotheses, CONFIG.solving)]
    true = {(map1.index_from_id[a], map2.index_from_id[b]) for a, b in truth.true_pairs("A", "B")}
    said: dict[str, str] = {}
    for part_name, part in PARTS.items():
        config = replace(CONFIG, evidence=replace(EvidenceConfig(), **dict(part.evidence)))
        left = distinct([part.without(w) for w in weighed], CONFIG.matching.tolerance_m)
        verdict = judged(left, background, config, part.self_match)
        if verdict.decision == "merged":
            pairs = verdict.ranked[0].growth.pairs
            right = CLASSES[name].same and len(pairs & true) >= 0.8 * len(pairs)
            said[part_name] = "right" if right else "wrong"
    return name, said


def main() -> None:
    """Judge the pairs, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=10)
    parser.add_argument("--first", type=int, default=500_000, help="number of the first seed")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--tuning", action="store_true")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    seeds = TUNING_SEEDS if args.tuning else TEST_SEEDS
    first = args.first % len(seeds)
    jobs = [(name, seeds[first + 1000 * k + n]) for n in range(args.pairs) for k, name in enumerate(COLUMNS)]
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # one thread a process; workers load numpy anew
        os.environ.setdefault(variable, "1")
    counts: Counter[tuple[str, str, str]] = Counter()
    with get_context("spawn").Pool(args.jobs) as pool:
        for name, said in pool.imap_unordered(judge_pair, jobs, chunksize=4):
            counts.update((name, part, outcome) for part, outcome in said.items())
    which = f"{'tuning' if args.tuning else 'test'} seeds, {args.pairs} of each class from {seeds[first]} on"
    about = f"{platform.machine()}, Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}"
    lines = [
        f"Simulated pairs, {which}; {about}. Merged right, wrong:",
        "",
        f"| left out | {' | '.join(COLUMNS)} |",
        "|---" * (len(COLUMNS) + 1) + "|",
    ]
    for part in PARTS:
        cells = [f"{counts[name, part, 'right']}, {counts[name, part, 'wrong']}" for name in COLUMNS]
        lines.append(f"| {part} | {' | '.join(cells)} |")
    text = "\n".join(lines) + "\n"
    print(text)
    if args.write:
        (HERE / "results").mkdir(exist_ok=True)
        (HERE / "results" / "evidence-ablation.md").write_text(text)


if __name__ == "__main__":
    main()
