"""``mapfuse compare --paper``: Table 1 and the figures, into a folder."""

from __future__ import annotations

import io
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .console import log_levels, note, say

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mapfuse.fusion.compare import PaperRow
    from mapfuse.fusion.compare.hospital import OnPlan
    from mapfuse.fusion.compare.sheets import Sheet


def compare_paper(output: Path, seed: int, *, quiet: bool) -> None:
    """Writes table and figures; shows the table."""
    with log_levels(datasets=logging.ERROR):  # what is odd in these maps is known and meant
        _compare_paper(output, seed, quiet=quiet)


def _compare_paper(output: Path, seed: int, *, quiet: bool) -> None:
    from mapfuse.datasets.paper import TABLE_1
    from mapfuse.fusion.batch.table import write_csv, write_parquet
    from mapfuse.fusion.compare import paired, paper_rows, sheets, summaries, table
    from mapfuse.fusion.compare.figures import save_all
    from mapfuse.fusion.compare.methods import HEURISTIC, OPTIMISED
    from mapfuse.fusion.report import compare_report

    from .progress import progress

    if quiet:
        rows = paper_rows()
    else:
        with progress("combinations of maps", len(TABLE_1)) as advance:
            rows = paper_rows(advance=advance)
    figures, laid = _figures(rows)
    written = list(save_all(figures, output))
    values = table.paper_table(rows)
    write_csv(output / "table-1.csv", table.PAPER_COLUMNS, values)
    written.append(output / "table-1.csv")
    if write_parquet(output / "table-1.parquet", values, table.PAPER_COLUMNS, table.kind_of):
        written.append(output / "table-1.parquet")
    else:
        note("mapfuse: table-1.parquet is left out: pyarrow isn't installed; it comes with mapfuse[parquet]")
    evaluations = [e for row in rows for e in row.ours.values()]
    shown = [
        sheets.paper_sheet(rows),
        sheets.summary_sheet(summaries(evaluations, seed), "Summary, reconstruction"),
        sheets.paired_sheet(paired(evaluations, HEURISTIC, OPTIMISED, seed)),
        _hospital_sheet(laid),
    ]
    sentence = "Table 1 and the figures of Dedeoglu and Sukhatme (2000), on a reconstruction of their maps."
    compare_report(sheets.PAPER_TITLE, sentence, shown, output / "compare.html", pictures=_pictures(figures))
    if quiet:
        return
    for sheet in shown:
        say(sheet.text() + "\n")
    say(f"wrote {', '.join(str(path) for path in (*written, output / 'compare.html'))}")


def _figures(rows: Sequence[PaperRow]) -> tuple[dict[str, Figure], dict[str, OnPlan]]:
    """The paper's figures by name, and the hospital's merges over the plan."""
    from mapfuse.datasets import read_map, recordings
    from mapfuse.datasets.recordings.make_paper_maps import hospital_building
    from mapfuse.datasets.truth import read_truth
    from mapfuse.fusion import fuse
    from mapfuse.fusion.compare.figures import figure_2, figure_8, maps_figure, merge_figure
    from mapfuse.fusion.compare.heuristic import merge_by_heuristic
    from mapfuse.fusion.compare.hospital import on_plan
    from mapfuse.fusion.compare.methods import HEURISTIC, OPTIMISED
    from mapfuse.fusion.compare.optimised import merge_of
    from mapfuse.fusion.compare.paper import paper_config

    D1, D7, D9, west, east = (read_map(recordings.path(name)) for name in ("D1", "D7", "D9", *recordings.HOSPITAL))
    config = paper_config()
    hospital = west, east
    heuristic, fused = merge_by_heuristic(*hospital), fuse(hospital, config)
    truth, building = read_truth(recordings.truth_path("hospital")), hospital_building()
    merges = {HEURISTIC: heuristic, OPTIMISED: merge_of(fused)}
    laid = {
        name: on_plan(hospital, merge, truth, building, bent=name == OPTIMISED)
        for name, merge in merges.items()
        if merge.landmarks
    }
    figures = {
        "fig-2": figure_2(rows),
        "fig-3": maps_figure(3, (D9, D7)),
        "fig-4": merge_figure(4, (D9, D7), merge_by_heuristic(D9, D7), fuse([D9, D7], config)),
        "fig-5": merge_figure(5, (D9, D1), merge_by_heuristic(D9, D1), fuse([D9, D1], config), alone=(1,)),
        "fig-7": merge_figure(7, hospital, heuristic, fused),
        "fig-8": figure_8(building, laid),
    }
    return figures, laid


def _hospital_sheet(laid: dict[str, OnPlan]) -> Sheet:
    import numpy as np

    from mapfuse.fusion.compare.sheets import Sheet

    rows = tuple(
        (
            name,
            f"{found.reach:.1f}",
            f"{found.rms:.2f}",
            f"{found.wall_off.max(initial=0.0):.2f}",
            f"{found.wall_percent:.2f}",
            f"{np.median(found.length_percents):.2f}",
            f"{found.length_percents.max(initial=0.0):.2f}",
        )
        for name, found in laid.items()
    )
    heads = (
        "method",
        "reach [m]",
        "landmark rms [m]",
        "worst wall [m]",
        "in % of the reach",
        "lengths off %",
        "worst %",
    )
    note = (
        "Laid over the plan as a whole. Lengths: between places more than 50 m apart, median and worst. The paper finds"
        " every wall of its hospital within 1 m over more than 50 m, about 2 %."
    )
    return Sheet("Hospital (simulated), both maps merged", heads, rows, note)


def _pictures(figures: dict[str, Figure]) -> dict[str, bytes]:
    found = {}
    for name, figure in figures.items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=100)
        found[name.replace("fig-", "Fig. ")] = buffer.getvalue()
    return found
