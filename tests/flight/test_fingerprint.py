import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from agalign.cameras.discover import discover
from agalign.config import Settings, WriteSettings
from agalign.flight.fingerprint import fingerprint, hashed
from agalign.values.capture import Georeference


def test_every_fact_that_a_result_depends_on_changes_it(flight: Path) -> None:
    capture = discover(flight).captures[0]
    band = capture.bands[0]
    changes = [
        {"name": "other"},
        {"band_index": 2},
        {"lens": None},
        {"lens": replace(band.lens, distortion=(0.0,) * 5)},
        {"to_rig": band.to_rig + 1e-12},
        {"georeference": Georeference(np.eye(3), "EPSG:32632")},
        {"radiometry": None},
        {"radiometry": replace(band.radiometry, gain=2 * band.radiometry.gain)},
        {"radiometry": replace(band.radiometry, quantity="reflectance")},
        {"path": band.path.with_name("missing.tif")},
    ]
    captures = [replace(capture, bands=(replace(band, **changed), *capture.bands[1:])) for changed in changes]
    captures += [capture, replace(capture, reference_index=0)]
    fingerprints = [fingerprint(c, Settings()) for c in captures]
    fingerprints.append(fingerprint(capture, Settings(write=WriteSettings(qa=True))))
    assert len(set(fingerprints)) == len(fingerprints)


def test_a_file_that_is_written_again_changes_the_fingerprint_and_another_flight_does_not(
    flight: Path, tmp_path: Path
) -> None:
    shutil.copytree(flight, tmp_path / "copy")
    capture = discover(tmp_path / "copy").captures[0]
    path = capture.bands[0].path
    status, seen = path.stat(), [fingerprint(replace(capture, flight_id="x"), Settings())]
    assert seen == [fingerprint(capture, Settings())]
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns + 1000))
    seen.append(fingerprint(capture, Settings()))
    with path.open("ab") as file:
        file.write(b"\0")
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert len({*seen, fingerprint(capture, Settings())}) == 3


def test_different_facts_have_different_hashes() -> None:
    facts = [("ab", "c"), ("a", "bc"), (1,), ("1",), (1.0,), ([1, 2],), ([1], [2]), (None,)]
    facts += [(np.ones(2),), (np.ones(3),)]
    assert len({hashed(*f) for f in facts}) == len(facts)
