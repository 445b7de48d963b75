"""Aligned captures as lazily read xarray datasets, with a variable for each band."""

import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agalign.errors import ConfigurationError, InputError, UnreadableFileError
from agalign.pixels.coordinates import ensure_proj_data
from agalign.pixels.gdal import gdal_name, without_warnings
from agalign.rasters.alignment_maps import RELIEF_UNITS, ReliefMap
from agalign.rasters.band_reader import like_most
from agalign.records.captures import RunCapture, captures_of_run, differing_from_most
from agalign.records.listed_files import ListedFiles
from agalign.records.sidecar import BandResult
from agalign.records.sidecar_file import read_sidecar
from agalign.values.arguments import checked
from agalign.values.capture import CaptureTime
from agalign.values.radiometry import are_raw_numbers

if TYPE_CHECKING:
    import xarray


@checked
def open_capture(path: str | Path, *, masked: bool = True) -> "xarray.Dataset":
    """Open the aligned bands of a capture as an xarray Dataset, read lazily with dask.

    Parameters
    ----------
    path
        Sidecar (<capture>.json) or stack (<capture>.tif) of the capture.
    masked
        Return float32 with NaN for nodata, and values by the scale and offset of the file. False: the type of the file,
        with its `_FillValue`, `scale_factor` and `add_offset`; differences of unsigned integers then wrap around.

    Returns
    -------
    xarray.Dataset
        A variable (y, x) for each band with pixels, with the attributes `wavelength_nm`, `status` and, if it is known,
        `units` (`count`: raw numbers). The coordinates are pixel centres: map coordinates if the capture is
        georeferenced (`.rio.crs`), else px of the output, with (0, 0) the centre of the top-left pixel. On a rotated
        grid, as `--georeference` writes it, the map coordinates of every pixel are `xc` and `yc`. A capture with a
        parallax map has the variable `parallax` (px along a baseline of length 1, larger for nearer objects) and, if
        the run wrote them, `confidence` and `range` (m).

    Raises
    ------
    SidecarError
        The sidecar is missing or malformed.
    UnreadableFileError
        A raster cannot be read, or is not as it was written.
    InputError
        `path` is a folder.
    ConfigurationError
        xarray, rioxarray or dask is not installed.

    Examples
    --------
    >>> capture = agalign.open_capture("aligned/0000SET/000/IMG_0001.json")
    >>> list(capture.data_vars)
    ['Blue', 'Green', 'Red', 'NIR', 'Red edge']
    >>> capture["NIR"].dtype.name, capture["NIR"].attrs["status"]
    ('float32', 'aligned')
    """
    given = Path(path)
    if given.is_dir():
        raise InputError(f"{given}: is a folder; give the sidecar of a capture, or use open_flight")
    name = re.sub(r"\.json$|\.tiff?$", "", given.name, flags=re.IGNORECASE)
    sidecar = given.with_name(f"{name}.json")
    return _dataset(RunCapture(name, sidecar, read_sidecar(sidecar)), masked=masked)


@checked
def open_flight(out: str | Path, *, masked: bool = True) -> "xarray.Dataset":
    """Open all captures of a run as one xarray Dataset, read lazily with dask.

    Captures that cannot be read, or whose bands or quantity differ from most others, are skipped with a UserWarning
    that lists them: a variable has one unit.

    Parameters
    ----------
    out
        Output folder of a run. Its captures must have one size, as `WriteSettings(crop="flight")` (default) writes.
    masked
        As for `open_capture`.

    Returns
    -------
    xarray.Dataset
        A variable (capture, y, x) for each band; y and x are px of the output, with (0, 0) the centre of the top-left
        pixel. The coordinates of `capture` are its label, `time` (attribute `source`: UTC, or by the camera's clock),
        `latitude` and `longitude` (degrees, WGS 84) and `altitude_m`; NaT or NaN if they are unknown. `status`
        (capture, band) is the status of each band.

    Raises
    ------
    InputError
        `out` contains no aligned captures, or they differ in size.
    SidecarError, UnreadableFileError, ConfigurationError
        As for `open_capture`.

    Examples
    --------
    >>> flight = agalign.open_flight("aligned")
    >>> ndvi = (flight["NIR"] - flight["Red"]) / (flight["NIR"] + flight["Red"])
    >>> ndvi.dims, ndvi.sizes["capture"]
    (('capture', 'y', 'x'), 2)
    """
    xr = import_xarray()
    captures = _captures_with_output(Path(out))
    opened = [_dataset(c, masked=masked) for c in captures]
    common = [name for name in opened[0].data_vars if all(name in one for one in opened)]
    # In pixels: the map coordinates of the captures differ.
    in_pixels = [_in_pixels(one[common]) for one in opened]
    bands = [name for name in common if "status" in opened[0][name].attrs]
    status = [[one[name].attrs["status"] for name in bands] for one in opened]
    stacked = xr.concat(in_pixels, dim="capture", join="override", combine_attrs="override", coords="minimal")
    stacked.attrs = {k: opened[0].attrs[k] for k in ("camera", "reference_band")}
    for name in bands:
        del stacked[name].attrs["status"]
    # nan for an unknown position
    places = {
        name: ("capture", np.array([getattr(c.result.position, name, None) for c in captures], np.float64))
        for name in ("latitude", "longitude", "altitude_m")
    }
    flight: xarray.Dataset = stacked.assign_coords(
        capture=[c.label for c in captures],
        time=_times(captures),
        band=bands,
        status=(("capture", "band"), status),
        **places,
    )
    return flight


