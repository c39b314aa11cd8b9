"""Films of replays: how many frames there are, of which moments, and that none of them waits in memory."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mapfuse.datasets import read_map, recordings
from mapfuse.datasets.logfile import write_log
from mapfuse.datasets.logs import Log, LogHeader, Odometry
from mapfuse.fusion.online.replay import Replay
from mapfuse.fusion.show import film as films
from mapfuse.fusion.show.film import Film, Shot
from mapfuse.fusion.show.gif import GifStream


def straight_on(name: str, start: float, end: float) -> Log:
    """A log of odometry alone, of each tenth of a second."""
    count = round((end - start) * 10) + 1
    return Log(LogHeader(name), [Odometry(start + k / 10, k / 10, 0.0, 0.0) for k in range(count)])


def frames_of(path: Path) -> list[np.ndarray]:
    with Image.open(path) as film:
        found = []
        for k in range(film.n_frames):
            film.seek(k)
            found.append(np.asarray(film.convert("RGB")).astype(int))
    return found


def test_a_film_of_logs_without_events_has_its_last_moment(tmp_path: Path, command):
    files = [tmp_path / "a.log.jsonl", tmp_path / "b.log.jsonl"]
    for name, file in zip("ab", files, strict=True):
        write_log(Log(LogHeader(name), ()), file)
    assert command("replay", *files, "--quiet", "--video", tmp_path / "film.gif") == 0
    assert len(frames_of(tmp_path / "film.gif")) == 1


@pytest.mark.parametrize(("start", "end"), [(40.0, 55.0), (0.0, 30.0)])
def test_a_film_of_a_second_part_is_as_long_as_any(start, end, tmp_path, command, monkeypatch):
    first = Replay([straight_on(name, 0.0, 40.0) for name in "ab"])
    for _ in first.run():
        pass
    first.save(tmp_path / "state")
    # the new robot's log lies after the state, or before it
    write_log(straight_on("c", start, end), tmp_path / "c.log.jsonl")
    drawn: list[float] = []
    monkeypatch.setattr(films, "draw_shot", lambda _figure, shot, **_: drawn.append(shot.t))
    monkeypatch.setattr(films, "HEIGHT", 0.1)
    film = tmp_path / "film.gif"
    assert command("replay", tmp_path / "c.log.jsonl", "--quiet", "--resume", tmp_path / "state", "--video", film) == 0
    # 15 s of eight frames each, and the last moment
    assert 118 <= len(drawn) <= 122
    assert drawn[-1] == end
    assert np.diff(drawn[:-1]) == pytest.approx((end - start) / 120, abs=0.11)


def test_speed_counts_from_where_the_second_part_begins(tmp_path, command, monkeypatch):
    first = Replay([straight_on(name, 0.0, 40.0) for name in "ab"])
    for _ in first.run():
        pass
    first.save(tmp_path / "state")
    write_log(straight_on("a", 40.0, 41.0), tmp_path / "a.log.jsonl")
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    assert command("replay", tmp_path / "a.log.jsonl", "--quiet", "--resume", tmp_path / "state", "--speed", "1") == 0
    assert max(slept) <= 1.0


def test_frames_are_written_as_they_come(tmp_path: Path):
    maps = {name: read_map(recordings.path(name)) for name in recordings.SCENES["ground-floor"]}
    sizes = []
    with Film(tmp_path / "film.gif") as film:
        for k in range(3):
            film.add(Shot(60.0 * k, maps, None))
            (part,) = tmp_path.glob(".mapfuse-*/film.gif")
            sizes.append(part.stat().st_size)
    # but for what a file holds back
    assert sizes[0] > 20_000
    assert (tmp_path / "film.gif").stat().st_size < 2 * sizes[0]
    found = frames_of(tmp_path / "film.gif")
    assert len(found) == 3
    assert found[0].shape == (540, 960, 3)
    assert (found[0] != found[1]).any()
    assert not list(tmp_path.glob(".mapfuse-*"))


def test_a_gif_reads_as_what_was_written(tmp_path: Path):
    rng = np.random.default_rng(3)
    frames = [np.full((54, 96, 3), 255, np.uint8)]
    for k in range(5):
        frames.append(frames[-1].copy())
        # the third is as the second
        if k != 2:
            frames[-1][5 * k : 5 * k + 9, 7 * k : 7 * k + 11] = rng.integers(0, 255, 3)
    with (tmp_path / "a.gif").open("wb") as stream:
        gif = GifStream(stream, seconds=0.12)
        for frame in frames:
            gif.add(Image.fromarray(frame))
        gif.finish()
    found = frames_of(tmp_path / "a.gif")
    assert len(found) == len(frames)
    assert all((a == b).all() for a, b in zip(found, frames, strict=True))
    with Image.open(tmp_path / "a.gif") as film:
        assert (film.info["duration"], film.info["loop"]) == (120, 0)
