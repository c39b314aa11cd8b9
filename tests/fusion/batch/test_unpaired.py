"""Which pairs a solved group asks for, of those that weren't compared."""

import msgspec

from mapfuse.fusion.batch.unpaired import ENOUGH, unpaired


def fused(*landmarks):
    """A group's file: type, x, y, and the maps that have the landmark."""
    return msgspec.json.encode(
        {
            "landmarks": [
                {"type": type_, "x": x, "y": y, "sources": {name: [f"{name}{k}"] for name in maps}}
                for k, (type_, x, y, maps) in enumerate(landmarks)
            ]
        }
    )


def test_maps_with_many_landmarks_in_common_by_way_of_others_are_compared():
    common = [("tree", 10.0 * k, 0.0, "abc" if k < ENOUGH - 1 else "ab") for k in range(ENOUGH + 2)]
    assert unpaired(fused(*common), set()) == {("a", "b")}
    assert unpaired(fused(*common, ("tree", -10.0, 0.0, "ac")), {("a", "b")}) == {("a", "c")}


def test_landmarks_at_one_place_of_one_type_and_different_maps_ask():
    assert unpaired(fused(("tree", 0.0, 0.0, "a"), ("tree", 1.9, 0.0, "b")), set()) == {("a", "b")}
    assert unpaired(fused(("tree", 0.0, 0.0, "a"), ("tree", 2.1, 0.0, "b")), set()) == set()
    assert unpaired(fused(("tree", 0.0, 0.0, "a"), ("door", 1.9, 0.0, "b")), set()) == set()
    assert unpaired(fused(("tree", 0.0, 0.0, "ab"), ("tree", 1.9, 0.0, "bc")), set()) == set()
    assert unpaired(fused(), set()) == set()