def _captures_with_output(folder: Path) -> list[RunCapture]:
    """The captures with rasters, which have one size and the same contents. Raises InputError."""
    captures, left_out = captures_of_run(folder)
    left_out += [(c.label, "it has no aligned pixels") for c in captures if c.result.output is None]
    alike, differing = like_most([c for c in captures if c.result.output is not None])
    crops = [(c, c.result.output.crop) for c in alike if c.result.output is not None]
    if sizes := differing_from_most({c.label: (f"{crop[2]} x {crop[3]} px",) for c, crop in crops}):
        remedy = "align again with --crop none, or each camera into a folder of its own, or use open_capture"
        raise InputError(f"{folder}: its captures differ in size ({'; '.join(map(': '.join, sizes[:3]))}); {remedy}")
    if lines := [f"{label}: left out: {reason}" for label, reason in [*left_out, *differing]]:
        warnings.warn("\n".join(lines), stacklevel=4)
    if not alike:
        raise InputError(f"{folder}: no aligned captures there; give the output folder of a run")
    return alike


def import_xarray() -> Any:
    """Import and return xarray. Raises ConfigurationError if it or a library that it needs here is not installed."""
    try:
        import dask.array  # noqa: F401
        import rioxarray  # noqa: F401
        import xarray as xr
    except ImportError:
        raise ConfigurationError(
            "xarray, rioxarray and dask are not installed; in a checkout: pip install '.[xarray]'"
        ) from None
    return xr


def _dataset(capture: RunCapture, *, masked: bool) -> "xarray.Dataset":
    xr, sidecar, folder = import_xarray(), capture.result, capture.path.parent
    if sidecar.output is None:
        raise InputError(f"{capture.path}: its capture has no aligned pixels; look at the report of the run")
    files: dict[str, xarray.DataArray] = {}
    result = {}
    for band in sidecar.bands:
        if band.place is None:
            continue
        name = band.place.file
        if name not in files:
            files[name] = _opened(folder / name, capture.listed, masked=masked)
        result[band.band] = _variable(files[name], band, band.place.band_index, name, masked=masked)
    for relief in (path for path, part in capture.listed.parts.items() if part.kind == ReliefMap.kind):
        layers = _opened(relief, capture.listed, masked=True)
        for index, name in enumerate(np.atleast_1d(layers.attrs.get("long_name", "parallax"))):
            one = layers.isel(band=index, drop=True)
            result[str(name)] = one.assign_attrs(long_name=str(name), units=RELIEF_UNITS[name])
    dataset: xarray.Dataset = xr.Dataset(result)
    dataset.attrs = {k: getattr(sidecar, k) for k in ("capture", "capture_id", "flight_id", "captured_at")}
    dataset.attrs |= {"camera": sidecar.camera.name, "reference_band": sidecar.reference.band}
    return dataset if dataset.rio.crs is not None else _in_pixels(dataset)


def _opened(path: Path, listed: ListedFiles, *, masked: bool) -> Any:
    """The array of a file. Raises UnreadableFileError for a file that is not as it was written."""
    import rioxarray

    ensure_proj_data()
    if problem := listed.problem(path):
        raise UnreadableFileError(problem)
    try:
        with without_warnings(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "(Scales|Offsets) differ across bands")  # each variable has its own
            # Some of GDAL's other drivers open files or addresses that the contents of a file name.
            # Chunks of four blocks of the stacks along each axis: dask reads 2 MB of 16 bits at a time.
            chunks = {"x": 1024, "y": 1024}
            return rioxarray.open_rasterio(gdal_name(path), chunks=chunks, mask_and_scale=masked, driver="GTiff")
    except OSError as error:
        raise UnreadableFileError(f"{path}: cannot be read ({error})", "run again") from None


def _variable(file: "xarray.DataArray", band: BandResult, index: int, name: str, *, masked: bool) -> "xarray.DataArray":
    if index > file.sizes["band"]:
        raise UnreadableFileError(f"{name}: has no band {index}, as its sidecar says", "run again")
    one = file.isel(band=index - 1, drop=True)
    if masked:
        one = one.astype(np.float32)  # rioxarray keeps integers without a nodata value
    attrs = {k: v[index - 1] if isinstance(v, tuple) else v for k, v in file.attrs.items()}
    names = {"_FillValue": "_FillValue", "scales": "scale_factor", "offsets": "add_offset"}
    encoding = {new: attrs[k] for old, new in names.items() for k in (old, new) if k in attrs}
    one.attrs = encoding | {"long_name": band.band, "status": band.status}
    scales = file.encoding | file.attrs  # in either
    scale = np.atleast_1d(scales.get("scales", scales.get("scale_factor", 1.0)))
    is_count = are_raw_numbers(file.encoding["rasterio_dtype"], float(scale[min(index, len(scale)) - 1]))
    if unit := attrs.get("units") or ("count" if is_count else ""):
        one.attrs["units"] = unit
    if band.wavelength_nm is not None:
        one.attrs["wavelength_nm"] = band.wavelength_nm
    return one


def _in_pixels(dataset: "xarray.Dataset") -> "xarray.Dataset":
    """The dataset with pixel coordinates instead of map coordinates."""
    px = {axis: range(dataset.sizes[axis]) for axis in ("y", "x")}
    # rioxarray adds map coordinates of every pixel, xc and yc, to rotated grids.
    return dataset.drop_vars(["spatial_ref", "xc", "yc"], errors="ignore").assign_coords(px)


def _times(captures: Sequence[RunCapture]) -> tuple[str, list[Any], dict[str, str]]:
    known = [CaptureTime.of(c.result.captured_at) for c in captures]
    times = [np.datetime64("NaT" if t is None else t.utc.replace(tzinfo=None), "us") for t in known]
    return "capture", times, {"source": ", ".join(sorted({t.source for t in known if t is not None}))}
