"""Exports of a run for other programs: band files in one folder, or the mappings as matrices for programs that warp the
original images themselves.

MicaSense's notebooks undistort each band with OpenCV's optimal new camera matrix, then warp it with
`cv2.warpPerspective(..., flags=cv2.WARP_INVERSE_MAP)`. With K and N the old and the new camera matrix of a band, and H
the mapping between undistorted pixels, their matrix is N_band K_band^-1 H K_reference N_reference^-1.
"""

import os
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from agalign.cameras import known_cameras, pix4d
from agalign.cameras.metadata import read_tags
from agalign.cameras.read_files import natural_order, read_file
from agalign.config import DiscoverOptions
from agalign.errors import ConfigurationError, InputError, OutputError
from agalign.products.run.captures import LeftOut, RunCapture, captures_of_run, like_most
from agalign.products.run.record import read_run_record
from agalign.products.sidecar.file import read_sidecar
from agalign.products.sidecar.schema import BandPart
from agalign.values import geometry, lens
from agalign.values.choices import ExportProgram
from agalign.values.files import (
    check_inside,
    complete_file,
    file_name,
    remove_partial_files,
    scratch_file,
    write_csv,
    write_text,
)
from agalign.values.geometry import Matrix, Points
from agalign.values.lens import Lens
from agalign.values.text import counted

_NOTES: dict[ExportProgram, str] = {
    "odm": """\
OpenDroneMap, WebODM: the bands of each capture are aligned, and have the tags of one camera.
  --skip-band-alignment --primary-band '{reference}' --radiometric-calibration {calibration}\
 --texturing-skip-global-seam-leveling
{reference} is the reference band, which is not resampled.
The files contain {contents}""",
    "metashape": """\
Agisoft Metashape: Workflow, Add Folder, 'Multi-camera system'.
Tools, Camera Calibration: leave the slave offsets at zero (no 'Adjust location', no 'Adjust rotation').
Tools, Set Primary Channel: {reference}.""",
    "pix4d": """\
Pix4Dmapper, Pix4Dfields: add all images; template 'Ag Multispectral'.
Leave the rig's relative parameters as 'Known': they are zero, the bands are aligned.
Radiometric processing needs raw numbers and the captures of the panel from the flight's own folder.""",
    "micasense": """\
MicaSense imageprocessing: put <serial>_warp_matrices_opencv.npy next to the notebook; it loads that file.
It is of the most typical capture: for one capture use its own <capture>_warp_matrices.npy,
  warp_matrices = [m.astype('float32') for m in numpy.load(FILE)]
Match index: the place of {reference} among the bands; warp mode: cv2.MOTION_HOMOGRAPHY.
Relief and the lenses' displacement fields are not in a matrix; matrices.csv has the largest distance.
{largest_distance}""",
    "opencv": """\
OpenCV: <capture>.npz holds `bands`, and `matrices` (n, 3, 3) from raw pixels of the reference to a band's:
  cv2.warpPerspective(band, matrices[k], (width, height), flags=cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP)
`max_error_px` is the largest distance from the complete mapping, which includes lenses and relief. That is
sampled in `grid_reference_px_k` and `grid_moving_px_k` (n, 2). (0, 0) is the centre of a pixel.
{largest_distance}""",
}
"""Instructions for the other program."""
_Row = tuple[str, str, str, float]
"""Capture, band, status, largest distance of the matrix from the complete mapping, px."""


@dataclass(frozen=True)
class ExportReport:
    """Result of an export."""

    captures: int
    files: list[Path]
    left_out: LeftOut
    notes: list[str]
    """Instructions for the other program, one per line."""


