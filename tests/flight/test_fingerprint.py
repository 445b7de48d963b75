import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agalign.cameras.discover import discover
from agalign.config import SeedSettings, Settings, WriteSettings
from agalign.flight.fingerprint import (
    estimation_fingerprint,
    hashed,
    input_digests,
    input_samples,
    input_states,
    render_fingerprint,
)
from agalign.values.capture import Capture, Georeference
from agalign.values.radiometric_errors import PANEL, too_bright


@pytest.fixture(scope="module")
def capture(flight: Path) -> Capture:
    return discover(flight).captures[0]


def changed_band(capture: Capture, **facts: object) -> Capture:
    return replace(capture, bands=(replace(capture.bands[0], **facts), *capture.bands[1:]))


def fingerprints(capture: Capture, settings: Settings | None = None) -> tuple[str, str]:
    """Of the estimation and of the products."""
    settings = settings or Settings()
    return estimation_fingerprint(capture, settings), render_fingerprint(capture, settings.write, settings.check)


def test_every_fact_that_an_estimation_depends_on_changes_it(capture: Capture) -> None:
    band = capture.bands[0]
    changes = [
        {"name": "other"},
        {"band_index": 2},
        {"lens": None},
        {"lens": replace(band.lens, distortion=(0.0,) * 5)},
        {"to_rig": band.to_rig + 1e-12},
        {"georeference": Georeference(np.eye(3), "EPSG:32632")},
        {"path": band.path.with_name("missing.tif")},
    ]
    captures = [capture, replace(capture, reference_index=0), *(changed_band(capture, **facts) for facts in changes)]
    found = [estimation_fingerprint(c, Settings()) for c in captures]
    found.append(estimation_fingerprint(capture, Settings(seed=SeedSettings(only=True))))
    assert len(set(found)) == len(found)


def test_facts_of_the_products_change_their_fingerprint_alone(capture: Capture) -> None:
    band, of_estimation = capture.bands[0], estimation_fingerprint(capture, Settings())
    by_pose = replace(Georeference(np.eye(3), "EPSG:32632"), accuracy_m=5.0)
    changes = [
        {"radiometry": None},
        {"radiometry": replace(band.radiometry, gain=2 * band.radiometry.gain)},
        {"radiometry": replace(band.radiometry, quantity="reflectance")},
        {"implausible": "its tags lack the irradiance, which other files of the camera have"},
        {"georeference": by_pose},
        {"georeference": replace(by_pose, transform=2 * np.eye(3))},
    ]
    found = [fingerprints(capture), fingerprints(capture, Settings(write=WriteSettings(qa=True)))]
    found += [fingerprints(changed_band(capture, **facts)) for facts in changes]
    found.append(fingerprints(replace(capture, camera=replace(capture.camera, serial="of both of its halves"))))
    assert {estimation for estimation, _ in found} == {of_estimation}
    assert len({products for _, products in found}) == len(found)
    # Each index is a file of its own.
    assert fingerprints(capture, Settings(write=WriteSettings(indices=("ndvi",)))) == found[0]


def test_what_only_the_pixels_tell_does_not_change_the_fingerprint(capture: Capture) -> None:
    """A run compares captures with earlier results before it reads their pixels, which it compares themselves."""
    radiometry = capture.bands[0].radiometry
    known, bright = (
        changed_band(capture, radiometry=replace(radiometry, errors=(*radiometry.errors, error)))
        for error in (PANEL, too_bright(1.3))
    )
    assert fingerprints(bright) == fingerprints(capture) != fingerprints(known)


def test_contents_and_times_of_files_are_compared_and_the_flight_is_not(flight: Path, tmp_path: Path) -> None:
    shutil.copytree(flight, tmp_path / "copy")
    capture = discover(tmp_path / "copy").captures[0]
    band = capture.bands[0]

    def facts() -> tuple[str, ...]:
        functions = input_samples, input_digests, input_states
        return estimation_fingerprint(capture, Settings()), *(function(capture)[band.name] for function in functions)

    before, status = facts(), band.path.stat()
    assert estimation_fingerprint(replace(capture, flight_id="x"), Settings()) == before[0]
    os.utime(band.path, ns=(status.st_atime_ns, status.st_mtime_ns + 1000))
    assert [a == b for a, b in zip(facts(), before, strict=True)] == [True, True, True, False]
    data = bytearray(band.path.read_bytes())
    data[len(data) // 4] ^= 1  # between the samples
    band.path.write_bytes(data)
    assert [a == b for a, b in zip(facts(), before, strict=True)] == [True, True, False, False]
    with band.path.open("ab") as file:
        file.write(b"\0")
    assert [a == b for a, b in zip(facts(), before, strict=True)] == [True, False, False, False]


def test_different_facts_have_different_hashes() -> None:
    facts = [("ab", "c"), ("a", "bc"), (1,), ("1",), (1.0,), ([1, 2],), ([1], [2]), (None,)]
    facts += [(np.ones(2),), (np.ones(3),)]
    assert len({hashed(*f) for f in facts}) == len(facts)
