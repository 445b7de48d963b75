"""Reading the tags and bands of many image files, in one process or several."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path

from agalign.cameras import consistency
from agalign.cameras.base import Camera
from agalign.cameras.image_file import Doubt, ImageFile, OwnFile, Problem
from agalign.cameras.makers import known_cameras
from agalign.cameras.metadata import Tags, read_tags
from agalign.cameras.pix4d import panel_in
from agalign.cameras.tiff_directory import image_pages
from agalign.config import DiscoverOptions
from agalign.errors import InputError, UnreadableFileError
from agalign.host.files import is_inside
from agalign.host.own_files import has_mark
from agalign.host.process_pool import WorkerDiedError, open_pool
from agalign.host.processes import cores_for
from agalign.host.text import shortened
from agalign.pixels.radiometry import plausible
from agalign.pixels.raster import probe, read_tile, suffix_format, value_step
from agalign.values import geometry
from agalign.values.capture import Band
from agalign.values.image import Tile
from agalign.values.lens import rescaled
from agalign.values.pixel_units import SAME_PIXELS, PixelScale

_FILES_PER_TASK = 100
"""If a file crashes the process, the other files of its task are lost; smaller tasks take more time per file."""
_MIN_FILES_FOR_PROCESSES = 1000
"""Reading fewer files takes less time than starting processes."""


def read_files(paths: Sequence[Path], options: DiscoverOptions) -> Iterator[ImageFile | Problem]:
    """Yield each file with its bands, or the reason why it cannot be used, in the order of `paths`."""
    cores = cores_for(options.jobs)
    if options.timeout_s is not None or (cores > 1 and len(paths) >= _MIN_FILES_FOR_PROCESSES):
        yield from _read_in_processes(paths, options, cores)
    else:
        yield from _read_task(paths, options)


def read_file(path: Path, cameras: Iterable[Camera], options: DiscoverOptions) -> ImageFile:
    """Return a file with its bands. Raises UnreadableFileError."""
    if not is_inside(path.name):  # outputs are named after it, and a sidecar with such names is not read
        raise UnreadableFileError(f"{path}: its name is an absolute path on Windows", "rename it")
    pages = _stored_pages(path, options.max_pixels)
    tags = read_tags(path, pages[0][0].page)
    *_, generic = cameras
    camera = next(c for c in cameras if c.recognises(tags))
    tags, of_position = consistency.with_position(tags, camera.other_position(tags), camera.sun(tags))
    pages[0], of_samples = _without_constant_sample(pages[0], is_of_camera=camera is not generic)
    is_photograph = (pages[0][0].dtype == "uint8" or camera.has_one_lens(tags)) and len(pages[0]) in (3, 4)
    # A stack was made by software, even if its tags name a camera: cameras write single bands and photographs.
    if suffix_format(path) == "TIFF" and len(pages[0]) > 1 and not is_photograph:
        camera = generic
    if camera is not generic:
        _check_sign(pages[0][0])
    panel, stored = panel_in(tags, pages[0][0].size_px), pages[0][0]
    named = [replace(b, panel=panel) for b in _named_bands(path, tags, camera, pages)]
    used = (b for b in named if options.with_rgb or not b.is_from_photograph)
    checked = [_of_image(band, tags, consistency.min_raw_step(tags, stored)) for band in used]
    bands = tuple(_with_plausible_tags(band, tags) for band, _, _ in checked)
    scale = checked[0][1] if checked else SAME_PIXELS
    other_lens = next((why for *_, why in checked if why), "")
    doubts = of_position, of_samples, *_doubts(camera, tags, bands, other_lens)
    return ImageFile(path, camera, tags, bands, scale, bool(other_lens), tuple(d for d in doubts if d is not None))


def _named_bands(path: Path, tags: Tags, camera: Camera, pages: Sequence[tuple[Band, ...]]) -> list[Band]:
    """The bands of all pages of a file, with their names; `tags` are those of the first page.

    Raises UnreadableFileError for pages without names.
    """
    named = list(camera.bands(path, tags, pages[0]))
    for page in pages[1:]:
        named += camera.bands(path, read_tags(path, page[0].page), page)
    if len(pages) > 1 and len({b.name for b in named}) < len(pages):
        what = f"has {len(pages)} pages of one size without names of bands"
        raise UnreadableFileError(f"{path}: {what}", "write each page to a file of its own (tiffsplit)")
    if len(pages) > 1:
        named = [replace(band, band_index=band.page) for band in named]
    return [replace(band, name=shortened(band.name)) for band in named]


def _without_constant_sample(stored: tuple[Band, ...], *, is_of_camera: bool) -> tuple[tuple[Band, ...], Doubt | None]:
    """Return the bands of a camera's file without a second sample that a program added, such as an undeclared alpha
    channel: one of the two is constant.
    """
    if not is_of_camera or len(stored) != 2 or suffix_format(stored[0].path) != "TIFF":
        return stored, None
    is_constant = []
    for band in stored:
        pixels, _ = read_tile(band, Tile(0, 0, *band.size_px))
        is_constant.append(bool((pixels == pixels[0, 0]).all()))
    if is_constant.count(True) != 1:
        return stored, None
    constant, image = sorted(stored, key=lambda band: not is_constant[stored.index(band)])
    text = f"sample {constant.band_index} of its pixels is constant"
    return (image,), Doubt(text, "it is not used, as a camera writes one sample: a program added it")


def _check_sign(band: Band) -> None:
    """Raise UnreadableFileError for a camera's file whose raw numbers were stored as signed ones."""
    max_wrapped = -4096  # processed values are a little below 0, raw numbers above 32767 become -32768 and more
    if band.dtype != "int16" or band.nodata is not None:
        return
    pixels, valid = read_tile(band, Tile(0, 0, *band.size_px))
    if pixels[valid].min(initial=0) < max_wrapped:
        what = "some of its pixels are negative: raw numbers above 32767 were stored as signed ones"
        remedy = "copy it from the card again, or store them as unsigned 16 bits"
        raise UnreadableFileError(f"{band.path}: {what}", remedy)


