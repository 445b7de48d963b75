"""What the report knows and draws, without a browser."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import agalign
from agalign.errors import InputError, SidecarError
from agalign.flight.rig_file import read_rig
from agalign.products.report import pages, pages_exist, write_pages
from agalign.products.report.rigs import CHART_HEIGHT, drifts_of, rig_views
from agalign.synthetic import flight as synthetic

pytestmark = pytest.mark.slow

PAGE = Path(agalign.__file__).parent / "products" / "report"


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    synthetic.make_flight(folder / "in", captures=4, size_px=(480, 360), rng_seed=5)
    agalign.align_folder(folder / "in", folder / "out")
    return folder / "out"


def facts_of(page: str) -> dict[str, object]:
    result = re.search(r'<script type="application/json" id="facts">(.*?)</script>', page, re.DOTALL)
    assert result is not None
    return json.loads(result.group(1))  # type: ignore[no-any-return]


def test_the_page_has_the_facts_of_every_capture(out: Path) -> None:
    facts = facts_of((out / "index.html").read_text(encoding="utf-8"))
    assert facts["schema"] == "agalign-report/1"
    captures = facts["captures"]
    assert [c["label"] for c in captures] == [f"0000SET/000/IMG_000{i}" for i in (1, 2, 3, 4)]  # type: ignore[attr-defined]
    truth = json.loads((out.parent / "in" / "truth.json").read_text())
    for capture in captures:  # type: ignore[attr-defined]
        sidecar = json.loads((out / f"{capture['label']}.json").read_text())
        assert capture["preview"]["file"] == f"{capture['label']}.preview.jpg"
        assert capture["crop"] == sidecar["output"]["crop"]
        assert capture["relief"] is None
        ties = truth[sidecar["capture"]]["bands"]
        for pair, part in zip(capture["bands"], sidecar["bands"], strict=True):
            assert (pair["band"], pair["status"]) == (part["band"], part["status"])
            if pair["status"] == "reference":
                continue
            # How far the files lie apart is known exactly here.
            known = np.asarray(ties[part["file"]]["ties"])
            apart_px = np.median(np.linalg.norm(known[:, 2:] - known[:, :2], axis=1))
            assert pair["apart_px"] == pytest.approx(apart_px, abs=0.3)
            shifts = [v for t in part["metrics"]["tiles"] for v in t["shift_px"]]
            step = facts["shift_step_px"]
            back = [None if v is None else v * step for v in pair["shifts"]]  # type: ignore[operator]
            assert back == [None if v is None else pytest.approx(v, abs=0.006) for v in shifts]
            lattice = facts["lattices"][pair["lattice"]]  # type: ignore[index]
            assert lattice == [v for t in part["metrics"]["tiles"] for v in t["centre_px"]]


def test_the_page_has_the_relief(out: Path, tmp_path: Path) -> None:
    sidecar = json.loads((out / "0000SET" / "000" / "IMG_0001.json").read_text())
    nodes = {name: [[0.0, 0.0]] for name in ("reference_px", "plane_px", "slope")}
    for band in sidecar["bands"]:
        if band["band"] in ("NIR", "Red"):
            part = {"file": "IMG_0001.relief.tif", "baseline": [0.5, 0.5], "occluded": 0.0125}
            band["relief"] = part | nodes
    sidecar["preview"]["relief"] = {"parallax_px": [-3.0, 7.0], "range_m": None}
    (tmp_path / "a b").mkdir()
    (tmp_path / "a b" / "IMG_0001.json").write_text(json.dumps(sidecar))
    write_pages(tmp_path, pytest.fail)
    (capture,) = facts_of((tmp_path / "index.html").read_text(encoding="utf-8"))["captures"]  # type: ignore[misc,attr-defined]
    assert capture["relief"] == "a%20b/IMG_0001.relief.tif"
    assert capture["preview"]["relief"] == sidecar["preview"]["relief"]
    occluded = {pair["band"]: pair["occluded"] for pair in capture["bands"]}
    assert occluded == {"Blue": None, "Green": None, "Red": 0.0125, "NIR": 0.0125, "Red edge": None}


def test_a_thousand_captures_make_a_small_page(out: Path, tmp_path: Path) -> None:
    """Of captures like these: 4 kB each, page and table and all."""
    sidecar = json.loads((out / "0000SET" / "000" / "IMG_0001.json").read_text())
    for number in range(50):
        (tmp_path / f"IMG_{number:04d}.json").write_text(json.dumps(sidecar | {"capture": f"IMG_{number:04d}"}))
    few = (out / "index.html").stat().st_size
    write_pages(tmp_path, pytest.fail)
    many = (tmp_path / "index.html").stat().st_size
    # Bands that the usual windows do not show everywhere have up to 168 small ones, 1 kB more for a capture.
    assert (many - few) / (50 - 4) < 6500


def test_the_page_asks_nobody_for_anything(out: Path) -> None:
    page = (out / "index.html").read_text(encoding="utf-8")
    assert not re.findall(r"(?:src|href)=\"(?:https?:)?//", page)
    assert "default-src 'none'" in page


def test_pages_stand_until_a_sidecar_is_newer(out: Path) -> None:
    assert pages_exist(out)
    path = out / "0000SET" / "000" / "IMG_0001.json"
    path.write_bytes(path.read_bytes())
    assert not pages_exist(out)
    write_pages(out, pytest.fail)
    assert pages_exist(out)


def test_pages_without_an_unreadable_sidecar_are_written_again(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(path: Path) -> None:
        raise SidecarError(f"{path.name}: cannot be read (Input/output error)")

    problems: list[str] = []
    with monkeypatch.context() as patched:
        patched.setattr(pages, "read_sidecar", fails)
        write_pages(out, problems.append)
    assert "IMG_0001.json: cannot be read (Input/output error)" in problems
    assert not pages_exist(out)
    write_pages(out, pytest.fail)
    assert pages_exist(out)


def test_the_rig_is_read_without_its_network(out: Path, tmp_path: Path) -> None:
    (path,) = (out / "models").glob("*.safetensors")
    camera, rig = read_rig(path)
    assert "RedEdge" in camera
    assert rig is not None
    assert set(rig.mean) == {"Blue", "Red", "NIR", "Red edge"}
    (view,) = rig_views(out, pytest.fail)
    assert [b["band"] for b in view.bands] == list(rig.mean)
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "a.safetensors").write_bytes(path.read_bytes()[:2000])
    with pytest.raises(InputError, match=r"a\.safetensors: its rig cannot be read"):
        read_rig(tmp_path / "models" / "a.safetensors")
    said: list[str] = []
    assert rig_views(tmp_path, said.append) == []
    assert len(said) == 1


def told(label: str, offsets: dict[str, tuple[float, float]]) -> dict[str, object]:
    bands = [{"band": name, "status": "aligned", "offset_px": offset} for name, offset in offsets.items()]
    return {"label": label, "captured_at": f"2026-06-21T10:00:{label}", "camera": "camera", "bands": bands}


def test_drift_is_drawn_along_the_direction_of_change_and_breaks_where_nothing_is_known() -> None:
    captures = [
        told(f"{i:02d}", {"NIR": (10 + 3 * i, 4 * i), "Blue": (-i, 0)} if i != 3 else {"Blue": (-3, 0)})
        for i in range(7)
    ]
    (drift,) = drifts_of(captures)
    assert drift.full_px == pytest.approx(15, abs=0.01)
    assert [len(line.points) for line in drift.lines] == [2, 1]
    heights = [[float(p.split(",")[1]) for run in line.points for p in run.split()] for line in drift.lines]
    ends = sorted((heights[0][0], heights[0][-1]))
    assert ends == pytest.approx([CHART_HEIGHT / 2 * (1 - 0.92 * s) for s in (1, -1)], abs=0.1)
    # Along the same baseline in the other direction, a band is drawn beside the first, not against it.
    assert np.sign(np.diff(heights[0])).tolist() == np.sign(np.diff(heights[1][:3] + heights[1][4:])).tolist()
    assert drifts_of(captures[:2]) == []


def test_the_scripts_types_are_right() -> None:
    tsc = shutil.which("tsc")
    if tsc is None:
        pytest.skip("TypeScript is not installed")
    options = "--allowJs --checkJs --noEmit --strict --skipLibCheck --target es2022 --lib es2022,dom,dom.iterable"
    done = subprocess.run(
        [tsc, *options.split(), str(PAGE / "page.js")], capture_output=True, text=True, check=False
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
