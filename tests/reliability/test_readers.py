"""What is read from a card or from an output folder may hold anything: it is refused by name, or it is something."""

import io
import json
import re
import string
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from agalign.cameras.discover import discover
from agalign.cameras.makers import known_cameras
from agalign.cameras.metadata import Tags, read_tags
from agalign.cameras.tag_transfer import capture_tags
from agalign.cameras.xmp import Packet
from agalign.config import albedos
from agalign.errors import AgalignError, SidecarError
from agalign.host.files import RUN_FILE
from agalign.pixels.raster import probe
from agalign.records.panels_and_sky import read_panels
from agalign.records.run_record import read_run_record
from agalign.records.sidecar_file import read_checked, read_sidecar
from agalign.values.capture import Band
from agalign.values.image import OutputGrid

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::UserWarning")]

ANY_FILE = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
EDITS = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=12)
STORED = (Band("", Path("IMG_0001_1.tif"), 1, 1280, 960, "uint16"),)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


def refusal(read: Callable[[Any], object], given: object) -> str | None:
    """How it is refused; anything but an AgalignError is a fault."""
    try:
        read(given)
    except AgalignError as error:
        return str(error)
    return None


@pytest.fixture(scope="module")
def images(flight: Path) -> list[bytes]:
    """A band's file of a camera, without most of its pixels, and a plain one."""
    camera = next(flight.rglob("IMG_0001_1.tif"))
    tags = {t.code: t for t in tifffile.TiffFile(camera).pages[0].tags.values()}
    extra = [(700, 1, len(tags[700].value), tags[700].value, True), (271, 2, 0, "MicaSense", True)]
    files = io.BytesIO(), io.BytesIO()
    for file, extratags in zip(files, ([], extra), strict=True):
        tifffile.imwrite(file, np.arange(48, dtype=np.uint16).reshape(6, 8), extratags=extratags)
    return [file.getvalue() for file in files]


@ANY_FILE
@given(edits=EDITS, which=st.integers(0, 1), cut=st.floats(0.2, 1.0))
def test_any_tiff(images: list[bytes], tmp_path: Path, edits: list[tuple[float, int]], which: int, cut: float) -> None:
    path = tmp_path / "a_red.tif"
    data = bytearray(images[which])
    for place, value in edits:
        data[int(place * (len(data) - 1))] = value
    path.write_bytes(data[: int(cut * len(data))])
    for read in (probe, read_tags):
        said = refusal(read, path)
        assert said is None or ("a_red.tif" in said and "\n" not in said)
    band = Band("red", path, 1, 8, 6, "uint16")
    capture_tags(band, OutputGrid(0, 0, 8, 6))


TAGS = {
    "Camera": "BandName RigRelatives PerspectiveFocalLength PrincipalPoint CentralWavelength VignettingPolynomial"
    " FlyingHeight",
    "DLS": "Yaw HorizontalIrradiance",
    "MicaSense": "RadiometricCalibration",
    "drone-dji": "DewarpData CalibratedHMatrix VignettingData SensorGain Irradiance GimbalYawDegree",
}
NAMED = [f"{prefix}:{name}" for prefix, names in TAGS.items() for name in names.split()]
LISTS = st.lists(st.floats(), max_size=12).map(lambda numbers: ",".join(map(str, numbers)))


@ANY_FILE
@given(
    values=st.dictionaries(st.sampled_from(NAMED), st.text() | st.floats().map(str) | LISTS),
    make=st.sampled_from(["MicaSense", "DJI", "Parrot", "Sentera", "MAPIR", ""]),
)
def test_any_packet(values: dict[str, str], make: str) -> None:
    text = "".join(f"<{k}>{re.sub('[<&>]', '', v)}</{k}>" for k, v in values.items())
    packet = Packet.parse(
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description xmlns:Camera="http://pix4d.com/camera/1.0/" xmlns:DLS="http://micasense.com/DLS/1.0/"'
        ' xmlns:MicaSense="http://micasense.com/MicaSense/1.0/" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/">'
        f"{text}</rdf:Description></rdf:RDF></x:xmpmeta>"
    )
    tags = Tags(make=make, model="x", xmp=packet.values())
    camera = next(c for c in known_cameras(None) if c.recognises(tags))
    bands = camera.bands(Path("IMG_0001_1.tif"), tags, STORED)
    camera.with_shared_rig(bands, [tags])
    camera.pose(tags)
    camera.motion(tags)
    assert Packet.parse(packet.serialised()).values() == packet.values()


NAMES = st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), min_size=1, max_size=40)


@ANY_FILE
@given(names=st.lists(NAMES.map(lambda n: n + ".tif"), max_size=6, unique_by=str.lower))
def test_any_names(tmp_path_factory: pytest.TempPathFactory, images: list[bytes], names: list[str]) -> None:
    folder = tmp_path_factory.mktemp("names")
    for name in names:
        try:
            (folder / name).write_bytes(images[0])
        except OSError:
            continue
    said = refusal(discover, folder)
    if said is not None:
        assert str(folder) in said
        return
    result = discover(folder)
    labels = [c.label.lower() for c in result.captures]
    assert len(labels) == len(set(labels))
    assert all(c.name and not c.name.startswith("/") for c in result.captures)


@ANY_FILE
@given(data=JSON, raw=st.binary(max_size=60) | st.none())
def test_any_json(tmp_path: Path, data: object, raw: bytes | None) -> None:
    contents = json.dumps(data).encode() if raw is None else raw
    for name, read, given_path in (
        ("a.json", read_sidecar, tmp_path / "a.json"),
        ("a.json", read_checked, tmp_path / "a.json"),
        ("panels.json", read_panels, tmp_path),
        (RUN_FILE, read_run_record, tmp_path),
    ):
        (tmp_path / name).write_bytes(contents)
        with pytest.raises(SidecarError, match=re.escape(name)):
            read(given_path)


@given(text=st.text(string.printable))
def test_any_albedo(text: str) -> None:
    said = refusal(albedos, text)
    if said is None:
        assert all(0 < value <= 1 for _, value in albedos(text))
        assert len({name for name, _ in albedos(text)}) == len(albedos(text))
    else:
        assert "--panel-albedo" in said
