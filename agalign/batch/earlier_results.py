"""Results of earlier runs in the output folder: what has changed since, and which are of captures that the input no
longer has.
"""

import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Literal

from agalign._version import __version__
from agalign.batch.output_files import is_same
from agalign.batch.render import with_earlier_products
from agalign.cameras.discover import FolderScan
from agalign.config import RunOptions, Settings, WriteSettings
from agalign.errors import Reason, SidecarError, UnreadableFileError
from agalign.flight.fingerprint import (
    RENDER_STAGES,
    estimation_fingerprint,
    input_digests,
    input_samples,
    input_states,
    render_fingerprint,
)
from agalign.host.held_sizes import WORK_TILE_PX
from agalign.host.text import counted
from agalign.pixels.raster import read_tile
from agalign.rasters.product import CapturePaths
from agalign.records.listed_files import file_problem, states_of
from agalign.records.run_record import NotInInputPart, RunPart
from agalign.records.sidecar import FilePart, Sidecar, capture_status
from agalign.records.sidecar_file import find_sidecars, label_of, read_checked, read_sidecar, read_with_change
from agalign.spectral_indices.rasters import index_rasters
from agalign.values.capture import Band, Capture
from agalign.values.image import OutputGrid, Tile
from agalign.values.resampling import tiles

_DAMAGED = "the sidecar (edited or damaged)"


class EarlierResults:
    """The sidecars of earlier runs. Each is compared with its checksum once unless it changes; those of a season would
    not fit into memory.
    """

    def __init__(self) -> None:
        self._changes: dict[Path, tuple[tuple[int, int, int], Reason | None]] = {}
        """Size, time and number of each file, and why it is not as it was written; None if it is."""
        self.file_states: dict[str, str] = {}
        """States in which runs left the files of each capture, by label (`records.listed_files`)."""
        self.models: dict[Path, str] = {}
        """Fingerprint of the model in each sidecar that is as it was written, by path; empty without a model."""

    def __call__(self, path: Path) -> tuple[Sidecar, Reason | None]:
        """Return a sidecar without its long tables, and why it is not as it was written (`read_with_change`).

        Raises SidecarError.
        """
        state = 0, 0, 0
        with suppress(OSError):
            status = path.stat()
            state = status.st_size, status.st_mtime_ns, status.st_ino
        known = self._changes.get(path)
        if known is not None and known[0] == state:
            return read_sidecar(path).without_tables(), known[1]
        sidecar, change = read_with_change(path)
        self._changes[path] = state, change
        self.models[path] = "" if change else sidecar.model
        return sidecar.without_tables(), change

    def changed_files(self, label: str, folder: Path, parts: Sequence[FilePart]) -> list[FilePart]:
        """Return the files of a capture that are not as they were written, given the folder of its sidecar.

        The states of the others are added to `file_states`, so that no file is read twice.
        """
        known = set(self.file_states.get(label, "").split())
        changed = [part for part in parts if file_problem(folder / part.file, part, known)]
        unchanged = [part for part in parts if part not in changed]
        self.file_states[label] = " ".join(known.union(states_of(folder, unchanged)))
        return changed


Step = Literal["nothing", "keep", "render", "estimate"]
_IN_WORDS: Mapping[Step, str] = {
    "nothing": "kept from an earlier run",
    "keep": "kept from an earlier run, as input files are missing or damaged now",
    "render": "to be rendered",
    "estimate": "to be aligned",
}


@dataclass(frozen=True)
class Remaining:
    """What remains to be done for a capture."""

    step: Step
    """The first step; rendering follows the estimation. `keep`: files of an earlier result are lost, so that this run
    would replace it by one with fewer bands.
    """
    changed: tuple[str, ...] = ()
    """What has changed since an earlier command has done it; empty if none has."""
    grid: OutputGrid | None = None
    """Grid of the rasters of the earlier command, if the estimation is kept and this run makes the same grids."""
    why_kept: str = ""
    """The lost files and the remedy, for the step `keep`."""

    @property
    def is_processed(self) -> bool:
        """True if a run processes the capture, and does not keep it."""
        return self.step in ("estimate", "render")

    @property
    def in_words(self) -> str:
        """What a run does with the capture, and which changes are the reason."""
        if not self.changed:
            return _IN_WORDS[self.step]
        again = "estimated" if self.step == "estimate" else "rendered"
        return f"to be {again} again; changed since: {', '.join(self.changed)}"


def changes(captures: Iterable[Remaining]) -> Iterator[str]:
    """Yield, in words, which finished captures are processed again, and why."""
    steps: Sequence[Step] = "estimate", "render"
    for step in steps:
        again = [one.changed for one in captures if one.step == step and one.changed]
        if again:
            changed = tuple(dict.fromkeys(name for names in again for name in names))
            yield f"{counted(len(again), 'finished capture')} {Remaining(step, changed).in_words}"