def _doubts(camera: Camera, tags: Tags, bands: Sequence[Band], other_lens: str) -> Iterator[Doubt]:
    """What two sources in a file give differently."""
    if other_lens:
        yield Doubt(other_lens, "lens, rig and radiometry are not used: give the original images")
    if error := consistency.clock_error(tags.near, tags.captured_at, camera.sun(tags)):
        text = f"its clock {error}, by the position of the sun in the tags of the light sensor"
        yield Doubt(text, "the irradiance is used as measured; correct the time for what depends on it")
    for text in camera.contradictions(tags):
        yield Doubt(text, "correct the tags, or leave --radiometry out")
    if (text := consistency.normalized(tags)) and any(text in band.missing_calibration for band in bands):
        yield Doubt(text, "radiometry is not used: give the original images")


def _of_image(band: Band, tags: Tags, raw_step: int) -> tuple[Band, PixelScale, str]:
    """Return the band with what its tags give in pixels as it is for its image, the size of this relative to the
    camera's, and why these tags are not used; empty if they are. Raw numbers are multiples of `raw_step`.
    """
    scale, why = consistency.pixel_scale(
        tags, band, lambda: band.dtype == "uint16" and value_step(band) % raw_step == 0
    )
    if scale != SAME_PIXELS:
        planes = band.to_rig, band.other_to_rig
        to_rig, other = (None if h is None else geometry.rescale(h, scale, SAME_PIXELS) for h in planes)
        radiometry = band.radiometry and replace(band.radiometry.rescaled(scale), raw_step=1)
        panel = band.panel and band.panel.rescaled(scale)
        band = replace(band, lens=rescaled(band.lens, scale), has_other_lens=True)
        band = replace(band, to_rig=to_rig, other_to_rig=other, radiometry=radiometry, panel=panel)
    if not why and band.lens is not None and not band.lens.is_plausible(band.size_px):
        why = consistency.lens_of_other_image(band)
    return _without_lens(band, why) if why else band, scale, why


