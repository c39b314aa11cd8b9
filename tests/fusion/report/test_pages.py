"""Pages as files: whole, alone, small, and with nothing in them that could be taken for markup."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap
from mapfuse.datasets.transform import Transform
from mapfuse.fusion.evidence import Terms
from mapfuse.fusion.report import fused_report, map_report
from mapfuse.fusion.report.fused_data import MOST_RIVALS
from mapfuse.fusion.report.joint import coupling
from mapfuse.fusion.report.plain import pose_between, shades
from mapfuse.fusion.report.terms import WORDS
from mapfuse.fusion.result import FusedMap


class Tags(HTMLParser):
    """Every element of a page with its attributes, and the text within scripts and styles."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.inside: dict[str, str] = {}
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        tag, attributes = self.found[-1] if self.found else ("", {})
        if tag in ("script", "style"):
            self.inside.setdefault(attributes.get("id") or tag, data)


def data_of(page: str) -> dict:
    return json.loads(Tags(page).inside["data"])


def test_a_page_stands_alone(merged: FusedMap) -> None:
    page = fused_report(merged)
    for tag, attributes in Tags(page).found:
        assert tag not in ("iframe", "object", "embed", "form", "base")
        assert not attributes.keys() & {"src", "srcset", "action", "style", "onload", "onclick"}
        assert attributes.get("href", "data:,") == "data:,"
    assert not re.findall(r"https?://(?!www\.w3\.org/2000/svg)", page)
    assert "@import" not in page
    assert "url(" not in page
    assert not re.findall(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|new Function", page)


def test_the_policy_allows_exactly_the_page_s_own_script_and_style(merged: FusedMap) -> None:
    tags = Tags(fused_report(merged))
    (policy,) = [
        a["content"] for t, a in tags.found if t == "meta" and a.get("http-equiv") == "Content-Security-Policy"
    ]
    assert policy is not None
    for name in ("script", "style"):
        digest = base64.b64encode(hashlib.sha256(tags.inside[name].encode()).digest()).decode()
        assert f"{name}-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy


@pytest.mark.parametrize("hostile", ["</script><script>alert(1)</script>", "<!--<script>", "\u2028]]>", "a\u202eb\x00"])
def test_no_text_ends_the_data_or_begins_an_element(merged: FusedMap, hostile: str) -> None:
    other = replace(merged.pairs[0], reason=hostile)
    plain, page = fused_report(merged), fused_report(replace(merged, pairs=(other,)))
    assert [t for t, _ in Tags(page).found] == [t for t, _ in Tags(plain).found]
    said = data_of(page)["pairs"][0]["reason"]
    assert said == "".join(c if c.isprintable() else "\ufffd" for c in hostile)


def test_the_same_result_gives_the_same_page(merged: FusedMap, tmp_path: Path) -> None:
    target = tmp_path / "out.html"
    assert fused_report(merged, target) == fused_report(merged)
    assert target.read_text(encoding="utf-8") == fused_report(merged)


def test_a_thousand_landmarks_fit_into_3_megabytes(results: Mapping[str, FusedMap]) -> None:
    large = results["large"]
    assert len(large.landmarks) == 1000
    assert large.joint_covariances[0] is not None
    assert len(fused_report(large).encode()) < 3_000_000


def test_the_answer_is_there_without_scripts(results: Mapping[str, FusedMap]) -> None:
    said = {name: fused_report(fused).split("<main>")[0] for name, fused in results.items()}
    assert 'were merged.</span> <span class="sure">98 % sure that this is right.' in said["merged"]
    assert "x = 9.00 ± 0.20 m" in said["merged"]
    assert "2 placements are possible" in said["ambiguous"]
    assert "The likeliest placement has 55 %, no overlap has 5 %." in said["ambiguous"]
    assert "99.6 % sure that they share nothing" in said["no_overlap"]
    assert "2 of 3 maps were merged into one group; 1 stands alone." in said["partial"]
    assert "<dd><bdi>simulated</bdi></dd>" in said["merged"]


def test_a_folder_that_is_not_there_is_an_error_of_ours(merged: FusedMap, tmp_path: Path) -> None:
    with pytest.raises(MapfuseError, match="folder"):
        fused_report(merged, tmp_path / "nowhere" / "out.html")


def test_every_term_of_the_evidence_has_words() -> None:
    assert {f.name for f in fields(Terms)} <= WORDS.keys()


def test_rivals_beyond_the_most_are_counted_and_summed(merged: FusedMap) -> None:
    pair = merged.pairs[0]
    many = tuple(replace(pair.hypotheses[1], probability=0.001) for _ in range(MOST_RIVALS + 6))
    fused = replace(merged, pairs=(replace(pair, hypotheses=(pair.hypotheses[0], *many)),))
    (shown,) = data_of(fused_report(fused))["pairs"]
    assert len(shown["rivals"]) == MOST_RIVALS
    assert shown["left_out"] == 7
    assert shown["left_out_text"] == "0.7 %"


def test_residuals_are_those_of_the_recorded_maps(merged: FusedMap) -> None:
    rival = data_of(fused_report(merged))["pairs"][0]["rivals"][1]
    first, second = (merged.sources[name] for name in merged.maps)
    (match,) = merged.pairs[0].hypotheses[1].correspondences
    T12 = merged.pairs[0].hypotheses[1].T12
    at1, at2 = first[match[0]], second[match[1]]
    expected = np.array([at1.x, at1.y]) - T12.apply([at2.x, at2.y])
    assert rival["apart"] == [pytest.approx(expected, abs=1e-3)]


def test_maps_far_from_their_origins_are_drawn_around_their_own(merged: FusedMap) -> None:
    T12, origin1, origin2 = np.array([5e6, -3e6, 0.7]), np.array([5.1e6, -2e6]), np.array([1.2e6, 7e5])
    point = np.array([3.0, 4.0])
    x, y, theta = pose_between(T12, origin1, origin2)
    expected = Transform(*T12).apply(point + origin2) - origin1
    assert Transform(x, y, theta).apply(point) == pytest.approx(expected, abs=1e-3)
    far = replace(
        merged.sources["D7"], landmarks=tuple(replace(l, x=l.x + 5e6) for l in merged.sources["D7"].landmarks)
    )
    scene = data_of(map_report(far))["maps"][0]["scene"]
    assert np.abs(scene["at"]).max() < 100
    assert scene["at"][0] + scene["origin"][0] == pytest.approx(far.landmarks[0].x, abs=1e-3)


def test_coupling_is_the_largest_canonical_correlation() -> None:
    rng = np.random.default_rng(4)
    A = rng.normal(size=(9, 9))
    joint = JointCovariance(("a", "b", "c"), 3, A @ A.T)
    found = coupling(joint)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        a, b = slice(3 * i, 3 * i + 2), slice(3 * j, 3 * j + 2)
        La, Lb = np.linalg.cholesky(joint.matrix[a, a]), np.linalg.cholesky(joint.matrix[b, b])
        white = np.linalg.solve(La, joint.matrix[a, b]) @ np.linalg.inv(Lb).T
        assert found[i, j] == pytest.approx(np.linalg.svd(white)[1][0], abs=1e-9)
    assert np.diag(found) == pytest.approx(1)


def test_coupling_of_a_landmark_that_is_exactly_known_is_none() -> None:
    joint = JointCovariance(("a", "b"), 2, np.diag([0.0, 0.0, 1.0, 1.0]))
    assert coupling(joint).tolist() == [[0.0, 0.0], [0.0, 1.0]]


def test_shades_keep_the_closest_of_a_block() -> None:
    values = np.zeros((5, 5))
    values[4, 0] = 1.0
    shown = shades(values, 2)
    assert (shown["size"], shown["step"]) == (2, 3)
    assert list(base64.b64decode(shown["bytes"])) == [0, 0, 255, 0]


def test_a_map_s_page_has_its_joint_covariance_in_the_order_of_the_map(merged: FusedMap) -> None:
    scene = data_of(map_report(merged.to_map()))["maps"][0]["scene"]
    assert sorted(scene["joint"]["order"]) == list(range(len(merged.landmarks)))
    assert scene["covariances"][0] == [0.04, 0.0, 0.09]


# In a notebook -------------------------------------------------------------------------------------------------------


def test_a_notebook_shows_answer_and_picture(merged: FusedMap) -> None:
    shown = merged._repr_html_()
    assert "These two maps overlap" in shown
    (image,) = [a["src"] for t, a in Tags(shown).found if t == "img"]
    assert image is not None
    assert base64.b64decode(image.removeprefix("data:image/png;base64,")).startswith(b"\x89PNG")


@pytest.mark.parametrize("decision", ["merged", "ambiguous", "no_overlap"])
def test_a_notebook_shows_every_placement(results: Mapping[str, FusedMap], decision: str) -> None:
    pair = results[decision].pairs[0]
    tags = Tags(pair._repr_html_())
    assert [t for t, _ in tags.found].count("tr") == 1 + 1 + len(pair.hypotheses) + 1 + 1
    assert "no overlap" in pair._repr_html_()


def test_nothing_in_a_notebook_is_markup(make_merged: Callable[..., FusedMap]) -> None:
    name = "<img src=x onerror=alert(1)>"
    fused = make_merged(names=(name, "D9"))
    for shown in (fused._repr_html_(), fused.pairs[0]._repr_html_(), fused.sources[name]._repr_html_()):
        assert not [a for t, a in Tags(shown).found if "onerror" in a]
    assert LandmarkMap("empty")._repr_html_().count("<tr>") == 2
    shown = LandmarkMap("D1", (Landmark("a", "tree", 0.0, 0.0), Landmark("b", "tree", 3.0, 4.0)))._repr_html_()
    assert "3.0 m x 4.0 m" in shown
    assert [t for t, _ in Tags(shown).found].count("circle") == 2
