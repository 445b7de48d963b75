"""The report in a real browser: what it loads, what its parts do, and that names in it are never more than names."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

import agalign
from agalign.config import Settings, WriteSettings
from agalign.rasters.drawing import ReducedBands
from agalign.rasters.preview import preview_bytes, relief_tile, write_preview
from agalign.report import facts
from agalign.report.pages import write_pages
from agalign.synthetic import flight as synthetic

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.full, pytest.mark.filterwarnings("ignore")]

HOSTILE = '<img src=x onerror="window.broken=1">\'</script><script>window.broken=1</script>'
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three captures of a flight: one unchanged, one with black NIR, one with hostile names."""
    folder = tmp_path_factory.mktemp("report")
    synthetic.make_flight(folder / "in", captures=2, size_px=(480, 360), rng_seed=3)
    black = folder / "in" / "0000SET" / "000" / "IMG_0002_4.tif"
    with tifffile.TiffFile(black, mode="r+b") as file:
        file.filehandle.seek(file.pages[0].dataoffsets[0])
        file.filehandle.write(np.full((360, 480), 9, np.uint16).tobytes())
    out = folder / "out"
    agalign.align_folder(folder / "in", out, settings=Settings(write=WriteSettings(error_map=True, indices=("ndvi",))))
    sidecar = json.loads((out / "0000SET" / "000" / "IMG_0001.json").read_text())
    sidecar |= {"capture": "a'b&c\"d", "missing_bands": [HOSTILE], "status": "degraded", "position": None}
    sidecar["camera"]["model"] = HOSTILE
    for band in sidecar["bands"]:
        if band["band"] == "Red":
            band |= {"band": HOSTILE, "status": "seed_only", "reason": HOSTILE}
    sidecar["preview"]["file"] = "a'b&c\"d.preview.jpg"
    (out / "a'b&c\"d.json").write_text(json.dumps(sidecar))
    shutil.copy(out / "0000SET" / "000" / "IMG_0001.preview.jpg", out / "a'b&c\"d.preview.jpg")
    write_pages(out, lambda text: pytest.fail(text))
    return out


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    path = next((p for name in BROWSERS if (p := shutil.which(name))), None)
    if path is None:
        pytest.skip(f"no browser on this machine ({', '.join(BROWSERS)})")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def page(browser: Any, out: Path) -> Iterator[Any]:
    """The report; whatever the console or the network says besides the previews fails the test."""
    page, said = browser.new_page(viewport={"width": 1100, "height": 900}), []
    page.on("console", lambda m: said.append(m.text))
    page.on("pageerror", lambda e: said.append(str(e)))
    page.on("request", lambda r: said.append(r.url) if not r.url.startswith(out.as_uri()) else None)
    page.on("requestfailed", lambda r: said.append(r.url))
    page.goto((out / "index.html").as_uri())
    yield page
    page.close()
    assert said == []


def drawn(page: Any) -> np.ndarray:
    """(height, width, 3): what the stage shows."""
    page.wait_for_timeout(150)
    data = page.locator("canvas").screenshot()
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), np.int32)


def press_on_slider(page: Any, key: str) -> np.ndarray:
    """What is shown after Home, the aligned bands, or End, those before."""
    page.locator("#swipe").focus()
    page.keyboard.press(key)
    return drawn(page)


def choose(page: Any, label: str, value: str) -> None:
    page.get_by_label(label, exact=True).select_option(value)


def show_one_band(page: Any) -> np.ndarray:
    for channel in ("Red", "Green", "Blue"):
        choose(page, f"{channel} channel", "Blue")
    return drawn(page)


def look_at(page: Any, label: str) -> None:
    page.locator("#table tbody th a", has_text=label).click()
    page.wait_for_function("label => document.querySelector('#capture-title').textContent.includes(label)", arg=label)
    page.wait_for_function("() => document.querySelector('canvas').width > 300")


@pytest.fixture
def viewer(page: Any) -> Any:
    """The report with the picture of the first capture."""
    look_at(page, "IMG_0001")
    return page


def opened(browser: Any, out: Path, label: str = "", width: int = 1400, **options: Any) -> Any:
    """A new page, of the capture with this label."""
    page = browser.new_page(viewport={"width": width, "height": 800}, **options)
    page.goto((out / "index.html").as_uri() + (label and f"#capture=0000SET%2F000%2F{label}"))
    return page


