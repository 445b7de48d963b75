"""The map of a flight: footprints against geometry that is known by other means."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from synthetic_flights.aligned import make_aligned

import agalign
from agalign.batch.render import rendered_sidecar
from agalign.errors import ConfigurationError
from agalign.flight.footprint import (
    above_elevation,
    accuracy_of_footprint_m,
    footprint,
    ground_m,
    missing_for_footprint,
    utm_of_flights,
    utm_wkt,
    with_approximate_georeference,
    with_assumed_height,
)
from agalign.records.panels_and_sky import SkyPart
from agalign.records.sidecar import Sidecar
from agalign.report.flight_map import FlightMap, geojson_geometry
from agalign.report.pages import write_pages
from agalign.values import geometry
from agalign.values.capture import Band, Capture, Pose, Position
from agalign.values.image import OutputGrid

from ..conftest import read_json, seeded
from ..run_outputs import context_of, indices_of

M_PER_DEGREE = 111_250.0  # of latitude, at 52 degrees


def capture(pose: Pose | None, altitude_m: float | None = 130.0) -> Capture:
    band = Band("Green", Path("a_1.tif"), 1, 1200, 800, "uint16")
    position = Position(52.0, 5.0, altitude_m)
    return Capture("a", Path("one"), (band,), 0, position=position, pose=pose)


def features_of(out: Path) -> list[dict[str, Any]]:
    return read_json(out / "flight.geojson")["features"]


def sidecar_of(known: Capture, status: str = "ok") -> Sidecar:
    """The sidecar of a capture without rasters."""
    return rendered_sidecar(context_of(known, {})).model_copy(update={"status": status})


def mapped(out: Path, known: Capture, status: str = "ok") -> list[dict[str, Any]]:
    """The features of one capture."""
    on_map = FlightMap()
    on_map.add(known.label, sidecar_of(known, status))
    on_map.write(out)
    return features_of(out)


@pytest.mark.parametrize(
    ("pose", "point_px", "expected_m"),
    [
        (Pose(0.0, height_m=100.0, focal_length_px=1000.0), (599.5, 239.5), (28.0, 0.0)),
        (Pose(0.0, height_m=100.0, focal_length_px=1000.0), (319.5, 0.0), (0.0, 23.95)),
        (Pose(90.0, height_m=100.0, focal_length_px=1000.0), (319.5, 0.0), (23.95, 0.0)),
        (Pose(0.0, 10.0, 0.0, 100.0, 1000.0), (319.5, 239.5), (0.0, 17.633)),
        (Pose(0.0, 10.0, 0.0, 100.0, 1000.0), (319.5, 0.0), (0.0, 43.414)),
        (Pose(0.0, 0.0, 10.0, 100.0, 1000.0), (319.5, 239.5), (-17.633, 0.0)),
        # Yaw, pitch, roll of aircraft: h tan(pitch) forward, h tan(roll) / cos(pitch) to the left.
        (Pose(0.0, 30.0, 20.0, 100.0, 1000.0), (319.5, 239.5), (-42.028, 57.735)),
        (None, (0.0, 0.0), None),
        (Pose(0.0), (0.0, 0.0), None),
        (Pose(0.0, 60.0, 0.0, 100.0, 1000.0), (0.0, 0.0), None),
        (Pose(0.0, height_m=10.0), (0.0, 0.0), None),
    ],
)
def test_position_of_a_pixel_on_the_ground(
    pose: Pose | None, point_px: tuple[float, float], expected_m: tuple[float, float] | None
) -> None:
    green = Band("Green", Path("x.tif"), 1, 640, 480, "uint16")
    result = ground_m(Capture("a", Path(), (green,), 0, pose=pose), np.array([point_px]))
    if expected_m is None:
        assert result is None
    else:
        np.testing.assert_allclose(result[0], expected_m, atol=0.01)


def test_the_footprint_of_a_camera_that_looks_down_has_the_size_of_its_field_of_view(tmp_path: Path) -> None:
    (feature,) = mapped(tmp_path, capture(Pose(-360.0, height_m=50.0, focal_length_px=1000.0)), "failed")
    ring = np.array(feature["geometry"]["coordinates"][0])
    north_m, east_m = np.ptp(ring[:, 1]) * M_PER_DEGREE, np.ptp(ring[:, 0]) * M_PER_DEGREE * math.cos(math.radians(52))
    assert (east_m, north_m) == pytest.approx((60.0, 40.0), rel=0.01)
    area = np.sum(ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1])
    assert area > 0  # counter-clockwise, as RFC 7946 has outer rings
    facts = {"status": "failed", "height_m": 50.0, "height_from": "tags", "stack": None, "heading_deg": 0.0}
    assert facts.items() <= feature["properties"].items()


def test_the_accuracy_is_that_of_the_farthest_corner() -> None:
    """Two pixels that cover 40 m each: the corner is 40 m east and 20 m north, not half a pixel farther."""
    tiny = replace(capture(Pose(0.0, height_m=40.0, focal_length_px=1.0)), bands=(Band("G", Path(), 1, 2, 1, "uint8"),))
    distance_m = math.hypot(40, 20)
    tilted_m = math.radians(7.0) * 40 * (1 + (distance_m / 40) ** 2)
    terms_m = 3.0, math.radians(5.0) * distance_m, tilted_m, 5.0 / 40 * distance_m
    assert accuracy_of_footprint_m(tiny) == pytest.approx(math.hypot(*terms_m), abs=0.06)


def test_an_unknown_height_is_assumed_and_marked(tmp_path: Path) -> None:
    unknown = capture(Pose(0.0, focal_length_px=1000.0))
    (feature,) = mapped(tmp_path, unknown)
    assert feature["geometry"]["type"] == "Polygon"
    assert (feature["properties"]["height_m"], feature["properties"]["height_from"]) == (120.0, "assumed")
    by_tags = replace(unknown, pose=Pose(0.0, focal_length_px=1000.0, height_m=120.0))
    assert feature["properties"]["accuracy_m"] > 2 * accuracy_of_footprint_m(by_tags)
    assert with_assumed_height(capture(Pose(0.0, focal_length_px=1000.0), 40.0)).pose.height_m == 40.0


def features_of_pages(out: Path) -> list[dict[str, Any]]:
    write_pages(out, pytest.fail)
    return features_of(out)


def test_index_rasters_of_a_later_command_are_linked_and_stay_linked(tmp_path: Path) -> None:
    make_aligned(tmp_path, 1)

    def links() -> list[str]:
        return sorted(features_of_pages(tmp_path)[0]["properties"]["indices"])

    assert links() == []
    indices_of(tmp_path, "ndvi", "ndre")
    linked = ["0000SET/IMG_0001_ndre.tif", "0000SET/IMG_0001_ndvi.tif"]
    assert links() == links() == linked
    (tmp_path / linked[0]).unlink()
    assert links() == linked[1:]


def test_a_map_of_the_user_is_neither_replaced_nor_removed(tmp_path: Path) -> None:
    """By the pages of captures without a position."""
    mine = tmp_path / "flight.geojson"
    mine.write_text('{"type": "FeatureCollection", "features": []}')
    before = mine.read_bytes()
    with pytest.raises(ConfigurationError, match=r"flight\.geojson: was not written by agalign; rename it$"):
        write_pages(tmp_path, lambda _: None)
    assert mine.read_bytes() == before
    assert not (tmp_path / "index.html").exists()
    mine.unlink()
    make_aligned(tmp_path, 1)
    for _ in range(2):  # the second time over its own
        assert [f["id"] for f in features_of_pages(tmp_path)] == ["0000SET/IMG_0001"]


def test_captures_of_an_earlier_run_stay_as_long_as_their_sidecars(tmp_path: Path) -> None:
    """As in the report and summary.csv, which list every sidecar of the folder."""
    make_aligned(tmp_path, 2)
    assert [f["id"] for f in features_of_pages(tmp_path)] == ["0000SET/IMG_0001", "0000SET/IMG_0002"]
    (tmp_path / "0000SET" / "IMG_0001.json").unlink()
    assert [f["id"] for f in features_of_pages(tmp_path)] == ["0000SET/IMG_0002"]


def test_captures_without_a_footprint_are_points_or_left_without_a_place(tmp_path: Path) -> None:
    on_map = FlightMap()
    on_map.add("one/a", sidecar_of(replace(capture(None), position=None)))
    assert mapped(tmp_path, capture(None)), "the map of an earlier run"
    on_map.write(tmp_path)
    assert not list(tmp_path.iterdir())
    on_map.add_excluded(SkyPart(folder="one", capture="b", captured_at="", position=capture(None).position, bands=[]))
    on_map.write(tmp_path)
    first, second = features_of(tmp_path)
    assert (first["id"], first["geometry"]) == ("one/a", None)
    assert (second["id"], second["properties"]["status"]) == ("one/b", "sky")
    assert second["geometry"] == {"type": "Point", "coordinates": [5.0, 52.0]}


def test_the_elevation_of_the_ground_gives_the_height_that_tags_lack() -> None:
    pose = Pose(10.0, focal_length_px=1000.0)
    result = above_elevation(capture(pose), 100.0).pose
    assert (result.height_m, result.height_from) == (30.0, "ground elevation")
    assert above_elevation(capture(replace(pose, height_m=7.0)), 100.0).pose == replace(pose, height_m=7.0)
    assert above_elevation(capture(pose), 131.0).pose == pose  # below the ground
    assert with_approximate_georeference(capture(pose), utm_wkt(5.0, 52.0)).reference.georeference is None


@pytest.mark.parametrize(
    ("pose", "missing"),
    [
        (None, "a heading in its tags; leave"),
        (Pose(5.0), "a focal length in its tags; leave"),
        (Pose(5.0, focal_length_px=1000.0), "a height above the ground; give --ground-elevation"),
        (Pose(5.0, 60.0, focal_length_px=1000.0, height_m=50.0), "a tilt below 45 degrees"),
    ],
)
def test_a_capture_without_footprint_names_what_it_lacks(pose: Pose | None, missing: str) -> None:
    assert missing_for_footprint(capture(pose)).startswith(missing)
    assert missing_for_footprint(replace(capture(pose), position=None)).startswith("a position")


def test_a_footprint_across_the_180th_meridian_is_cut_there() -> None:
    """RFC 7946, 3.1.9: two polygons, each on its side; together they have the area of the footprint."""
    ring = np.array([[179.999, 52.0], [-179.998, 52.001], [-179.999, 52.003], [179.998, 52.002], [179.999, 52.0]])
    shape = geojson_geometry(ring, None)
    assert shape["type"] == "MultiPolygon"
    west, east = (np.array(part[0]) for part in shape["coordinates"])
    assert (west[:, 0].max(), east[:, 0].min()) == (180.0, -180.0)
    assert west[:, 0].min() == 179.998
    assert east[:, 0].max() == -179.998
    whole = np.column_stack([ring[:, 0] % 360, ring[:, 1]])
    # Counter-clockwise rings have a positive area.
    areas = [cv2.contourArea(((one - one[0]) * 1e4).astype(np.float32), oriented=True) for one in (west, east, whole)]
    assert areas[0] + areas[1] == pytest.approx(areas[2], rel=1e-3)
    assert min(areas) > 0
    assert geojson_geometry(ring % 90, None)["type"] == "Polygon"


def test_a_flight_across_the_border_of_a_utm_zone_has_one_coordinate_system() -> None:
    pose = Pose(10.0, height_m=50.0, focal_length_px=1000.0)
    places = {name: Position(52.0, longitude, 80.0) for name, longitude in (("a", 5.9995), ("b", 6.0005))}
    flight = [replace(capture(pose), name=name, position=place) for name, place in places.items()]
    crs = utm_of_flights(flight)
    assert crs == dict.fromkeys(("one/a", "one/b"), utm_wkt(5.9, 52.0))
    east_m = [with_approximate_georeference(c, crs[c.label]).reference.georeference.transform[0, 2] for c in flight]
    assert east_m[1] - east_m[0] == pytest.approx(68.7, abs=0.5)


@pytest.mark.parametrize("heading_deg", [0.0, 37.0, 200.0])
def test_the_approximate_georeference_has_the_footprint_of_the_pose(heading_deg: float) -> None:
    known = capture(Pose(heading_deg, height_m=50.0, focal_length_px=1000.0))
    on_map, area = with_approximate_georeference(known, utm_wkt(5.0, 52.0)), OutputGrid(100, 50, 600, 700)
    assert "32631" in on_map.reference.georeference.crs_wkt
    np.testing.assert_allclose(footprint(on_map, area), footprint(known, area), rtol=0, atol=5e-7)


@pytest.mark.slow
def test_a_run_writes_the_map_and_georeferenced_rasters_that_agree(by_sun: Path) -> None:
    features = features_of(by_sun)
    assert {f["geometry"]["type"] for f in features if f["properties"]["status"] == "panel"} == {"Point"}
    (feature, *_) = [f for f in features if f["properties"].get("stack")]
    assert feature["properties"]["height_from"] == "panel"
    with rasterio.open(by_sun / feature["properties"]["stack"]) as stack:
        assert stack.crs.to_epsg() == 32631
        assert float(stack.tags()["GEOREFERENCE_ACCURACY_M"]) == feature["properties"]["accuracy_m"]
        lon, lat = np.array(feature["geometry"]["coordinates"][0]).T
        corners = rasterio.warp.transform("EPSG:4326", stack.crs, lon, lat)
        px = np.array([~stack.transform * (x, y) for x, y in zip(*corners, strict=True)])
        outline = geometry.corners(stack.width + 1, stack.height + 1)
    np.testing.assert_allclose(px, outline[[0, 3, 2, 1, 0]], atol=2)


@pytest.mark.slow
def test_an_impossible_georeference_is_refused_first(flight: Path, tmp_path: Path) -> None:
    with pytest.raises(agalign.ConfigurationError, match="--ground-elevation"):
        agalign.align_folder(flight, tmp_path, settings=seeded(georeference=True))
    agalign.align_folder(flight, tmp_path, settings=seeded(georeference=True, ground_elevation_m=0.0))
    features = features_of(tmp_path)
    assert {f["properties"]["height_from"] for f in features} == {"ground elevation"}


def test_a_single_capture_is_georeferenced_as_in_a_run(flight: Path, tmp_path: Path) -> None:
    capture = agalign.discover(flight).captures[0]
    with pytest.raises(agalign.ConfigurationError, match="--ground-elevation"):
        agalign.align_capture(capture, tmp_path, settings=seeded("rig", georeference=True))
    settings = seeded("rig", georeference=True, ground_elevation_m=0.0)
    path = agalign.align_capture(capture, tmp_path, settings=settings).path
    with rasterio.open(path.with_suffix(".tif")) as stack:
        assert stack.crs.is_projected
