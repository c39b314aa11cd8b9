"""How large a page is and how soon a browser shows it: `.venv/bin/python benchmarks/report_bench.py [--quick]`.

Simulated results: one pair with 1,000 landmarks and its joint covariance, and a batch run of 500 maps with 20,000
compared pairs in groups of ten. Needs Chromium and its driver. Loading is timed from opening the file until the page
says that it is ready, the middle one of several times; how long the page's own thread was busy meanwhile depends less
on what else the machine does.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import tempfile
import time
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap
from mapfuse.datasets.transform import Transform
from mapfuse.fusion import FusedMap, write_fused
from mapfuse.fusion.report import batch_report, fused_report
from mapfuse.fusion.result import Frame, FusedLandmark, PairResult, RankedHypothesis

HOME = Transform(0.0, 0.0, 0.0, np.zeros((3, 3)))
HEAD = "map1,map2,decision,probability,x,y,theta,count,log_evidence,seconds,error"


def result(names: tuple[str, ...], landmarks: int, rng: np.random.Generator, *, joint: bool) -> FusedMap:
    """A merged result of these maps, each of which recorded two thirds of the landmarks."""
    at = rng.uniform(0, 4 * np.sqrt(landmarks), (landmarks, 2))
    seen = {name: np.flatnonzero(rng.random(landmarks) < 0.67) for name in names}
    maps = {
        name: LandmarkMap(name, tuple(Landmark(f"p{k}", "tree", *at[k].tolist()) for k in seen[name])) for name in names
    }
    of = [{name: (f"p{k}",) for name in names if k in set(seen[name].tolist())} for k in range(landmarks)]
    fused = tuple(
        FusedLandmark(f"m{k}", 0, "tree", *at[k].tolist(), None, np.eye(2) * 0.04, of[k], 0.9)
        for k in range(landmarks)
        if of[k]
    )
    pairs = tuple(
        PairResult((a, b), "merged", 0.999, 0.001, (RankedHypothesis(HOME, 9, 20.0, 0.999),), (), "they agree")
        for a, b in combinations(names, 2)
    )
    n = len(fused)
    C = JointCovariance(tuple(l.id for l in fused), 2, np.eye(2 * n) * 0.03 + 0.01) if joint else None
    frames = {name: Frame(0, HOME) for name in names}
    return FusedMap("merged", 0.999, names, (names,), frames, pairs, fused, {}, maps, (C,))


def write_run(folder: Path, maps: int, pairs: int, rng: np.random.Generator) -> None:
    """A folder as a batch run leaves it."""
    names = [f"map-{k:04}" for k in range(maps)]
    for k in range(0, maps, 10):
        group = tuple(names[k : k + 10])
        write_fused(result(group, 120, rng, joint=False), folder / f"{k // 10:03}.fused.json", embed_sources=False)
    rows = [HEAD]
    for _ in range(pairs):
        a, b = sorted(rng.choice(maps, 2, replace=False).tolist())
        decision = "merged" if a // 10 == b // 10 else "no_overlap"
        rows.append(f"{names[a]},{names[b]},{decision},{rng.random():.4f},{rng.normal():.3f},1,0.5,7,3.2,0.5,")
    (folder / "pairs.csv").write_text("\n".join(rows), encoding="utf-8")


def load_seconds(page: Path, repeat: int) -> tuple[float, float]:
    """Middle time [s] until Chromium has the page ready, and that for which the page's thread was busy."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        for flag in ("--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-quic",
                     "--disable-background-networking", "--disable-component-update", "--disable-sync",
                     f"--user-data-dir={profile}"):  # fmt: skip
            options.add_argument(flag)
        driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
        times, busy = [], []
        for _ in range(repeat):
            driver.get("about:blank")
            driver.execute_cdp_cmd("Performance.enable", {"timeDomain": "threadTicks"})
            before = _busy(driver)
            begin = time.perf_counter()
            driver.get(page.as_uri())
            assert driver.execute_script("return document.documentElement.dataset.ready") == "yes"
            times.append(time.perf_counter() - begin)
            busy.append(_busy(driver) - before)
        driver.quit()
    return statistics.median(times), statistics.median(busy)


def _busy(driver: Any) -> float:
    metrics = driver.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]
    return float({m["name"]: m["value"] for m in metrics}["TaskDuration"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of everything, once")
    quick = parser.parse_args().quick
    part, repeat = (10, 1) if quick else (1, 5)
    rng = np.random.default_rng(1)
    print("| page | size [MB] | ready in Chromium [s] | page's thread busy [s] |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fused_report(result(("A", "B"), 1000 // part, rng, joint=True), folder / "pair.html")
        write_run(folder, 500 // part, 20_000 // part, rng)
        batch_report(folder, folder / "batch.html")
        for title, page in (
            (f"one pair, {1000 // part} landmarks", folder / "pair.html"),
            (f"a batch of {500 // part} maps, {20_000 // part} pairs", folder / "batch.html"),
        ):
            size = page.stat().st_size / 1e6
            ready, busy = load_seconds(page, repeat)
            print(f"| {title} | {size:.2f} | {ready:.2f} | {busy:.2f} |", flush=True)


if __name__ == "__main__":
    main()