def export(
    out: Path, target: Path, program: ExportProgram, *, copy: bool = False, source: Path | None = None
) -> ExportReport:
    """Export the captures with status `ok` of the output folder of a run into a new folder.

    Band files are exported of captures with the same bands and quantities as most. They are hard links if the file
    system allows that, and copies otherwise or with `copy`. `source` is the folder with the original images, by default
    the input of the run; only the MicaSense matrices need it.
    Raises InputError if there is no run or nothing to export, ConfigurationError if the run wrote no band files,
    OutputError if `target` is not empty or cannot be written.
    """
    captures, left_out = captures_of_run(out)
    good = [c for c in captures if c.result.status == "ok"]
    # A misaligned band harms a reconstruction more than a missing capture.
    left_out += [(c.label, f"its status is {c.result.status}") for c in captures if c not in good]
    if program not in ("micasense", "opencv"):
        good, differing = like_most(good)
        left_out += differing
    if not good:
        reason = ": ".join(left_out[0])
        raise InputError(f"{out}: no capture to export ({reason}); 'agalign report {out}' shows what failed")
    rows: list[_Row] = []
    with _complete_folder(target) as folder:
        if program == "micasense":
            rows = _write_micasense(good, folder, source or _input_of(out))
        elif program == "opencv":
            rows = _write_opencv(good, folder)
        else:
            _write_band_files(good, out, folder / "images", copy=copy)
        if rows:
            cells = ((*row[:3], f"{row[3]:.4f}") for row in rows)
            write_csv(folder / "matrices.csv", ("capture", "band", "status", "max_error_px"), cells)
        files = sorted((p for p in folder.rglob("*") if p.is_file()), key=lambda p: natural_order(p.name))
        notes = _notes(program, good, files, rows)
        write_text(folder / "README.txt", "\n".join(notes) + "\n")
    return ExportReport(len(good), [target / path.relative_to(folder) for path in files], left_out, notes)


@contextmanager
def _complete_folder(target: Path) -> Iterator[Path]:
    """Yield a hidden folder in an empty or new `target`. If the block succeeds, its contents move to `target`.

    An export that is killed leaves nothing else, and the next one removes it. Raises OutputError.
    """
    remove_partial_files(target, below=False)
    with scratch_file(target / "README.txt") as folder:
        if any(target.iterdir()):
            raise OutputError(f"{target}: is not empty; choose another folder with -o, or delete it")
        try:
            yield folder
        except (OSError, OutputError) as error:
            reason = f"{target}: cannot be written ({error.strerror})" if isinstance(error, OSError) else str(error)
            raise OutputError(reason.replace(str(folder), str(target))) from None
        for path in sorted(folder.iterdir()):
            path.rename(target / path.name)


def _write_band_files(captures: Sequence[RunCapture], out: Path, images: Path, *, copy: bool) -> None:
    """Link or copy the band files. Raises ConfigurationError and OutputError."""
    taken: dict[str, str] = {}
    for capture in captures:
        output = capture.result.output
        if output is None or not output.band_files:
            raise ConfigurationError(
                f"{out}: has stacks only; run 'agalign' with --layout bands or both into it, and export again"
            )
        for part in output.band_files:
            source = check_inside(capture.path.parent / part.file, out)
            target = images / file_name((Path(capture.label).parent / part.file).as_posix(), taken)
            target.parent.mkdir(parents=True, exist_ok=True)
            if not copy:
                with suppress(OSError):  # another disk, or a file system without hard links
                    os.link(source, target)
            if not target.exists():
                shutil.copyfile(source, target)


def _notes(
    program: ExportProgram, captures: Sequence[RunCapture], files: Sequence[Path], rows: Sequence[_Row]
) -> list[str]:
    outputs = [c.result.output for c in captures if c.result.output is not None]
    facts = {"reference": Counter(c.result.reference.band for c in captures).most_common(1)[0][0]}
    if program == "odm":
        radiometry = "; ".join(sorted({output.radiometry or "" for output in outputs}))
        again = {"calibration": "none", "contents": f"{radiometry}: OpenDroneMap must not calibrate them again."}
        facts |= again if radiometry else _of_raw_numbers(files)
    if rows:
        capture, band, _, error_px = max(rows, key=lambda row: row[3])
        largest = f"Largest distance from the complete mapping: {error_px:.2f} px ({capture} {band})."
        facts["largest_distance"] = largest
    notes = _NOTES[program].format(**facts).splitlines()
    flat = sum(output.vignetting_corrected for output in outputs)
    if flat and not rows:
        notes.append(f"The vignetting of {counted(flat, 'capture')} is corrected in the pixels of all bands.")
    return notes


