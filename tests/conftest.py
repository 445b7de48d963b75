"""Scenes that tests generate, outputs that all tests of a run share, and the path of the real captures."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import hypothesis
import numpy as np
import pytest
import rasterio
from filelock import FileLock
from synthetic_flights.troubles import make_flight_between_panels
from threadpoolctl import threadpool_limits

from agalign import align_folder
from agalign.config import SeedSettings, Settings, WriteSettings
from agalign.host.processes import usable_cores
from agalign.synthetic import flight as synthetic
from agalign.values import geometry

from .program import agalign

# Each worker has a core of its own. Torch, which nothing above loads, and the programs that tests start read the
# variable; OpenCV and the libraries of numpy are loaded.
os.environ.setdefault("OMP_NUM_THREADS", "1")
threadpool_limits(1)
cv2.setNumThreads(1)

SUN = 1.0, 0.6
"""Irradiance at the panel before and after the captures, relative to noon."""
REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real captures; skips where it is absent."""
    if not REAL_DATA.is_dir():
        pytest.skip(f"the real captures are not at {REAL_DATA}")
    return REAL_DATA


hypothesis.settings.register_profile("short", max_examples=20, deadline=None)
hypothesis.settings.register_profile("full", max_examples=150, deadline=None)


def pytest_configure(config: pytest.Config) -> None:
    """More examples are tried in the run of all tests."""
    hypothesis.settings.load_profile("short" if config.option.markexpr else "full")


def pytest_xdist_auto_num_workers() -> int:
    """One worker more than there are cores: many tests wait for processes that they start."""
    return usable_cores() + 1


Shared = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Shared:
    """Call with a name and a function: the folder of this name, filled by the function once per run of pytest.

    All xdist workers read the same folder, so tests must not change it.
    """
    base = tmp_path_factory.getbasetemp()
    root = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"
    root.mkdir(exist_ok=True)

    def folder(name: str, fill: Callable[[Path], object]) -> Path:
        path, is_filled = root / name, root / f"{name}.filled"
        with FileLock(root / f"{name}.lock"):
            if not is_filled.exists():
                shutil.rmtree(path, ignore_errors=True)
                path.mkdir()
                fill(path)
                is_filled.touch()
        return path

    return folder


@pytest.fixture(scope="session")
def flight(shared: Shared) -> Path:
    """A synthetic flight of two small captures, with truth.json next to the images."""
    return shared("flight", lambda folder: synthetic.make_flight(folder, captures=2, size_px=(480, 360), rng_seed=3))


@pytest.fixture(scope="session")
def aligned_flight(shared: Shared, flight: Path) -> Path:
    """`flight` aligned with the default settings: its stacks, sidecars, report and model; the log is next to it."""

    def align(folder: Path) -> None:
        done = agalign(flight, "-o", folder / "out with spaces é", "--log-json")
        assert (done.returncode, done.stdout) == (0, "")
        (folder / "log.jsonl").write_text(done.stderr)

    return shared("aligned_flight", align) / "out with spaces é"


@pytest.fixture(scope="session")
def model_path(aligned_flight: Path) -> Path:
    """The model that is learned from `flight`."""
    (path,) = (aligned_flight / "models").iterdir()
    return path


def seeded(force: str | None = None, **write: Any) -> Settings:
    """Settings of a run that estimates nothing: bands are mapped by their initial alignment."""
    return Settings(seed=SeedSettings.model_validate({"only": True, "force": force}), write=WriteSettings(**write))


def raising(error: BaseException) -> Callable[..., Any]:
    """A function that raises this error, whatever its arguments."""

    def function(*_: object, **__: object) -> Any:
        raise error

    return function


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def write_signed(path: Path, text: str) -> None:
    """Write the JSON of a sidecar with the checksum of its content, as commands do."""
    from agalign.records.sidecar_file import content_checksum

    path.write_text(json.dumps(json.loads(text) | {"checksum": content_checksum(text)}), encoding="utf-8")


