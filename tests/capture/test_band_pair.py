from pathlib import Path

import pytest

from agalign.cameras.discover import DiscoverOptions, discover
from agalign.capture.align import align_capture_bands
from agalign.capture.band_pair import read_pairs
from agalign.config import SeedSettings, Settings


@pytest.mark.parametrize("kind", ["rig", "geo"])
def test_a_seed_that_tags_do_not_give_is_not_replaced_by_another(flight: Path, kind: str) -> None:
    capture = discover(flight, DiscoverOptions(ignore_metadata=True)).captures[0]
    settings = Settings(seed=SeedSettings(force=kind))
    found = align_capture_bands(capture, settings, None, lambda *_: None)
    assert {a.status for a in found.values()} == {"failed"}
    assert {a.reason for a in found.values()} == {f"there is no {kind} seed for it; leave --seed out"}


def test_the_reference_is_worked_out_once_for_all_bands(flight: Path) -> None:
    pairs, left_out = read_pairs(discover(flight).captures[0], Settings())
    assert not left_out
    assert len(pairs) == 4
    assert len({id(p.reference) for p in pairs}) == 1
    reference = pairs[0].reference
    assert reference.seed_spectrum is reference.seed_spectrum
    assert reference.windows is pairs[3].reference.windows
    assert all(p.space == "undistorted" for p in pairs)


def test_without_one_lens_neither_is_corrected(flight: Path) -> None:
    import dataclasses

    capture = discover(flight).captures[0]
    bands = [dataclasses.replace(b, lens=None) if b.name == "NIR" else b for b in capture.bands]
    pairs, _ = read_pairs(dataclasses.replace(capture, bands=tuple(bands)), Settings())
    by_name = {p.name: p for p in pairs}
    assert by_name["NIR"].space == "pixel"
    assert by_name["NIR"].fixed.lens is None
    assert by_name["Red"].fixed.lens is not None