def _of_raw_numbers(files: Sequence[Path]) -> dict[str, str]:
    """The option of OpenDroneMap for files with raw numbers. It reads the irradiance of a light sensor under this name
    only, and without its unit as W / m^2 / nm.
    """
    names = (pix4d.NAMESPACE, "HorizontalIrradiance"), (pix4d.NAMESPACE, "IrradianceScaleToSIUnits")
    tags = (read_tags(path) for path in files)
    if all(t.number(*name) for t in tags for name in names if t.text(pix4d.NAMESPACE, "BandName") != "LWIR"):
        return {"calibration": "camera+sun", "contents": "raw numbers, and the irradiance of the light sensor."}
    contents = "raw numbers, not all with an irradiance; for reflectance align with --radiometry auto or panel."
    return {"calibration": "camera", "contents": contents}


def _write_opencv(captures: Sequence[RunCapture], target: Path) -> list[_Row]:
    """Write <capture>.npz for each capture, and return the distances from the complete mappings. Raises OutputError."""
    rows: list[_Row] = []
    for name, _, bands in _named(captures, {}):
        grids = [_grid(band) for band in bands]
        matrices, errors_px = zip(*(_fitted(*grid) for grid in grids), strict=True)
        arrays: dict[str, NDArray[np.generic]] = {"bands": np.array([b.band for b in bands])}
        for k, (points_px, mapped_px) in enumerate(grids):
            arrays |= {f"grid_reference_px_{k}": points_px, f"grid_moving_px_{k}": mapped_px}
        arrays |= {"matrices": np.stack(matrices), "max_error_px": np.array(errors_px)}
        with complete_file(target / f"{name}.npz") as partial:
            np.savez(partial, allow_pickle=False, **arrays)
        rows += _rows(name, bands, errors_px)
    return rows


def _write_micasense(captures: Sequence[RunCapture], target: Path, source: Path) -> list[_Row]:
    """Write <capture>_warp_matrices.npy for each capture, and <serial>_warp_matrices_opencv.npy for each camera, and
    return the distances from the complete mappings.

    `source` is the folder of the images. Raises InputError if an image cannot be read, ConfigurationError for other
    cameras, OutputError.
    """
    rows: list[_Row] = []
    files: dict[str, NDArray[np.float64]] = {}
    by_camera: dict[str, list[NDArray[np.float64]]] = defaultdict(list)
    taken: dict[str, str] = {}
    for name, capture, bands in _named(captures, taken):
        folder = source / Path(capture.label).parent
        cameras = {band.file: _camera_of(folder / band.file) for band in bands}
        reference = cameras[capture.result.reference.file]
        matrices, errors_px = zip(*(_in_notebook_px(b, reference, cameras[b.file]) for b in bands), strict=True)
        files[f"{name}_warp_matrices"] = stacked = np.stack(matrices)
        by_camera[cameras[bands[0].file].serial].append(stacked)
        rows += _rows(name, bands, errors_px)
    for serial, of_camera in by_camera.items():
        typical = _nearest_to_median(of_camera, captures[0].result.reference.size_px)
        files[f"{file_name(serial, taken)}_warp_matrices_opencv"] = typical
    for name, stacked in files.items():
        with complete_file(target / f"{name}.npy") as partial:
            np.save(partial, stacked)
    return rows


def _input_of(out: Path) -> Path:
    """The folder of the images of a run. Raises InputError."""
    run = read_run_record(out)
    if run is None:
        raise InputError(f"{out}: does not name the folder of the images; give it with --source")
    return Path(run.input)