def save_known_model(path: Path, *, has_rig: bool = True, fingerprint: str = "") -> None:
    """Save a model with a rig that is learned from four captures at known heights."""
    from agalign.flight.groups import FlightCamera
    from agalign.flight.learn_rig import learn_rig
    from agalign.flight.model import FlightModel, save_model
    from agalign.flight.rig import Observation
    from agalign.method.descriptor import Descriptor

    captures = []
    for k, height in enumerate((-2.0, 0.5, 3.0, 6.0)):
        offsets = {"NIR": (8 + 0.8 * height, 6), "[Red]": (-3, 4 + 0.6 * height)}
        mappings = {name: geometry.translation(*offset) for name, offset in offsets.items()}
        captures.append(Observation(float(k), mappings, dict.fromkeys(mappings, 0.05)))
    rig = learn_rig(captures, (640, 480), {}) if has_rig else None
    net = Descriptor("pseudo-siamese", (1, 1, 1), half_rectified=True, unit_length=True)
    camera = FlightCamera("Camera 7", (("Green", 640, 480), ("NIR", 640, 480), ("[Red]", 640, 480)))
    save_model(FlightModel(net, camera, ("NIR", "[Red]"), {}, fingerprint, rig), path)


def write_band(path: Path, pixels: np.ndarray, **profile: object) -> None:
    """Write a TIFF file of one band (height, width), or of several (bands, height, width)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    planes = pixels if pixels.ndim == 3 else pixels[None]
    count, height, width = planes.shape
    shape = {"driver": "GTiff", "width": width, "height": height, "count": count, "dtype": pixels.dtype}
    with rasterio.open(path, "w", **{**shape, **profile}) as dataset:
        dataset.write(planes)


GAINS = {"green": 900, "red": 500, "nir": 700}


def write_capture(
    folder: Path, *names: str, name: str = "f", size_px: tuple[int, int] = (300, 240), **profile: object
) -> None:
    """Bands with one texture and different contrasts, as uint16."""
    for band in names:
        pixels = 3000 + GAINS[band] * textured_image(*size_px, 3)
        write_band(folder / f"{name}_{band}.tif", pixels.clip(1).astype(np.uint16), **profile)


def textured_image(width: int, height: int, seed: int = 0) -> np.ndarray:
    """A smooth random image with detail at several scales, mean 0 and standard deviation 1."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width), np.float32)
    for grain in (1.5, 3.0, 8.0, 20.0):
        layer = cv2.GaussianBlur(rng.normal(size=(height, width)).astype(np.float32), (0, 0), grain)
        image += layer / layer.std()
    return ((image - image.mean()) / image.std()).astype(np.float32)


def textured_pair(
    fixed_to_moving: np.ndarray, width: int = 400, height: int = 320, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """A fixed and a moving view of one texture, the moving one contrast-reversed and bent in its tones.

    Painted at three times the resolution, so that neither is an interpolation of the other.
    """
    factor, margin = 3, 60
    canvas = textured_image((width + 2 * margin) * factor, (height + 2 * margin) * factor, seed)
    canvas = cv2.GaussianBlur(canvas, (0, 0), factor / 2)
    to_canvas = np.array([[factor, 0, margin * factor + 1], [0, factor, margin * factor + 1], [0, 0, 1.0]])

    def view(pixel_to_canvas: np.ndarray) -> np.ndarray:
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        return cv2.warpPerspective(canvas, pixel_to_canvas, (width, height), flags=flags)

    fixed = view(to_canvas)
    moving = view(to_canvas @ np.linalg.inv(fixed_to_moving))
    return fixed, (-moving + 0.15 * moving**2).astype(np.float32)


def mean_error_px(one: np.ndarray, other: np.ndarray, width: int, height: int) -> float:
    """Mean distance between where two homographies send the pixels of an image."""
    points = geometry.lattice(width, height, 40, 30)
    return float(np.linalg.norm(geometry.apply(one, points) - geometry.apply(other, points), axis=1).mean())


@pytest.fixture(scope="session")
def between_panels(shared: Shared) -> Path:
    """The panel, two captures, and the panel again, while the sun goes down."""
    return shared("between_panels", lambda folder: make_flight_between_panels(folder, 2, (640, 480), sun=SUN))


@pytest.fixture(scope="session")
def by_sun(between_panels: Path, shared: Shared) -> Path:
    """The two captures as georeferenced reflectance by the light sensor, mapped by their tags."""
    settings = seeded(radiometry="sun", georeference=True)
    return shared("by_sun", lambda out: align_folder(between_panels, out, settings=settings))