def remaining(
    capture: Capture, out: Path, settings: Settings, options: RunOptions, results: EarlierResults
) -> Remaining:
    """Return what remains to be done for a capture, given what the output folder has of it.

    The estimation is kept if all that it depends on is unchanged: options, version, contents of the input files. So are
    products, if their files exist too, and there are all those that the settings ask for.
    """
    path = CapturePaths.of(capture, out).sidecar
    try:
        earlier, change = results(path)
    except SidecarError:
        return _after_damage(path, capture, options)
    has_other_files, lost = _compared_files(earlier, capture)
    if lost and not options.overwrite:
        damage = f"the sidecar {change.what}" if change else ""
        return _kept(lost, damage, None if change else _earlier_grid(earlier, settings.write))
    if change:
        return Remaining("estimate", (_DAMAGED,))
    if earlier.estimated_with != estimation_fingerprint(capture, settings):
        changed = _changed_options(earlier, settings, are_of_rendering=False)
        if earlier.agalign != __version__:
            changed = *changed, f"version (agalign {earlier.agalign} before)"
        other = ("input files",) if has_other_files else _changed_selection(earlier, capture)
        return Remaining("estimate", changed or other)
    if has_other_files:
        return Remaining("estimate", ("input files",))
    status = capture_status(earlier.bands, capture.missing_bands, settings.check.accept_predicted_px)
    if options.overwrite or (options.retry_failed and {earlier.status, status} != {"ok"}):
        return Remaining("estimate")
    return _to_render(capture, path, settings, earlier, results)


def _after_damage(path: Path, capture: Capture, options: RunOptions) -> Remaining:
    """Return what remains to be done for a capture whose sidecar is missing or cannot be read."""
    if not path.exists():
        return Remaining("estimate")
    missing = {name: f"{name} is missing" for name in capture.missing_bands}
    lost = [*(missing | {name: why.what for name, why in capture.unreadable_bands.items()}).values()]
    if lost and not options.overwrite:
        return _kept(lost, "the sidecar cannot be read", None)
    return Remaining("estimate", (_DAMAGED,))


def _kept(lost: Sequence[str], damage: str, grid: OutputGrid | None) -> Remaining:
    remedy = "copy such files from the card again, or align without them by --overwrite"
    state = f"not processed, as {damage}" if damage else "kept as aligned before"
    return Remaining("keep", (), grid, f"{state}, and now {'; '.join(lost)}; {remedy}")


def _to_render(
    capture: Capture, path: Path, settings: Settings, earlier: Sidecar, results: EarlierResults
) -> Remaining:
    """Return what remains to be done for a capture whose mappings are kept."""
    parallax = [] if earlier.parallax is None else [earlier.parallax]
    if not outputs_exist(path, parallax):
        return Remaining("estimate", ("the parallax file",))
    write = with_earlier_products(settings.write, earlier)
    changed = _changed_options(earlier, settings.model_copy(update={"write": write}), are_of_rendering=True)
    if earlier.rendered_with and earlier.rendered_with != render_fingerprint(capture, write, settings.check):
        changed = changed or ("tags, panels or bands of the camera",)
    requested = {f"{capture.name}_{name}.tif" for name in write.indices}
    if not outputs_exist(path, [part for part in earlier.products if part.kind != "index" or part.file in requested]):
        changed = (*changed, "files that are missing")
    is_finished = not changed and not earlier.not_written and earlier.rendered_with
    grid = _earlier_grid(earlier, settings.write)
    differing = results.changed_files(capture.label, path.parent, earlier.files if is_finished else parallax)
    if parallax and parallax[0] in differing:
        return Remaining("estimate", ("the parallax file",))
    # Only `agalign indices` restores an index raster that is missing or unreadable, and its picture.
    readable = {raster.path.stem for raster in (index_rasters(path.with_suffix("")) if differing else [])}
    if any(part.kind != "index" or Path(part.file).stem in readable for part in differing):
        return Remaining("render", ("files that are not as they were written",), grid)
    return Remaining("nothing" if is_finished else "render", changed, grid)


def _earlier_grid(earlier: Sidecar, settings: WriteSettings) -> OutputGrid | None:
    """Return the grid of the rasters of an earlier result if these settings make the same; None without any."""
    before, now = earlier.write_options, settings.model_dump(mode="json", exclude_defaults=True)
    is_same = all(before.get(name) == now.get(name) for name in ("crop", "resolution", "undistort"))
    return earlier.output.grid if earlier.output is not None and is_same else None


def _compared_files(earlier: Sidecar, capture: Capture) -> tuple[bool, list[str]]:
    """Return (True if input files have other contents than those of an earlier result, why files of it are lost).

    Of each file, size, times and samples are compared, and if the times differ, the checksum. A band that the options
    leave out, whose file exists, is not lost.
    """
    changed, lost, here = set[str](), list[str](), {b.name: b for b in capture.bands}
    root = capture.root or Path()  # files without a root have absolute paths
    samples, states, digests = input_samples(capture), input_states(capture), dict[str, str]()
    for part in earlier.bands:
        name = part.band
        if name not in here:
            if reason := capture.unreadable_bands.get(name):
                lost.append(reason.what)
            elif name in capture.missing_bands or not (root / part.file).is_file():
                lost.append(f"{part.file} is missing")
        elif name not in states:
            lost.append(f"{part.file} cannot be read")
        elif samples.get(name) != earlier.input_samples.get(name):
            changed.add(name)
        elif states[name] != earlier.input_states.get(name):
            digests = digests or input_digests(capture)
            if digests.get(name) != earlier.input_digests.get(name):
                changed.add(name)
    for name in changed:
        if problem := _unreadable(here[name]):
            lost.append(problem)
    return bool(changed), lost