def _without_lens(band: Band, why: str) -> Band:
    panel = band.panel and replace(band.panel, corners_px=())  # the image is searched for it
    band = replace(band, lens=None, to_rig=None, other_to_rig=None, panel=panel, has_other_lens=True)
    if band.radiometry is not None and band.radiometry.is_of_light:  # its vignetting is of the same image
        band = replace(band, radiometry=None, missing_calibration=f"no usable tags for radiance ({why})")
    return band


def _with_plausible_tags(band: Band, tags: Tags) -> Band:
    """The band without a calibration, or its factor to reflectance, by implausible tags."""
    if band.radiometry is None:
        return band
    if band.radiometry.is_of_light and (problem := consistency.normalized(tags)):
        return replace(band, radiometry=None, missing_calibration=f"no usable tags for radiance ({problem})")
    radiometry, problem = plausible(band.radiometry, band.size_px)
    problem = problem or consistency.vignetting_of_other_lens(band)
    if problem and "vignetting" in problem:
        radiometry = None
    reason = f"no usable tags for radiance ({problem})" if radiometry is None else ""
    return replace(band, radiometry=radiometry, implausible=problem or band.implausible, missing_calibration=reason)


def _stored_pages(path: Path, max_pixels: int) -> list[tuple[Band, ...]]:
    """Return the bands of each page with an image of full size; most files have one. Raises UnreadableFileError."""
    first, numbers = probe(path, max_pixels), [1]
    if suffix_format(path) == "TIFF":
        with suppress(ValueError, OSError):  # the error of GDAL is reported
            numbers = image_pages(path) or numbers
    if numbers == [1]:
        return [first]
    pages = [probe(path, max_pixels, number) for number in numbers]
    largest_px = max(page[0].size_px for page in pages)
    return [page for page in pages if page[0].size_px == largest_px]


def _read_in_processes(paths: Sequence[Path], options: DiscoverOptions, cores: int) -> Iterator[ImageFile | Problem]:
    tasks = [paths[i : i + _FILES_PER_TASK] for i in range(0, len(paths), _FILES_PER_TASK)]
    # The workers import this module when they start: tasks do not wait for that.
    with open_pool(min(cores, len(tasks)), 1, partial(import_module, __name__)) as pool:
        submit = partial(pool.submit, _read_task, timeout_s=options.timeout_s)
        futures = [submit(task, options) for task in tasks]
        for task, future in zip(tasks, futures, strict=True):
            try:
                yield from future.result()
            except (TimeoutError, WorkerDiedError):  # one at a time, to find the file
                for path, one in [(path, submit([path], options)) for path in task]:
                    try:
                        yield from one.result()
                    except TimeoutError:
                        yield _unread(path, f"reading it took over {options.timeout_s:g} s (--timeout)")
                    except WorkerDiedError:
                        yield _unread(path, "reading it killed the process")


def _unread(path: Path, what: str) -> Problem:
    return Problem(path, UnreadableFileError(f"{path}: {what}", "take it out of the folder"))


def _read_task(paths: Iterable[Path], options: DiscoverOptions) -> list[ImageFile | Problem]:
    cameras = known_cameras(options.pattern)
    result: list[ImageFile | Problem] = []
    for path in paths:
        if has_mark(path):
            result.append(OwnFile(path, InputError(f"{path}: was written by agalign")))
            continue
        try:
            result.append(read_file(path, cameras, options))
        except UnreadableFileError as error:
            result.append(Problem(path, error))
        except MemoryError:  # no fault of the file
            raise
        except Exception as error:  # tags may have any values, and one file must not end the run
            what = f"{path}: its tags cannot be used ({shortened(f'{type(error).__name__}: {error}')})"
            result.append(Problem(path, UnreadableFileError(what, "leave it out with --exclude, and report this")))
    return result
