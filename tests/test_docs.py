"""What docs/ claims: identities of docs/evidence.md against independent code, names against the folders."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from itertools import pairwise, product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, vonmises

from mapfuse.datasets import Landmark, LandmarkMap, Link, Noise, Transform, read_map, recordings
from mapfuse.factors import correspondence
from mapfuse.fusion import (
    background,
    coverage,
    credibility,
    decide,
    evidence,
    existence,
    growth,
    known,
    passing,
    regularity,
    repetition,
    result,
)
from mapfuse.fusion.background import Background
from mapfuse.fusion.config import DecisionConfig, EvidenceConfig, FuseConfig, SolvingConfig
from mapfuse.fusion.elastic import Joined
from mapfuse.fusion.evidence import look_elsewhere
from mapfuse.fusion.growth import Growth
from mapfuse.fusion.pair import fuse_pair
from mapfuse.fusion.pairresult import mixture
from mapfuse.fusion.prepared import prepare

ROOT = Path(__file__).resolve().parents[1]
EVIDENCE = (ROOT / "docs" / "evidence.md").read_text(encoding="utf-8")
ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PACKAGES = ("datasets", "matching", "factors", "fusion")


# Match, miss and void ------------------------------------------------------------------------------------------------


def ring_density(x, sigma, length):
    """Normal density of a difference of places on a ring."""
    turns = np.arange(-3, 4) * length
    return np.exp(-(((x[..., None] + turns) / sigma) ** 2) / 2).sum(axis=-1) / (sigma * np.sqrt(2 * np.pi))


def sum_over_associations(hit, miss1, miss2):
    """Sum over all one-to-one associations of the product of factors, by dynamic programming over subsets of map 2."""
    n1, n2 = hit.shape
    subsets = np.arange(2**n2)
    total = (subsets == 0).astype(float)
    for i in range(n1):
        extended = total * miss1
        for j in range(n2):
            with_j = subsets[(subsets >> j) & 1 == 1]
            extended[with_j] += total[with_j ^ (1 << j)] * hit[i, j]
        total = extended
    used = np.array([bin(s).count("1") for s in subsets])
    return float(total @ miss2 ** (n2 - used))


def test_expected_likelihood_ratio_without_overlap_is_1():
    rng = np.random.default_rng(0)
    nu, d1, d2, fa1, fa2, sigma, length = 0.25, 0.8, 0.7, 0.2, 0.1, 1.5, 12.0
    mu1, mu2 = nu * d1 / (1 - fa1), nu * d2 / (1 - fa2)
    ratios = []
    for _ in range(6000):
        x1, x2 = (rng.uniform(0, length, rng.poisson(mu * length)) for mu in (mu1, mu2))
        hit = (1 - fa1) * (1 - fa2) * ring_density(x1[:, None] - x2[None, :], sigma, length) / nu
        ratios.append(sum_over_associations(hit, 1 - (1 - fa1) * d2, 1 - (1 - fa2) * d1))
    void = np.exp(nu * d1 * d2 * length)
    mean, error = void * np.mean(ratios), void * np.std(ratios) / np.sqrt(len(ratios))
    assert error < 0.05
    assert abs(mean - 1) < 4 * error
    assert mean / void < 0.3, "without the void term every placement would be punished"


def test_a_straight_corridor_is_weighed_as_derived_by_hand():
    """Two maps of one corridor along x; a door in each that the other lacks; everything where it truly is."""
    noise1 = Noise(detection_rate=0.8, false_alarm_rate=0.2, door_detection_rate=0.9, door_false_alarm_rate=0.05)
    noise2 = Noise(
        distance_sigma_per_metre=0.03, detection_rate=0.7, false_alarm_rate=0.1, door_detection_rate=0.85,
        door_false_alarm_rate=0.03,
    )  # fmt: skip
    m1 = prepare(straight_corridor("one", noise1, 0.0, door=7.0, detections=2), SolvingConfig())
    m2 = prepare(straight_corridor("two", noise2, 5.0, door=19.0, detections=1), SolvingConfig())
    T12, pairs = np.array([-5.0, 0.0, 0.0]), np.arange(3)
    joined = Joined(m1, m2, T12, pairs, pairs)
    config = EvidenceConfig()
    weighed = evidence.weigh(Growth(joined, 1), Background(m1, m2), config)

    length = 24.0
    (fa1, through1), (fa2, through2), door_fa1, door_fa2 = believed(0.2**2), believed(0.1), 0.05**2, 0.03
    corner, junction = ((1 - a) / 0.8 + (1 - b) / 0.7 for a, b in ((fa1, fa2), (through1, through2)))
    door = ((1 - door_fa1) / 0.9, (1 - door_fa2) / 0.85)
    nu = {"corner": 2 * corner / 48, "junction": junction / 48, "door": sum(door) / 48}
    # from the junction at 15 to the corner at 24, then from both of them to the corner at 0
    place = 0.05**2
    v9 = (0.1 + 0.02 * 9) ** 2 + (0.1 + 0.03 * 9) ** 2
    v15 = (0.1 + 0.02 * 15) ** 2 + (0.1 + 0.03 * 15) ** 2
    first, second = 2 * place + v9, v15 + place + 1 / (1 / place + 1 / (place + v9))
    densities = -0.5 * np.log(2 * np.pi * first) - 0.5 * np.log(2 * np.pi * second)
    detections = 2 * np.log((1 - fa1) * (1 - fa2)) + np.log((1 - through1) * (1 - through2))
    clutter = 3 * np.log(4) - 2 * np.log(nu["corner"]) - np.log(nu["junction"])
    expected = {
        # two maps of three landmarks hold six distances
        "prior": np.log(length / (2 * length * length)) - look_elsewhere(0.0, 6, config),
        "matches": detections + clutter + densities,
        "points": 0.0,
        "regular": 0.0,
        # nobody went on from a door: half of the robots that pass one are taken to go straight on
        "misses": np.log(door_fa1 + (1 - door_fa1) * 0.15 / 2) + np.log(door_fa2 + (1 - door_fa2) * 0.1 / 2),
        "void": length * ((nu["corner"] + nu["junction"]) * 0.8 * 0.7 + nu["door"] * 0.9 * 0.85),
        "arms": 0.0,
        "crossings": 0.0,
        "compass": 0.0,
        "known": 0.0,
        "stated": 0.0,
        "walls": 0.0,
    }
    found = {field.name: getattr(weighed.terms, field.name) for field in fields(weighed.terms)}
    assert found == pytest.approx(expected, abs=2e-3)


def believed(fa):
    """False are, of two corners at which the corridor ends, each, and a junction that was driven straight through."""
    corners, junctions = 0.05, 0.5  # the shares that are driven straight through
    for _ in range(100):
        corner, junction = fa / (1 - fa) * 0.05 / (1 - corners), fa / (1 - fa) * 0.95 / junctions
        corners = 0.05 * 10 / (2 / (1 + corner) + 10)
        junctions = (1 / (1 + junction) + 0.5 * 2) / (1 / (1 + junction) + 2)
    return corner / (1 + corner), junction / (1 + junction)


def straight_corridor(name, noise, start, door, detections):
    """Corners at 0 and 24 and a junction at 15 along x, linked; a door beside them that no link leads to."""

    def landmark(id_, type_, x, *links):
        return Landmark(id_, type_, start + x, 0.0, links=links, detection_counter=detections)

    def way(heading, target, distance):
        return Link("open", heading, connected_to_id=target, distance=distance, travel_counter=1)

    quarter = np.pi / 2
    return LandmarkMap(
        name,
        (
            landmark("a", "corner", 0.0, way(0.0, "j", 15.0), Link("open", quarter), Link("blocked", np.pi),
                     Link("blocked", -quarter)),
            landmark("j", "junction", 15.0, way(0.0, "b", 9.0), Link("open", quarter), way(np.pi, "a", 15.0),
                     Link("blocked", -quarter)),
            landmark("b", "corner", 24.0, Link("blocked", 0.0), Link("blocked", quarter), way(np.pi, "j", 9.0),
                     Link("open", -quarter)),
            landmark("d", "door", door, Link("open", 0.0), Link("door", quarter), Link("open", np.pi),
                     Link("blocked", -quarter)),
        ),
        noise=noise,
    )  # fmt: skip


def test_overlap_is_the_union_of_what_covers_each_link_averaged_over_the_two_maps():
    """Against counting the points of a fine grid, on one line, the landmarks of the two maps interleaving."""
    rng, step = np.random.default_rng(5), 0.002
    for _ in range(20):
        ends1, ends2 = (np.sort(rng.uniform(0, 30, k)) for k in rng.integers(2, 7, 2))
        if rng.integers(2):
            ends2 = ends2[::-1]  # travelled the other way

        def covered(own, others):
            inside = np.arange(own.min(), own.max(), step)
            covers = [(inside > min(a, b)) & (inside < max(a, b)) for a, b in pairwise(others)]
            return np.any(covers, axis=0).sum() * step

        s1, s2 = (coverage.Segments(*(np.column_stack([e, 0 * e]) for e in (v[:-1], v[1:]))) for v in (ends1, ends2))
        expected = (covered(ends1, ends2) + covered(ends2, ends1)) / 2
        assert coverage.overlap_length(s1, s2, 1.0, 0.3) == pytest.approx(expected, abs=0.02)


# The prior, the compass ----------------------------------------------------------------------------------------------


def test_prior_along_corridors_integrates_to_1():
    def segment(start, end):
        return coverage.Segments(np.array([[start, 0.0]]), np.array([[end, 0.0]]))

    L1, L2 = 31.0, 12.0
    shifts = np.linspace(-L2, L1, 2001)
    lengths = [coverage.overlap_length(segment(0, L1), segment(s, s + L2), 1.0, 0.3) for s in shifts]
    reverse = [coverage.overlap_length(segment(0, L1), segment(s + L2, s), 1.0, 0.3) for s in shifts]
    density = (np.array(lengths) + np.array(reverse)) / (2 * L1 * L2)
    assert np.trapezoid(density, shifts) == pytest.approx(1, abs=1e-3)


def test_compass_is_a_density_against_that_of_other_buildings_with_a_floor():
    m1, m2 = SimpleNamespace(north=(0.4, 0.12)), SimpleNamespace(north=(-2.9, 0.2))
    rotations = np.linspace(-np.pi, np.pi, 4001)
    ratio = np.exp(evidence._compass(m1, m2, rotations))
    # other buildings: half of them stand on one street grid, at any multiple of a quarter turn, half anyhow
    quarters = 0.4 + 2.9 + np.arange(4) * np.pi / 2
    grid = vonmises(kappa=1 / (0.12**2 + 0.2**2)).pdf(rotations[:, None] - quarters).mean(axis=1)
    others = 0.5 * grid + 0.5 / (2 * np.pi)
    assert np.trapezoid(ratio * others, rotations) == pytest.approx(1, abs=0.02)
    assert np.log(ratio.min()) == pytest.approx(np.log(0.001 / (0.5 + 0.5 * 2 * np.pi * grid.max())), abs=0.1)
    assert not evidence._compass(m1, SimpleNamespace(north=None), rotations).any()


# Elastic match -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def floor():
    """The built-in floor, fused as far as the verdict."""
    maps = [read_map(recordings.path(name)) for name in recordings.SCENES["ground-floor"]]
    config = FuseConfig()
    return fuse_pair(*(prepare(m, config.solving) for m in maps), config)


def test_sequential_densities_multiply_to_the_joint_density(floor):
    joined = floor.verdict.ranked[0].growth.joined
    innovation, V = joined.sequential()
    chain = sum(multivariate_normal.logpdf(e, cov=v) for e, v in zip(innovation, V, strict=True))
    joint = multivariate_normal.logpdf(joined.r, cov=joined.covariance)
    assert chain == pytest.approx(joint, abs=1e-6)


def test_each_pair_given_all_others_is_what_these_predict(floor):
    joined = floor.verdict.ranked[0].growth.joined
    innovation, V = joined.leave_one_out()
    for k in range(len(joined.i)):
        others = np.arange(len(joined.i)) != k
        rest = Joined(joined.m1, joined.m2, joined.T0, joined.i[others], joined.j[others])
        predicted, covariance = rest.predict(joined.i[[k]], joined.j[[k]])
        assert np.allclose(predicted[0], innovation[k], atol=1e-6)
        assert np.allclose(covariance[0], V[k], rtol=1e-6, atol=1e-8)


def test_elastic_match_is_where_the_graph_is(floor):
    joined, T12 = floor.verdict.ranked[0].growth.joined, floor.solutions[0].transform(1)
    sigmas = np.sqrt([np.diag(joined.T12_covariance), np.diag(T12.covariance)])
    assert np.all(np.abs(joined.T12 - T12.array) < 0.25 * sigmas[1])
    assert np.allclose(sigmas[0], sigmas[1], rtol=0.1)


# Contradiction, posterior --------------------------------------------------------------------------------------------


def test_alias_is_a_ratio_of_distributions_and_at_least_a_half():
    q = np.array([0.9, 0.55, 0.3, 0.75, 0.12])
    mean = 0.0
    for recorded in product([True, False], repeat=len(q)):
        seen = np.array(recorded)
        alias = repetition.alias(repetition.lacking_odds(q[seen], q[~seen]))
        assert alias > np.log(0.5) - 1e-12
        mean += np.prod(np.where(seen, q, 1 - q)) * np.exp(alias)
    assert mean == pytest.approx(1, abs=1e-12)


def test_repetition_rule_as_stated():
    config = EvidenceConfig()
    plain = EvidenceConfig(repetition_rate=0.0)
    S, alias = np.array([20.0, 17.0]), np.zeros(2)
    assert decide.posterior(S, alias, plain, 0.5)[0] == pytest.approx(0.95, abs=0.005)
    assert decide.posterior(S, alias, config, 0.5)[0] == pytest.approx(0.5, abs=1e-3)

    S, alias, overlap = np.array([9.0, 3.0, 6.0]), np.array([0.3, 1.0, -4.0]), 0.3
    odds = config.repetition_rate / (1 - config.repetition_rate) * np.exp(-config.repetition_odds)
    # a rival is right and the best one its image, or the best one right and the rival its image, or neither an image
    rival = np.exp(S) * (1 + odds * np.exp(S[0] + alias[0])) / (1 + odds * np.exp(S + alias))
    weights = np.array([np.exp(S[0]), *rival[1:], (1 - overlap) / overlap])
    assert np.allclose(decide.posterior(S, alias, config, overlap), weights / weights.sum(), rtol=1e-9)


def test_another_floor_of_one_plan_as_stated():
    S, b, overlap = np.array([9.0, 3.0]), np.array([1.5, -0.4]), 0.3
    weighed = [SimpleNamespace(log_odds=s, alike=k, spared=0.0) for s, k in zip(S, b, strict=True)]
    config = EvidenceConfig(repetition_rate=0.0, alike_rate=0.02)
    verdict = decide.decide(weighed, np.zeros(2), config, DecisionConfig(overlap_prior=overlap))
    none = (1 - overlap) / overlap * (1 - 0.02 + 0.02 * np.exp(S + b).sum())
    weights = np.array([*np.exp(S), none])
    assert np.allclose([*verdict.probabilities, verdict.no_overlap], weights / weights.sum(), rtol=1e-9)


# Existence, covariance over hypotheses -------------------------------------------------------------------------------


def seen_once(type_="corner", fa=0.2, d=0.81):
    noise = Noise(detection_rate=d, false_alarm_rate=fa)
    return prepare(LandmarkMap("m", (Landmark("c", type_, 0.0, 0.0),), noise=noise), SolvingConfig())


def test_existence_is_bayes_for_rare_landmarks():
    nu, fa, d = 0.03, 0.2, 0.81
    false = nu * d * fa / (1 - fa)  # per metre, so that fa of what is recorded is false
    m = seen_once()

    def exact(*seen):
        there, not_there = nu, 1 - nu
        for one in seen:
            there *= d if one else 1 - d
            not_there *= false if one else 1 - false
        return there / (there + not_there)

    assert existence.existence([(m, 0)], [], nu) == pytest.approx(1 - fa)
    assert existence.existence([(m, 0)], [m], nu) == pytest.approx(exact(True, False), abs=0.02)
    assert existence.existence([(m, 0), (m, 0)], [], nu) == pytest.approx(exact(True, True), abs=0.001)
    assert round(existence.existence([(m, 0)], [m], nu), 2) == 0.43
    assert round(existence.existence([(m, 0), (m, 0)], [], nu), 3) == 0.998


def test_mixture_covariance_is_that_of_draws_from_themixture():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(3, 3, 3)) * [[[0.3]], [[0.5]], [[0.2]]]
    covariances = A @ np.swapaxes(A, 1, 2)
    means = np.array([[1.0, 2.0, 3.1], [4.0, -1.0, -3.1], [0.0, 0.0, 2.9]])  # 3.1 and -3.1 are near each other
    probabilities = np.array([0.5, 0.3, 0.1])  # the rest is no overlap
    transforms = [Transform.from_array(T, C) for T, C in zip(means, covariances, strict=True)]
    unwrapped = np.where(means < -3.0, means + 2 * np.pi, means)
    which = rng.choice(3, size=200_000, p=probabilities / probabilities.sum())
    draws = unwrapped[which] + np.einsum("kij,kj->ki", A[which], rng.normal(size=(len(which), 3)))
    assert np.allclose(mixture(transforms, probabilities), np.cov(draws.T), atol=0.03)


# Names and numbers ---------------------------------------------------------------------------------------------------


def test_every_number_stands_as_in_the_code():
    stated = re.findall(r"^\| `(\w+)` \| ([\d., ]+) \|", EVIDENCE, flags=re.MULTILINE)
    weighing = (background, coverage, credibility, evidence, existence, passing, regularity, repetition)
    modules = (*weighing, correspondence, growth, known, result)
    places = (EvidenceConfig(), DecisionConfig(), SolvingConfig(), *modules)
    for name, value in stated:
        found = [getattr(place, name) for place in places if hasattr(place, name)]
        assert found, f"docs/evidence.md names {name}, which isn't there"
        assert np.allclose(found[0], [float(v) for v in value.split(",")]), name
    missing = {field.name for field in fields(EvidenceConfig)} - {name for name, _ in stated}
    assert not missing, "parameters of the evidence that docs/evidence.md doesn't list"


def test_every_term_of_the_evidence_is_derived():
    for field in fields(evidence.Terms):
        assert f"`{field.name}`" in EVIDENCE, field.name


def test_every_module_is_named_and_nothing_else():
    modules = {
        str(file.relative_to(ROOT))
        for package in PACKAGES
        for file in (ROOT / package).rglob("*.py")
        if file.name != "__init__.py"
    }
    named = set()
    listed = ARCHITECTURE[ARCHITECTURE.index("## Modules") :]
    for folder, block in re.findall(r"^### (\S+)\n\n```\n(.*?)^```", listed, flags=re.MULTILINE | re.DOTALL):
        named |= {f"{folder}/{line.split()[0]}" for line in block.splitlines()}
    assert modules - named == set(), "modules without a line in docs/architecture.md"
    assert named - modules == set(), "lines of docs/architecture.md about modules that aren't there"
    for dotted in re.findall(r"`((?:datasets|matching|factors|fusion)(?:\.\w+)+)`", ARCHITECTURE):
        assert f"{dotted.replace('.', '/')}.py" in modules or (ROOT / dotted.replace(".", "/")).is_dir(), dotted


@pytest.mark.parametrize("document", sorted((ROOT / "docs").glob("*.md")), ids=lambda path: path.name)
def test_links_and_files_lead_somewhere(document):
    text = document.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert (document.parent / target).exists(), target
    for path in re.findall(r"`((?:datasets|matching|factors|fusion|tests|docs)/[\w/]+\.\w+)`", text):
        assert (ROOT / path).exists(), path


def test_what_the_code_cites_is_there():
    cited = set()
    for package in PACKAGES:
        for file in (ROOT / package).rglob("*.py"):
            cited |= set(re.findall(r"docs/[\w-]+\.md", file.read_text(encoding="utf-8")))
    assert cited
    assert all((ROOT / path).exists() for path in cited)
    assert "### Elastic match" in EVIDENCE
    assert "**The repetition rule**" in EVIDENCE


NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))


@pytest.mark.parametrize("script", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_its_script_and_small(script):
    jupytext = pytest.importorskip("jupytext")
    notebook = script.with_suffix(".ipynb")
    cells = [[(cell.cell_type, cell.source) for cell in jupytext.read(path).cells] for path in (script, notebook)]
    assert cells[0] == cells[1], f"run: jupytext --sync {script.relative_to(ROOT)}, then execute the notebook"
    assert notebook.stat().st_size < 700_000


@pytest.mark.parametrize("script", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_was_executed_whole_and_shows_no_machine(script):
    notebook = json.loads(script.with_suffix(".ipynb").read_text(encoding="utf-8"))
    assert set(notebook["metadata"]) == {"jupytext", "kernelspec"}
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1)), "executed once, in order"
    outputs = [output for cell in code for output in cell["outputs"]]
    assert {output["output_type"] for output in outputs} <= {"execute_result", "display_data"}, "errors or warnings"
    assert sum("image/png" in output["data"] for output in outputs) >= 2
    text = "".join(json.dumps({**output["data"], "image/png": ""}) for output in outputs)
    assert not re.search(r"(/home/|/root/|/work/|/tmp/|\\\\Users|0x[0-9a-f]{6,}|Traceback)", text)
    assert all(cell["metadata"] == {} for cell in notebook["cells"])


def test_every_notebook_is_listed():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [script for script in NOTEBOOKS if f"](notebooks/{script.stem}.ipynb)" not in readme] == []
    assert {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")} == {script.stem for script in NOTEBOOKS}