def test_what_failed_is_shown_first_in_words_and_in_numbers(page: Any) -> None:
    assert page.locator("section h2").first.inner_text() == "Check these"
    assert "IMG_0002" in page.locator("#capture-title").inner_text()
    assert page.locator(".short").count() >= 2
    assert "Remedy" in page.locator(".short p").first.inner_text()
    words = page.locator(".words").inner_text()
    assert "suitable for indices of single plants" in words
    assert "NIR failed" in words
    assert "NIR was not written" in page.locator("#over-note").inner_text()
    assert "NDVI was not written: NIR is failed" in page.locator("#capture .unwritten").inner_text()
    assert "NDVI was not written for 2 of 3 captures" in page.locator(".verdict").inner_text()
    page.locator("details.more summary").click()
    assert "→" in page.locator("details.more table").inner_text()


def test_only_the_capture_that_is_looked_at_is_loaded(browser: Any, out: Path) -> None:
    page, loaded = browser.new_page(), []
    page.on("request", lambda r: loaded.append(r.url.rsplit("/", 1)[1]))
    page.goto((out / "index.html").as_uri() + "#capture=0000SET%2F000%2FIMG_0001")
    page.wait_for_timeout(300)
    assert loaded == ["index.html", "IMG_0001.preview.jpg"]