def _named(captures: Sequence[RunCapture], taken: dict[str, str]) -> Iterator[tuple[str, RunCapture, list[BandPart]]]:
    """Yield (file name, capture, its bands in the order of their numbers in the file names)."""
    for capture in captures:
        bands = sorted(read_sidecar(capture.path).bands, key=lambda b: (natural_order(b.file), b.band_index))
        yield file_name(capture.label, taken), capture, bands


def _rows(name: str, bands: Sequence[BandPart], errors_px: Sequence[float]) -> list[_Row]:
    return [(name, b.band, b.status, e) for b, e in zip(bands, errors_px, strict=True)]


def _grid(band: BandPart) -> tuple[Points, Points]:
    """(raw pixels (n, 2) of the reference, corresponding raw pixels of the band); n = 0 for the reference itself."""
    if band.grid is None:
        return np.empty((0, 2)), np.empty((0, 2))
    return np.array(band.grid.reference_px), np.array(band.grid.moving_px)


def _fitted(points_px: Points, mapped_px: Points, matrix: Matrix | None = None) -> tuple[Matrix, float]:
    """(`matrix` or the homography between corresponding points (n, 2), which is the identity without any; the largest
    distance of the points that it maps from the corresponding ones, px).
    """
    if matrix is None:
        matrix = geometry.fit_homography(points_px, mapped_px) if len(points_px) else geometry.identity()
    distances_px = np.linalg.norm(geometry.apply(matrix, points_px) - mapped_px, axis=1)
    return matrix, float(distances_px.max(initial=0.0))


class _Camera(NamedTuple):
    """The camera of a band of MicaSense."""

    lens: Lens
    new_matrix: Matrix
    """Of the undistorted image in the notebooks."""
    serial: str


def _camera_of(path: Path) -> _Camera:
    """The camera of an original image. Raises InputError, ConfigurationError."""
    if not path.is_file():
        raise InputError(f"{path}: the image is not there; give the folder of the flight's images with --source")
    image = read_file(path, known_cameras(), DiscoverOptions())
    of_image = image.bands[0].lens if image.bands else None
    if image.camera.name != "MicaSense" or of_image is None:
        raise ConfigurationError(f"{path}: no lens tags of a MicaSense camera; use --for opencv")
    distortion = np.array((*of_image.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5])  # k1, k2, p1, p2, k3
    new_matrix, _ = cv2.getOptimalNewCameraMatrix(of_image.matrix, distortion, image.bands[0].size_px, 1)
    return _Camera(of_image, np.asarray(new_matrix, np.float64), image.tags.serial or "camera")


def _in_notebook_px(band: BandPart, reference: _Camera, camera: _Camera) -> tuple[Matrix, float]:
    """(the matrix between the pixels that the notebooks warp, its largest distance from the complete mapping, px)."""
    points_px, mapped_px = _grid(band)
    undistorted, mapped = lens.undistort(reference.lens, points_px), lens.undistort(camera.lens, mapped_px)
    mapping = band.homography
    known = None if mapping is None or mapping.space != "undistorted" else np.array(mapping.fixed_to_moving)
    matrix, error_px = _fitted(undistorted, mapped, known)
    to_new = camera.new_matrix @ np.linalg.inv(camera.lens.matrix)
    from_new = reference.lens.matrix @ np.linalg.inv(reference.new_matrix)
    return geometry.compose(to_new, matrix, from_new), error_px


def _nearest_to_median(captures: Sequence[NDArray[np.float64]], size_px: tuple[int, int]) -> NDArray[np.float64]:
    """The matrices (bands, 3, 3) of the capture with the mapped corners nearest to the median of all captures with as
    many bands as the first.
    """
    complete = [matrices for matrices in captures if matrices.shape == captures[0].shape]
    corners_px = geometry.corners(*size_px)
    mapped = np.array([[geometry.apply(m, corners_px) for m in matrices] for matrices in complete])
    distances_px = np.linalg.norm(mapped - np.median(mapped, axis=0), axis=-1)
    return complete[int(distances_px.mean(axis=(1, 2)).argmin())]
