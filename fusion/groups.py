"""`fuse`: recorded maps to a `FusedMap`."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache
from importlib.metadata import version
from itertools import combinations
from typing import Any

import numpy as np

from mapfuse.datasets.errors import MapError, MapfuseError, Problem
from mapfuse.datasets.jsondata import encode
from mapfuse.datasets.mapfile import checked_dict, map_to_dict
from mapfuse.datasets.maps import LandmarkMap

from .assemble import assembled
from .config import FuseConfig
from .far import carried, middle, put_back, shifted
from .known import KnownTransform, check_known_maps
from .members import Emptiness
from .noisefit import scaled
from .pairresult import mixture
from .pairwise import compare
from .prepared import PreparedMap, prepare
from .result import FusedMap
from .settle import settled
from .told import told

#: A map that reaches further than this [m] from its middle is refused.
LARGEST_MAP_M = 1e6

#: How often maps are fused again with the noise that their residuals speak for, and by how much [log] two scales may
#: differ and be the same.
NOISE_ROUNDS, SAME_SCALE = 3, 0.03


def fuse(
    maps: Sequence[LandmarkMap], config: FuseConfig | None = None, known: Sequence[KnownTransform] = ()
) -> FusedMap:
    """Fuse recorded maps, whose relative poses are unknown, into one with its uncertainty.

    Every pair is compared; what can be true together is merged into groups, each solved as one graph of landmarks. The
    result does not depend on the order of the maps, up to the choice of reference: a group is in the frame of its
    first map. Maps that are merged with none stand in their own frames. Overlap need not exist: ``decision`` says what
    the evidence suffices for. ``known``: about where some maps lie in others.

    Raises `MapfuseError` for no map, and for two maps of one name; `MapError` for a map that breaks a rule of the
    format; `TooLargeError` where joint covariances would not fit.

    >>> from mapfuse.datasets import read_map, recordings
    >>> names = ("ground-floor-vespucci", "ground-floor-milka")
    >>> fused = fuse([read_map(recordings.path(name)) for name in names])
    >>> fused.decision, fused.probability > 0.99
    ('merged', True)
    """
    config = config or FuseConfig()
    maps = tuple(maps)
    documents = check_maps(maps)
    check_known_maps(known, {m.name for m in maps})
    provenance = provenance_of(maps, config, known, documents)
    origins = {m.name: middle(m) for m in maps}
    known = [replace(k, T12=carried(k.T12, *(-origins[name] for name in k.maps))) for k in known]
    near = tuple(shifted(m, origins[m.name]) for m in maps)
    scales = dict.fromkeys(origins, 1.0)
    fused = _fuse(near, scales, known, provenance, config)
    for _ in range(NOISE_ROUNDS if config.solving.estimate_noise else 0):
        before, scales = scales, {name: fit.estimate for name, fit in fused.noise.items()}
        if all(abs(np.log(scales[name] / before[name])) < SAME_SCALE for name in scales):
            break
        fused = _fuse(near, scales, known, provenance, config)
    return put_back(fused, maps, origins, mixture)


def _fuse(
    maps: tuple[LandmarkMap, ...],
    scales: Mapping[str, float],
    known: Sequence[KnownTransform],
    provenance: dict[str, Any],
    config: FuseConfig,
) -> FusedMap:
    """Fuse maps whose stated standard deviations are multiplied by ``scales``, by name."""
    prepared = {m.name: prepared_for(scaled(m, scales[m.name]), config) for m in maps}
    # one order of work whatever the order of input, so that the answer is the same to the last digit
    pairs = list(combinations(sorted(prepared), 2))
    comparisons = {
        (a, b): compare(prepared[a], prepared[b], config, known=known, keep_solution=len(pairs) == 1)
        for a, b in told(pairs, "pairs of maps compared")
    }
    emptiness = Emptiness(prepared, config.evidence)
    choice, joints = settled(prepared, comparisons, config, emptiness.against)
    fused = assembled(prepared, comparisons, choice, joints, emptiness, config.solving, provenance, scales)
    return replace(fused, sources={m.name: m for m in maps})


def prepared_for(near: LandmarkMap, config: FuseConfig) -> PreparedMap:
    """A map near its origin, prepared as these parameters ask for."""
    return prepare(near, config.solving, np.deg2rad(config.evidence.corridor_angle_deg))


def check_maps(maps: Sequence[LandmarkMap]) -> tuple[dict[str, Any], ...]:
    """The maps as they stand in files. Raises `MapfuseError` for maps that can't be fused, saying why."""
    if not maps:
        raise MapfuseError("there is nothing to fuse: give at least one map")
    twice = next((name for name, count in Counter(m.name for m in maps).items() if count > 1), None)
    if twice is not None:
        raise MapfuseError(f"two maps are named {twice!r}; names must differ, since results refer to them")
    documents = []
    for m in maps:
        document, problems = checked_dict(m)
        if problems := problems or strays(m):
            raise MapError(m.name, problems)
        documents.append(document)
    return tuple(documents)


def strays(m: LandmarkMap) -> tuple[Problem, ...]:
    """Landmarks so far from all others that nothing can be computed with them."""
    if not len(m) or np.ptp(m.positions, axis=0).max() <= LARGEST_MAP_M:
        return ()
    off = np.abs(m.positions - np.median(m.positions, axis=0)).max(axis=1)
    reason = f"lies more than {LARGEST_MAP_M / 1000:g} km from the middle of the map"
    return tuple(Problem(f"landmarks[{k}]", f"{m.ids[k]!r} {reason}") for k in np.flatnonzero(off > LARGEST_MAP_M))


def provenance_of(
    maps: Sequence[LandmarkMap],
    config: FuseConfig,
    known: Sequence[KnownTransform] = (),
    documents: Sequence[Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """What a result was made of: version, parameters, a hash of each map, and what was known of where they lie.

    ``documents``: the maps as they stand in files (`check_maps`), where they are at hand.
    """
    documents = [map_to_dict(m) for m in maps] if documents is None else documents
    inputs = {m.name: hashlib.sha256(encode(document)).hexdigest() for m, document in zip(maps, documents, strict=True)}
    stated = [{"maps": list(k.maps), "T12": k.T12.array.tolist(), "covariance": _rows(k)} for k in known]
    told = {"known": stated} if stated else {}
    return {"mapfuse": _version(), "inputs": inputs, "config": asdict(config), **told}


@cache
def _version() -> str:
    """Of this package; reading its metadata takes a millisecond each time."""
    return version("mapfuse")


def _rows(known: KnownTransform) -> list[list[float]]:
    assert known.T12.covariance is not None
    rows: list[list[float]] = known.T12.covariance.tolist()
    return rows