def test_the_slider_moves_between_any_three_bands_before_and_after(viewer: Any) -> None:
    choose(viewer, "Composite", "true colour")
    middle, after, before = drawn(viewer), press_on_slider(viewer, "Home"), press_on_slider(viewer, "End")
    width = middle.shape[1]
    assert np.abs(before - after).mean() > 8
    # Left of the line is before, right of it after.
    left, right = slice(20, width // 2 - 20), slice(width // 2 + 20, width - 20)
    tags = slice(60, None)
    assert np.abs(middle[tags, left] - before[tags, left]).mean() < 1
    assert np.abs(middle[tags, right] - after[tags, right]).mean() < 1

    def colour(image: np.ndarray) -> float:
        """How much of the change from pixel to pixel the channels do not share: where bands are not aligned, a
        composite is coloured at every edge.
        """
        steps = np.diff(image[tags].astype(float), axis=1)
        return float(np.abs(steps - steps.mean(axis=2, keepdims=True)).mean() / np.abs(steps).mean())

    assert colour(after) < 0.8 * colour(before)
    box = viewer.locator("canvas").bounding_box()
    viewer.mouse.move(box["x"] + box["width"] - 2, box["y"] + 200)
    viewer.mouse.down()
    viewer.mouse.move(box["x"] + 5, box["y"] + 200, steps=4)
    viewer.mouse.up()
    assert int(viewer.locator("#swipe").input_value()) < 30
    grey = show_one_band(viewer)[tags]
    assert np.abs(after[tags] - grey).mean() > 5
    # One band in all three channels has no colour.
    assert np.abs(grey - grey.mean(axis=2, keepdims=True))[:, :200].mean() < 2


def test_both_sides_zoom_in_step(viewer: Any) -> None:
    viewer.get_by_role("button", name="Side by side").click()
    viewer.get_by_role("button", name="Detail").click()
    zoomed = drawn(viewer)
    half = zoomed.shape[1] // 2
    left, right = zoomed[60:, 10 : half - 10].mean(axis=2), zoomed[60:, half + 10 : 2 * half - 10].mean(axis=2)
    viewer.get_by_role("button", name="All").click()
    whole = drawn(viewer)
    assert np.abs(whole - zoomed).mean() > 5
    # The reference has the same place in both.
    assert np.corrcoef(left[:, : right.shape[1]].ravel(), right[:, : left.shape[1]].ravel())[0, 1] > 0.2


def test_blinking_and_the_keys_of_the_picture(viewer: Any) -> None:
    viewer.locator("canvas").focus()
    viewer.keyboard.press(" ")
    first = drawn(viewer)
    viewer.keyboard.press(" ")
    second = drawn(viewer)
    assert np.abs(first - second).mean() > 8
    viewer.keyboard.press("+")
    viewer.keyboard.press("+")
    near = drawn(viewer)
    viewer.keyboard.press("ArrowRight")
    assert np.abs(drawn(viewer) - near).mean() > 3
    viewer.keyboard.press("0")
    assert np.abs(drawn(viewer) - second).mean() < 1
    assert viewer.locator("#swipe").is_hidden()
    viewer.get_by_role("button", name="Swipe").click()
    assert viewer.locator("#swipe").is_visible()
    viewer.get_by_role("button", name="Blink").click()
    assert viewer.locator("#swipe").is_hidden()
    seen = {viewer.locator("canvas").get_attribute("data-blinking")}
    viewer.wait_for_timeout(900)
    seen.add(viewer.locator("canvas").get_attribute("data-blinking"))
    assert seen == {"before", "after"}


@pytest.mark.parametrize("overlay", ["vectors", "heat", "error"])
def test_overlays_of_the_picture(viewer: Any, overlay: str) -> None:
    show_one_band(viewer)
    bare = press_on_slider(viewer, "Home")
    choose(viewer, "Overlay", overlay)
    shown = drawn(viewer)
    # The errors of this flight are small: their overlay is faint.
    assert (np.abs(shown - bare).max(axis=2) > (5 if overlay == "error" else 40)).sum() > 400
    if overlay == "heat":
        # The picture has a weight of a quarter; the grid of the overlay must not show as dark or bare lines.
        saturation = np.ptp((shown - 0.25 * bare)[80:-20, 20:-60], axis=2)
        lines = np.concatenate([np.median(saturation, axis=0), np.median(saturation, axis=1)])
        assert lines.min() > 0.5 * np.median(lines)
        assert lines.max() < 1.1 * np.median(lines)
    before = press_on_slider(viewer, "End")
    choose(viewer, "Overlay", "none")
    assert np.abs(drawn(viewer) - before).mean() < 0.3, "residuals are those of after"


def test_errors_have_colours_that_no_vegetation_has_up_to_2_px(browser: Any, out: Path, tmp_path: Path) -> None:
    sidecar = json.loads((out / "0000SET" / "000" / "IMG_0001.json").read_text())
    black, bands = np.zeros((360, 480), np.uint8), [b["band"] for b in sidecar["bands"]]
    views = ReducedBands(dict.fromkeys(bands, black), dict.fromkeys(bands, black), (480, 360))
    errors_px = {"NIR": np.array([[0.0, 0.0, 1.0, 1.0, 2.0, 2.0]] * 2, np.float32)}
    part = write_preview(views, bands, errors_px, tmp_path / "a.preview.jpg", preview_bytes(1))
    sidecar |= {"capture": "a", "preview": part.model_dump(mode="json")}
    (tmp_path / "a.json").write_text(json.dumps(sidecar))
    write_pages(tmp_path, pytest.fail)
    page = opened(browser, tmp_path)
    look_at(page, "a")
    assert page.get_by_label("Band of the overlay").is_hidden(), "without an overlay it would mean nothing"
    choose(page, "Overlay", "error")
    assert page.get_by_label("Band of the overlay").is_visible()
    choose(page, "Band of the overlay", "NIR")
    image = press_on_slider(page, "Home")[100:-20]  # blue, green, red
    width = image.shape[1]
    small, middle, large = (
        np.median(image[:, round(x * width) - 20 : round(x * width) + 20], axis=(0, 1)) for x in (0.08, 0.5, 0.92)
    )
    assert small == pytest.approx((0.75 * 77, 0.75 * 32, 0), abs=8)
    assert middle == pytest.approx(0.75 * np.array([73.5, 133, 127.5]), abs=10)
    assert large == pytest.approx((0.75 * 70, 0.75 * 234, 0.75 * 255), abs=8)
    note = page.locator("#over-note").inner_text()
    assert all(text in note for text in ("0 px", "0.5 px", "1 px", "2 px and more"))
    choose(page, "Overlay", "heat")
    assert "2 px and more" in page.locator("#over-note").inner_text()
    page.close()


def test_an_index_has_a_picture_before_alignment(viewer: Any) -> None:
    """Its scene is that of the picture after alignment, in the same colours, and it is wrong at edges."""
    choose(viewer, "Overlay", "index:ndvi")
    viewer.wait_for_timeout(300)
    before, after = (press_on_slider(viewer, key)[60:-10, 10:-10] for key in ("End", "Home"))
    assert np.ptp(before, axis=2).mean() < 12, "raw numbers are neutral greys"
    assert 15 < np.abs(before - after).mean() < 80
    lightness = [cv2.GaussianBlur(image.mean(axis=2), (0, 0), 12).ravel() for image in (before, after)]
    assert np.corrcoef(*lightness)[0, 1] > 0.6


def test_pictures_in_stops_are_exact(viewer: Any) -> None:
    """Blend modes make the colours between the stops, of grey values from 0 to 255."""
    viewer.evaluate(
        """() => {
          const grey = document.createElement("canvas");
          [grey.width, grey.height] = [256, 8];
          const pen = grey.getContext("2d");
          for (let v = 0; v < 256; v += 1) { pen.fillStyle = `rgb(${v} ${v} ${v})`; pen.fillRect(v, 0, 1, 8); }
          window.made = [facts.index_colours, facts.index_greys, PARALLAX_STOPS].map((stops) => {
            const made = colourGrey(grey, [0, 0, 256, 8], stops).getContext("2d").getImageData(0, 4, 256, 1).data;
            const wanted = [...Array(256).keys()].map((v) => {
              const at = v / 255 * (stops.length - 1);
              const k = Math.min(stops.length - 2, Math.floor(at));
              return stops[k].map((c, i) => c + (at - k) * (stops[k + 1][i] - c));
            });
            return Math.max(...wanted.flatMap((c, v) => c.map((one, i) => Math.abs(one - made[4 * v + i]))));
          });
        }"""
    )
    assert max(viewer.evaluate("window.made")) < 8


def test_captures_that_are_ok_by_prediction_have_their_own_colour(browser: Any, out: Path, tmp_path: Path) -> None:
    sidecar = json.loads((out / "0000SET" / "000" / "IMG_0001.json").read_text())
    prediction = {"fixed_to_moving": np.eye(3).tolist(), "from": "bands", "std_px": 0.93}
    for number, name in enumerate(("a", "b")):
        position = sidecar["position"] | {"latitude": 52 + 1e-4 * number}
        changed = sidecar | {"capture": name, "position": position}
        (tmp_path / f"{name}.json").write_text(json.dumps(changed))
        error = {"std_px": 13.29, "std_band_px": 0.93}
        sidecar["bands"][-1] |= {"status": "predicted", "reason": "blur", "prediction": prediction, "error": error}
    write_pages(tmp_path, pytest.fail)
    page = opened(browser, tmp_path)
    fills = [page.locator("#map circle", has_text=name).get_attribute("fill") for name in ("a", "b")]
    assert fills[0] != fills[1]
    assert page.locator("#map-legend .key").all_inner_texts() == ["ok", "ok by prediction"]
    badges = page.locator("#table .badge")
    assert badges.all_inner_texts() == ["ok", "ok by prediction"]
    assert page.locator("#table tbody tr").last.locator("td").nth(2).inner_text() == "13.290 (0.93 px of the band)"
    look_at(page, "b")
    text = page.locator("#capture").inner_text()
    assert "expected error 13.29 px of the reference (0.93 px of the band); indices can use it" in text
    for width in (375, 1000):
        page.set_viewport_size({"width": width, "height": 800})
        assert page.locator(".scroll:has(#table)").evaluate("e => e.scrollWidth <= e.clientWidth"), "it is not cut off"
    back = [badges.nth(i).evaluate("e => getComputedStyle(e).backgroundColor") for i in (0, 1)]
    assert back[0] != back[1]
    page.locator("#only").select_option("ok")
    assert page.locator("#table tbody th").all_inner_texts() == ["a"]
    page.locator("#only").select_option("ok_by_prediction")
    assert page.locator("#table tbody th").all_inner_texts() == ["b"]
    look_at(page, "b")
    assert "indices can use it, but its own image does not confirm it" in page.locator(".words").inner_text()
    page.close()


def test_heads_of_columns_explain_themselves(viewer: Any) -> None:
    viewer.locator("details.more summary").click()
    heads = viewer.locator("thead th[title]")
    assert heads.count() >= 20
    help_texts = viewer.locator("#help dd").all_inner_texts()
    assert {heads.nth(i).get_attribute("title") for i in range(heads.count())} <= set(help_texts)
    viewer.locator("header a", has_text="help").click()
    viewer.wait_for_timeout(200)
    assert viewer.locator("#help").bounding_box()["y"] < 900
    assert "IMG_0001" in viewer.locator("#capture-title").inner_text(), "the capture stays"


def test_an_index_over_the_picture_and_on_the_map(viewer: Any) -> None:
    bare = press_on_slider(viewer, "Home")
    choose(viewer, "Overlay", "index:ndvi")
    viewer.wait_for_timeout(300)
    shown = drawn(viewer)
    assert (np.abs(shown - bare).max(axis=2) > 40).mean() > 0.3
    note = viewer.locator("#over-note").inner_text()
    assert "raw numbers, not reflectance" in note
    assert "-0." in note
    assert np.ptp(shown[60:], axis=2).mean() < 0.5 * np.ptp(bare[60:], axis=2).mean(), "neutral greys"
    row = viewer.locator("#indices tbody tr").inner_text().split("\t")
    assert row[0] == "NDVI"
    assert float(row[2]) < float(row[1]) < float(row[3])
    dots = viewer.locator("#map circle")
    before = dots.nth(0).get_attribute("fill")
    viewer.locator("#map-colour").select_option("index:ndvi")
    assert dots.nth(0).get_attribute("fill") != before
    assert row[1] in viewer.locator("#map-legend").inner_text()
    look_at(viewer, "IMG_0002")  # without NIR an index is missing
    assert viewer.get_by_label("Overlay", exact=True).input_value() == "none"


def test_the_wheel_zooms_and_lets_the_page_scroll_when_all_is_seen(viewer: Any) -> None:
    viewer.locator("canvas").scroll_into_view_if_needed()
    whole = drawn(viewer)
    box = viewer.locator("canvas").bounding_box()
    viewer.mouse.move(box["x"] + 300, box["y"] + 200)
    for _ in range(4):
        viewer.mouse.wheel(0, -100)
    assert np.abs(drawn(viewer) - whole).mean() > 3
    for _ in range(6):
        viewer.mouse.wheel(0, 100)
        viewer.wait_for_timeout(30)
    viewer.wait_for_timeout(300)
    assert viewer.locator("canvas").bounding_box()["y"] < box["y"], "the rest of the wheel scrolls"


def test_the_relief_over_the_picture(browser: Any, out: Path, tmp_path: Path) -> None:
    """In its two colours, whether or not the sheet has a row of errors, with a legend."""
    sidecar = json.loads((out / "0000SET" / "000" / "IMG_0001.json").read_text())
    black, bands = np.zeros((360, 480), np.uint8), [b["band"] for b in sidecar["bands"]]
    views = ReducedBands(dict.fromkeys(bands, black), dict.fromkeys(bands, black), (480, 360))
    relief = relief_tile(np.where(np.arange(480) < 240, -2.0, 6.0)[None].repeat(360, axis=0).astype(np.float32), (1, 2))
    for name, errors in (("a", {}), ("b", {"NIR": np.ones((4, 5), np.float32)})):
        part = write_preview(views, bands, errors, tmp_path / f"{name}.preview.jpg", preview_bytes(1), relief)
        sidecar |= {"capture": name, "preview": part.model_dump(mode="json")}
        (tmp_path / f"{name}.json").write_text(json.dumps(sidecar))
    write_pages(tmp_path, pytest.fail)
    page = opened(browser, tmp_path)
    for name in "ab":
        look_at(page, name)
        choose(page, "Overlay", "relief")
        image = press_on_slider(page, "Home")  # blue, green, red
        far, near = (np.median(image[100:, half], axis=(0, 1)) for half in (slice(50, 300), slice(-300, -50)))
        assert far == pytest.approx((0.75 * 150, 0.75 * 35, 0.75 * 25), abs=8)
        assert near == pytest.approx((0.75 * 45, 0.75 * 250, 0.75 * 205), abs=8)
        note = page.locator("#over-note").inner_text()
        assert all(text in note for text in ("-2.0 px", "2.0 px", "6.0 px", "1.00 to 2.00 m"))


def test_the_table_sorts_and_filters(page: Any) -> None:
    def labels() -> list[str]:
        return page.locator("#table tbody th").all_inner_texts()

    def residuals() -> list[float]:
        cells = page.locator("#table tbody tr td:nth-child(5)").all_inner_texts()
        return [float(text) for text in cells if text[0].isdigit()]

    assert len(labels()) == 3
    page.locator("#table thead button", has_text="Largest residual").click()
    head = page.locator("#table thead th", has_text="Largest residual")
    assert head.get_attribute("aria-sort") == "ascending"
    known = residuals()
    assert known == sorted(known)
    page.locator("#table thead button", has_text="Largest residual").press("Enter")
    assert head.get_attribute("aria-sort") == "descending"
    assert residuals() == known[::-1]
    page.locator("#find").fill("img_0002")
    assert labels() == ["0000SET/000/IMG_0002"]
    assert page.locator("#count").inner_text() == "1 of 3 shown"
    page.locator("#find").fill("")
    page.locator("#only").select_option("ok")
    assert labels() == ["0000SET/000/IMG_0001"]
    page.locator("#only").select_option("short")
    assert "0000SET/000/IMG_0001" not in labels()


def test_the_address_of_an_unknown_capture_shows_what_failed(browser: Any, out: Path) -> None:
    """It may be that of another report, or of a capture that was renamed."""
    page = opened(browser, out, "gone")
    page.wait_for_function(
        "() => document.querySelector('#capture-title')?.textContent.includes('IMG_0002')", timeout=5000
    )
    page.close()


def test_a_season_is_loaded_in_parts(browser: Any, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(facts, "_DETAILS_PER_PART", 2)
    monkeypatch.setattr(facts, "_ROWS_PER_PART", 5)
    sidecar = json.loads((out / "0000SET" / "000" / "IMG_0001.json").read_text())
    for number in range(12):
        position = sidecar["position"] | {"latitude": 52 + 1e-4 * number}
        changed = sidecar | {"capture": f"IMG_{number:04}", "position": position}
        (tmp_path / f"IMG_{number:04}.json").write_text(json.dumps(changed))
    shutil.copy(out / "0000SET" / "000" / "IMG_0001.preview.jpg", tmp_path)
    write_pages(tmp_path, pytest.fail)
    page, loaded = browser.new_page(), []
    page.on("request", lambda r: loaded.append(r.url.rsplit("/", 1)[1]))
    page.goto((tmp_path / "index.html").as_uri() + "#capture=IMG_0011")
    page.wait_for_function("() => document.querySelector('#capture-title').textContent.includes('IMG_0011')")
    assert page.locator("#count").inner_text() == "12 of 12 shown"
    assert page.locator("#map circle").count() == 12
    assert [name.rpartition("-")[0] for name in loaded if name.endswith(".js")] == ["rows-2", "rows-3", "details-6"]
    choose(page, "Overlay", "vectors")
    look_at(page, "IMG_0003")
    cut = browser.new_page()
    cut.goto((tmp_path / "index.html").as_uri() + "#capture=IMG%2")
    cut.wait_for_function("() => document.querySelector('#count').textContent === '12 of 12 shown'", timeout=5000)
    cut.wait_for_function(
        "() => document.querySelector('#capture-title')?.textContent.includes('IMG_0000')", timeout=5000
    )
    cut.close()
    shutil.rmtree(tmp_path / "report-data")
    page.reload()
    page.wait_for_function("() => document.querySelector('#count').textContent.includes('copy the folder report-data')")
    page.close()


def test_the_table_has_pages(page: Any) -> None:
    page.evaluate(
        "() => { for (let i = 0; i < 450; i += 1) captures.push({ ...captures[0], label: `z${i}` }); showRows(); }"
    )
    rows = page.locator("#table tbody tr")
    assert (rows.count(), page.locator("#table-pages").inner_text()) == (200, "Earlier rows\nLater rows\n1 to 200")
    page.get_by_role("button", name="Later rows").click()
    page.get_by_role("button", name="Later rows").click()
    assert (rows.count(), rows.last.locator("th").inner_text()) == (53, "z449")
    assert page.get_by_role("button", name="Later rows").is_disabled()
    page.locator("#find").fill("z44")
    assert rows.count() == 11
    assert page.locator("#table-pages").is_hidden()


@pytest.mark.parametrize("width", [375, 1100])
def test_no_table_is_cut_off(browser: Any, out: Path, tmp_path: Path, width: int) -> None:
    sidecar = json.loads((out / "0000SET" / "000" / "IMG_0001.json").read_text())
    relief = {"file": "a.relief.tif", "baseline": [0.5, 0.5], "occluded": 0.0125}
    relief |= {name: [[0.0, 0.0]] for name in ("reference_px", "plane_px", "slope")}
    kinds = "homography", "field", "relief", "relief and field"
    geometry = {"kind": kinds[-1], "held_out_p95_px": dict.fromkeys(kinds, 1.2345)}
    for band in sidecar["bands"]:
        if band["status"] != "reference":
            band |= {"relief": relief, "geometry": geometry}
    failed = sidecar["bands"][-1]
    failed |= {"status": "failed", "reason": "the bands do not show the same scene", "issues": []}
    (tmp_path / "IMG_0001.json").write_text(json.dumps(sidecar | {"status": "degraded"}))
    shutil.copytree(out / "models", tmp_path / "models")
    write_pages(tmp_path, pytest.fail)
    page = opened(browser, tmp_path, width=width)
    page.locator("details.more summary").click()
    cut = "[...document.querySelectorAll('.scroll')].filter((e) => e.scrollWidth > e.clientWidth).length"
    assert page.evaluate(cut) == 0
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.locator("#capture table").first.is_visible()
    page.close()


def test_the_map_continues_across_the_180th_meridian(page: Any) -> None:
    call = "inMetres([179.9999, -179.9999, -179.9998].map((longitude) => ({ position: [0, longitude] })))"
    result = page.evaluate(call)
    assert [round(x) for x, _ in result["metres"]] == [-19, 4, 15]
    assert result["reach"][0] == pytest.approx(18.6, abs=0.1)


def test_the_map_leads_to_the_captures(page: Any) -> None:
    dots = page.locator("#map circle")
    assert dots.count() == 2, "one has no position"
    dots.nth(0).click()
    assert "IMG_000" in page.locator("#capture-title").inner_text()
    before = dots.nth(0).get_attribute("fill")
    page.locator("#map-colour").select_option("residual_px")
    assert dots.nth(0).get_attribute("fill") != before
    assert page.locator("#map-legend").inner_text().split("\n")[0].startswith("0.00 px0.50 px1.00 px and more")
    residual_px = page.evaluate("captures.find((c) => c.label.endsWith('IMG_0001')).residual_px")
    assert 0 < residual_px < 0.3
    colour = page.locator("#map circle", has_text="IMG_0001").get_attribute("fill")
    assert colour == f"hsl({round(200 - 200 * residual_px)} 70% 45%)", "the scale is the same in all reports"
    assert page.get_by_role("link", name="flight.geojson").get_attribute("href") == "flight.geojson"


def test_a_missing_preview_stays_announced(browser: Any, out: Path, tmp_path: Path) -> None:
    shutil.copy(out / "0000SET" / "000" / "IMG_0001.json", tmp_path)
    write_pages(tmp_path, lambda _: None)
    page = opened(browser, tmp_path)
    page.wait_for_function("() => document.querySelector('#tag-right').textContent === 'the preview is not there'")
    page.get_by_role("button", name="Side by side").click()
    assert page.locator("#tag-right").inner_text() == "the preview is not there"
    page.close()


def test_the_open_capture_stays_marked_when_the_map_is_drawn_again(viewer: Any) -> None:
    viewer.evaluate("drawMap()")
    assert viewer.locator("#map circle.open title").all_text_contents() == ["0000SET/000/IMG_0001"]


def test_a_map_begins_at_one_place(browser: Any, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The captures in the page are at one place, those that are loaded later are not."""
    monkeypatch.setattr(facts, "_ROWS_PER_PART", 2)
    sidecar = json.loads((out / "0000SET" / "000" / "IMG_0001.json").read_text())
    for number in range(4):
        position = sidecar["position"] | {"latitude": 52 + 1e-4 * max(0, number - 1)}
        (tmp_path / f"{number}.json").write_text(json.dumps(sidecar | {"capture": str(number), "position": position}))
    write_pages(tmp_path, lambda _: None)
    page = opened(browser, tmp_path)
    page.wait_for_function("() => document.querySelector('#count').textContent === '4 of 4 shown'")
    assert page.locator("#map circle").count() == 4
    assert page.locator("#map-legend").is_visible()
    assert page.locator("#map-colour").is_visible()
    page.close()


def test_a_capture_of_its_reference_alone_is_shown(browser: Any, out: Path, tmp_path: Path) -> None:
    sidecar = json.loads((out / "0000SET" / "000" / "IMG_0001.json").read_text())
    bands = [band for band in sidecar["bands"] if band["status"] == "reference"]
    sidecar |= {"bands": bands, "missing_bands": ["NIR"], "status": "degraded"}
    (tmp_path / "IMG_0001.json").write_text(json.dumps(sidecar))
    write_pages(tmp_path, lambda _: None)
    page = opened(browser, tmp_path)
    assert "Green as red, green, blue" in page.locator("#over-note").inner_text(timeout=3000)
    page.close()


def test_next_and_previous_follow_the_table(viewer: Any) -> None:
    viewer.get_by_role("button", name="Next").click()
    viewer.wait_for_function("() => document.querySelector('#capture-title').textContent.includes('IMG_0002')")
    assert viewer.evaluate("document.activeElement.id") == "capture"
    viewer.get_by_role("button", name="Previous").click()
    viewer.wait_for_function("() => document.querySelector('#capture-title').textContent.includes('IMG_0001')")


def test_names_are_never_more_than_names(page: Any) -> None:
    look_at(page, "a'b&c")
    for overlay in ("vectors", "error"):
        choose(page, "Overlay", overlay)
    choose(page, "Band of the overlay", HOSTILE)
    assert HOSTILE in page.locator("#capture").inner_text()
    page.locator("details").evaluate_all("all => all.forEach((d) => { d.open = true; })")
    assert any(HOSTILE in text for text in page.locator(".short").all_inner_texts())
    assert page.evaluate("window.broken") is None
    assert page.locator("main img[src=x]").count() == 0


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_words_can_be_read_in_light_and_in_dark(browser: Any, out: Path, scheme: str) -> None:
    """Contrast of at least 4.5 (WCAG AA) of all kinds of text."""
    page = opened(browser, out, color_scheme=scheme)
    ratios = page.evaluate(
        """() => {
          const light = (colour) => {
            const [r, g, b] = colour.match(/[\\d.]+/g).slice(0, 3).map((v) => {
              const s = v / 255;
              return s <= 0.03928 ? s / 12.92 : ((s + 0.055) / 1.055) ** 2.4;
            });
            return 0.2126 * r + 0.7152 * g + 0.0722 * b;
          };
          const behind = (e) => {
            for (; e; e = e.parentElement) {
              const found = getComputedStyle(e).backgroundColor;
              if (!found.endsWith(", 0)")) return found;
            }
            return "rgb(255,255,255)";
          };
          return [...document.querySelectorAll("p, a, td, th, dt, dd, h1, h2, .badge, .chip, summary, button")]
            .filter((e) => e.offsetParent && e.textContent.trim())
            .map((e) => {
              const [x, y] = [light(getComputedStyle(e).color), light(behind(e))].sort((a, b) => b - a);
              return [(x + 0.05) / (y + 0.05), e.className + " " + e.textContent.slice(0, 40)];
            });
        }"""
    )
    assert len(ratios) > 40
    assert [r for r in ratios if r[0] < 4.5] == []


def test_it_prints_and_fits_a_telephone(browser: Any, out: Path) -> None:
    page = opened(browser, out, width=390)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    heads = page.locator("#table thead th").all_inner_texts()
    assert [head.split(" ")[0] for head in heads[:3]] == ["Capture", "Status", "Bands"]
    chip = page.locator("#table .chip", has_text="NIR").first.bounding_box()
    assert chip["x"] + chip["width"] <= 390, "the bands are seen without scrolling"
    assert not page.get_by_label("Composite", exact=True).is_visible(), "folded"
    assert page.locator("#view-tools").bounding_box()["height"] < 40, "one row"
    assert page.locator(".hint.touch").is_visible()
    texts = page.locator("#map text")
    heights_px = [texts.nth(i).bounding_box()["height"] for i in range(texts.count())]
    assert min(heights_px) >= 12
    page.emulate_media(media="print")
    page.wait_for_timeout(200)
    assert not page.locator("#find").is_visible()
    assert page.locator("canvas").is_visible()
    assert page.locator("details.short:not([open])").count() == 0
    assert not any("IMG_0001" in label for label in page.locator("#table tbody th").all_inner_texts())
    page.emulate_media(media="screen")
    page.wait_for_function("() => document.querySelectorAll('#table tbody th').length === 3")


def test_no_table_is_cut_on_a_screen(browser: Any, out: Path) -> None:
    page = opened(browser, out, "IMG_0001")
    page.locator("details").evaluate_all("all => all.forEach((d) => { d.open = true; })")
    cut = "[...document.querySelectorAll('#capture .scroll')].filter((s) => s.scrollWidth > s.clientWidth).length"
    assert page.evaluate(cut) == 0
    before, after = page.locator("details.more tbody tr").first.locator("td").first.inner_text().split(" → ")
    assert float(after) < float(before) <= 0, "Mattes MI has the sign of the sidecar: lower is better"
