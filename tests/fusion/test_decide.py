"""`posterior`, `log_alike` and `decide`: what several hypotheses and none are worth against each other."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapfuse.fusion.config import DecisionConfig, EvidenceConfig
from mapfuse.fusion.decide import decide, log_weights, posterior

# what other floors of one plan change has tests of its own
EVIDENCE, DECISION = EvidenceConfig(alike_rate=0.0), DecisionConfig()
odds = st.floats(-200, 200)


def probabilities(log_odds, contradiction=None, *, prior=0.5, **evidence):
    """Of hypotheses with these odds; ``contradiction``: the log odds of being the right place, not an alias of it."""
    log_odds = np.array(log_odds, dtype=float)
    contradiction = np.zeros(len(log_odds)) if contradiction is None else np.array(contradiction, dtype=float)
    return posterior(log_odds, -contradiction, EvidenceConfig(**evidence), prior)


def decided(hypotheses, config=DECISION):
    """The verdict on hypotheses, each a number of nats, or that and its contradiction; of floors that are unique."""
    pairs = [h if isinstance(h, tuple) else (h, 0.0) for h in hypotheses]
    weighed = [SimpleNamespace(log_odds=odds, alike=-np.inf, spared=0.0) for odds, _ in pairs]
    return decide(weighed, -np.array([contradiction for _, contradiction in pairs]), EVIDENCE, config)


def test_one_hypothesis_against_none_is_bayes():
    for x in (-5.0, 0.0, 3.0):
        assert probabilities([x]) == pytest.approx([1 / (1 + np.exp(-x)), 1 / (1 + np.exp(x))])
    # with a prior for overlap of 0.2 the odds are those times a quarter
    assert probabilities([np.log(4.0)], prior=0.2) == pytest.approx([0.5, 0.5])


def test_what_a_rival_did_not_pay_for_the_search_makes_it_no_image():
    # 25 nats and a rival of 7: with 1.5 nats more that it was spared it weighs as before against the best
    alias, spared = np.zeros(2), np.array([0.0, 1.5])
    before = log_weights(np.array([25.0, 7.0]), alias, EVIDENCE)
    after = log_weights(np.array([25.0, 8.5]), alias, EVIDENCE, spared)
    assert after == pytest.approx(before, abs=1e-6)
    # where the building can't repeat itself its odds are its odds
    unique = EvidenceConfig(repetition_rate=0.0)
    assert log_weights(np.array([25.0, 8.5]), alias, unique, spared) == pytest.approx([25.0, 8.5])


def test_without_hypotheses_there_is_no_overlap():
    assert probabilities([]).tolist() == [1.0]


@given(st.lists(st.tuples(odds, odds), max_size=8), st.floats(1e-6, 1 - 1e-6), st.floats(0, 1))
def test_they_are_probabilities_whatever_the_numbers(hypotheses, prior, rate):
    log_odds, contradiction = ([h[k] for h in hypotheses] for k in range(2))
    p = probabilities(log_odds, contradiction, prior=prior, repetition_rate=rate)
    assert len(p) == len(hypotheses) + 1
    assert p.sum() == pytest.approx(1)
    assert ((p >= 0) & (p <= 1)).all()


@given(st.lists(st.tuples(odds, odds), min_size=1, max_size=6), st.randoms())
def test_the_order_of_hypotheses_does_not_matter(hypotheses, random):
    # two of exactly equal odds are interchangeable only where their contradictions are equal as well
    hypotheses = list({h[0]: h for h in hypotheses}.values())
    shuffled = random.sample(range(len(hypotheses)), len(hypotheses))
    p = probabilities(*zip(*hypotheses, strict=True))
    q = probabilities(*zip(*(hypotheses[k] for k in shuffled), strict=True))
    np.testing.assert_allclose(q, [*p[shuffled], p[-1]], atol=1e-12)


def test_two_that_are_equally_strong_share():
    p = probabilities([30.0, 30.0])
    assert p[:2] == pytest.approx([0.5, 0.5])
    assert p[2] < 1e-9


def test_a_building_that_repeats_itself_does_not_say_by_overlap_where_one_is():
    # The second overlaps far less, but beats none by far, which no wrong place does by chance: it is an alias, or
    # the right one. Nothing contradicts either, so it is even.
    assert probabilities([40.0, 25.0])[:2] == pytest.approx([0.5, 0.5], abs=0.01)


def test_a_weak_rival_does_not_matter():
    p = probabilities([30.0, -8.0, -12.0])
    assert p[0] > 0.9999
    alone = probabilities([8.0])[0]
    assert probabilities([8.0, -12.0])[0] == pytest.approx(alone, abs=1e-3)


def test_what_contradicts_a_rival_decides():
    assert probabilities([40.0, 25.0], [0.0, -8.0])[0] > 0.999
    assert probabilities([40.0, 25.0], [-8.0, 0.0])[1] > 0.999
    # in between: by so much as the contradictions differ
    p = probabilities([40.0, 30.0], [0.0, -2.0])
    assert np.log(p[0] / p[1]) == pytest.approx(2.0, abs=0.01)


def test_where_nothing_ever_repeats_the_odds_alone_count():
    p = probabilities([12.0, 9.0], [0.0, 50.0], repetition_rate=0.0)
    assert np.log(p[0] / p[1]) == pytest.approx(3.0)


def test_the_further_a_rival_is_beyond_chance_the_more_it_weighs():
    shares = [probabilities([30.0, rival])[1] for rival in (-10.0, -5.0, 0.0, 3.0, 6.0, 15.0)]
    assert shares == sorted(shares)
    assert shares[0] < 1e-3
    assert shares[-1] > 0.45


@pytest.mark.parametrize("log_odds", [[3.0], [6.0, 5.5], [-2.0, -3.0]])
def test_a_higher_prior_for_overlap_raises_every_hypothesis(log_odds):
    p = np.array([probabilities(log_odds, prior=prior) for prior in (0.01, 0.1, 0.5, 0.9, 0.99)])
    assert (np.diff(p[:, :-1], axis=0) > 0).all()
    assert (np.diff(p[:, -1]) < 0).all()


def test_decisions_at_the_threshold():
    accept = DecisionConfig(accept=0.95)
    edge = float(np.log(0.95 / 0.05))
    assert decided([edge + 1e-9], accept).decision == "merged"
    assert decided([edge - 1e-9], accept).decision == "ambiguous"
    assert decided([0.0], accept).decision == "ambiguous"
    assert decided([-edge + 1e-9], accept).decision == "ambiguous"
    assert decided([-edge - 1e-9], accept).decision == "no_overlap"
    assert decided([300.0], DecisionConfig(accept=1.0)).decision == "merged"  # 1 to the last bit


def test_rivals_that_cannot_be_told_apart_are_ambiguous_and_ranked():
    found = decided([10.0, 30.0, (29.0, -0.5)])
    assert found.decision == "ambiguous"
    assert found.ranked[0].log_odds == 30.0
    assert (np.diff(found.probabilities) <= 0).all()
    assert found.probabilities.sum() + found.no_overlap == pytest.approx(1)


def test_the_ranking_follows_the_probabilities_even_against_the_odds():
    found = decided([(40.0, -9.0), 30.0])
    assert [w.log_odds for w in found.ranked] == [30.0, 40.0]
    assert found.decision == "merged"


def on_another_floor(*hypotheses, rate=0.001):
    """The verdict on hypotheses (log odds, what each shows on another floor against on this one)."""
    weighed = [SimpleNamespace(log_odds=odds, alike=alike, spared=0.0) for odds, alike in hypotheses]
    return decide(weighed, np.zeros(len(weighed)), EvidenceConfig(alike_rate=rate), DECISION)


@given(odds, st.floats(-1.0, 30.0), st.floats(1e-6, 0.5))
def test_another_floor_of_one_plan_is_bayes_over_three(log_odds, alike, rate):
    # same floor: e^S; another one of its plan: rate e^(S + a); buildings that have nothing in common: 1 - rate
    same, other, nothing = log_odds, np.log(rate) + log_odds + alike, np.log1p(-rate)
    expected = np.exp(same - np.logaddexp(same, np.logaddexp(other, nothing)))
    assert on_another_floor((log_odds, alike), rate=rate).probabilities[0] == pytest.approx(expected, abs=1e-12)


def test_what_is_missing_tells_floors_of_one_plan_apart_however_much_agrees():
    # with an agreement that nothing contradicts (log 1/2 at least) the same floor stays sure
    assert on_another_floor((300.0, np.log(0.5))).decision == "merged"
    # 1000 to 1 that it is another floor makes up for one building in a thousand having one
    even = on_another_floor((300.0, np.log(1000.0)))
    assert even.decision == "ambiguous"
    assert even.no_overlap == pytest.approx(0.5, abs=1e-6)
    assert on_another_floor((300.0, 12.0)).decision == "no_overlap"
    assert on_another_floor((300.0, 12.0), rate=0.0).decision == "merged"


def test_another_floor_changes_nothing_between_rivals():
    plain, alike = (on_another_floor((20.0, 3.0), (17.0, -0.5), rate=rate) for rate in (0.0, 0.2))
    ratio = [float(np.log(v.probabilities[0] / v.probabilities[1])) for v in (plain, alike)]
    assert ratio[0] == pytest.approx(ratio[1])
    assert alike.no_overlap > plain.no_overlap


def test_nothing_to_decide_is_no_overlap():
    found = decided([])
    assert (found.decision, found.no_overlap, found.ranked) == ("no_overlap", 1.0, ())
    assert found.probabilities.shape == (0,)
