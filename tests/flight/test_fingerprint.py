import dataclasses

import numpy as np

from agalign.cameras.discover import discover
from agalign.config import SeedSettings, Settings
from agalign.flight.fingerprint import fingerprint, hashed


def test_how_numpy_prints_changes_nothing(flight: object) -> None:
    capture = discover(flight).captures[0]
    before = fingerprint(capture, Settings())
    with np.printoptions(precision=2, threshold=3, suppress=True):
        assert fingerprint(capture, Settings()) == before


def test_what_a_result_depends_on_changes_it(flight: object) -> None:
    capture = discover(flight).captures[0]
    band = capture.bands[0]
    moved = band.to_rig + 1e-12
    captures = [
        capture,
        dataclasses.replace(capture, bands=(dataclasses.replace(band, to_rig=moved), *capture.bands[1:])),
        dataclasses.replace(capture, bands=(dataclasses.replace(band, lens=None), *capture.bands[1:])),
        dataclasses.replace(capture, reference_index=0),
    ]
    result = {fingerprint(c, Settings()) for c in captures}
    result.add(fingerprint(capture, Settings(seed=SeedSettings(only=True))))
    assert len(result) == 5


def test_facts_are_told_apart() -> None:
    facts = [
        ("ab", "c"),
        ("a", "bc"),
        (1,),
        ("1",),
        (1.0,),
        ([1, 2],),
        ([1], [2]),
        (None,),
        (np.ones(2),),
        (np.ones(3),),
    ]
    assert len({hashed(*f) for f in facts}) == len(facts)