def _unreadable(band: Band) -> str:
    """Return why the pixels of a band cannot be read; empty if they can."""
    try:
        for tile in tiles(Tile(0, 0, *band.size_px), WORK_TILE_PX):
            read_tile(band, tile)
    except UnreadableFileError as error:
        return error.reason.what
    return ""


def _changed_selection(earlier: Sidecar, capture: Capture) -> tuple[str, ...]:
    """Return the options of the selection of files by which a capture has other bands or another reference."""
    bands = {b.band for b in earlier.bands}, {b.name for b in capture.bands}
    if bands[0] != bands[1]:
        return ("--bands, or the bands of the capture",)
    return ("--reference",) if earlier.reference.band != capture.reference.name else ("tags of the camera",)


def _changed_options(earlier: Sidecar, settings: Settings, *, are_of_rendering: bool) -> tuple[str, ...]:
    """Return the flags of the options that have changed, either those that only render or the others; indices are
    changed if some are missing.
    """
    before, now = earlier.options or {}, settings.model_dump(mode="json", exclude_defaults=True)
    return tuple(
        type(stage).flag(name)
        for key, stage in settings
        if (key in RENDER_STAGES) == are_of_rendering
        for name in type(stage).model_fields
        if before.get(key, {}).get(name) != now.get(key, {}).get(name)
        and not (name == "indices" and _has_indices(earlier, settings.write.indices))
    )


def _has_indices(earlier: Sidecar, names: Sequence[str]) -> bool:
    """Return True if all indices were requested before, or exist."""
    files = {part.file for part in earlier.products if part.kind == "index"}
    requested = earlier.write_options.get("indices", [])
    return all(name in requested or f"{earlier.capture}_{name}.tif" in files for name in names)


def outputs_exist(sidecar: Path, files: Sequence[FilePart]) -> bool:
    """Return True if a sidecar and files that it lists exist, these with their sizes; checksums would take minutes."""
    try:
        states = [((sidecar.parent / part.file).stat(), part.bytes) for part in files]
    except OSError:
        return False
    return sidecar.is_file() and all(stat.S_ISREG(one.st_mode) and one.st_size == size for one, size in states)


# ---- results of captures that the input of this run does not have


def labels_of_other_inputs(earlier: RunPart | None, record: RunPart) -> dict[str, list[str]]:
    """Return the labels of the captures that earlier runs found in other input folders, by folder, without those of
    this run; flights may be aligned folder by folder into one output folder.
    """
    if earlier is None:
        return {}
    found, own = {**earlier.other_inputs, earlier.input: earlier.labels}, set(record.labels)
    others = {folder: [label for label in labels if label not in own] for folder, labels in found.items()}
    return {folder: labels for folder, labels in others.items() if labels and folder != record.input}


def results_not_in_input(
    flight: FolderScan, out: Path, other_inputs: Mapping[str, Sequence[str]]
) -> Iterator[NotInInputPart]:
    """Yield the results of captures that are in no input folder: their images were removed, or have another name and
    are a capture of this run. Images that exist, and are not selected, are in the input.
    """
    own, others = {c.label for c in flight.captures}, {label for labels in other_inputs.values() for label in labels}
    by_sample = cache(partial(_labels_by_sample, flight.captures))
    for path in find_sidecars(out):
        if (label := label_of(path, out)) in own:
            continue
        with suppress(SidecarError):  # named by the commands that read it
            result = read_checked(path).without_tables()
            if same := _same_exposure(result, flight.captures, by_sample):
                yield NotInInputPart(capture=label, same_as=same)
            elif label not in others and not any((flight.folder / b.file).is_file() for b in result.bands):
                yield NotInInputPart(capture=label)


def _same_exposure(result: Sidecar, captures: Sequence[Capture], by_sample: Callable[[], Mapping[str, str]]) -> str:
    """Return the label of the capture that is the same exposure as a result, by the id in the tags, else by the
    contents of a file, as `_labels_by_sample`; empty if there is none.
    """
    if result.capture_id:
        of_id = (c for c in captures if c.capture_id == result.capture_id and is_same(result, c))
        return next((c.label for c in of_id), "")
    return next((by_sample()[sample] for sample in sorted(result.own_samples) if sample in by_sample()), "")


def _labels_by_sample(captures: Iterable[Capture]) -> dict[str, str]:
    """Return the labels of captures without an id by the contents of their files: a renamed file may have another
    spelling of its band.
    """
    return {sample: c.label for c in captures if not c.capture_id for sample in input_samples(c).values()}
